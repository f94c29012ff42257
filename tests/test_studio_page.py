"""The studio's page: its guide by rules, and in Chromium the way from the first page to the living avatar."""

import errno
import shutil
import socket
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

pytest.importorskip("starlette")

from forked import ForkServer
from mien import runtime
from mien.formats.page import write_page
from mien.studio.people import People
from mien.studio.server import Serving
from needs import NO_NAMESPACE
from refusals import refuses
from studio_case import STUB, give_film, person, studio, told
from test_end_to_end import leave_network, raise_loopback
from test_web_webcam import ALLOWED, FAKE, found
from web_case import WEB, browse, bundle, drawn_head, expect_usable, run_node, tasks_vision, until

HOUR = 3600.0
FOUR_SECONDS = r"0:(0[4-9]|[1-5]\d)"
"""The clock of a film when the guide has seen four seconds. A busy machine may pass a second without showing it."""

GOOD = {"face": 0.5, "around": 0.5, "sharpness": 1.0}
BOX = [0.35, 0.25, 0.65, 0.75]
REST = {
    name: 0.05
    for name in (
        "mouthSmileLeft", "mouthSmileRight", "browInnerUp", "browOuterUpLeft", "browOuterUpRight", "jawOpen",
        "mouthPucker", "mouthFunnel", "eyeBlinkLeft", "eyeBlinkRight",
    )
}  # fmt: skip
FACES = [
    ("mouthSmileLeft", "mouthSmileRight"), ("browInnerUp",), ("jawOpen",), ("mouthFunnel",),
    ("eyeBlinkLeft", "eyeBlinkRight"),
]  # fmt: skip


def seen(seconds: float, turn: tuple[float, float] = (0, 0), face: tuple[str, ...] = (), **other: Any) -> list[Any]:
    """Return what a detector finds in a picture, and its light. The turn is to the person's left, and up."""
    light = {**GOOD, **other.pop("light", {})}
    scores = {**REST, **dict.fromkeys(face, 0.9)}
    at = found(seconds, scores, (-turn[1], turn[0], 0))
    return [{**at, "box": BOX, "faces": 1, **other}, light]


@pytest.fixture(scope="module")
def guide(tmp_path_factory: pytest.TempPathFactory) -> Path:
    tasks_vision()
    out = tmp_path_factory.mktemp("guide") / "guide.mjs"
    bundle(WEB / "src" / "studio" / "guide.ts", out)
    return out


def test_the_guide_fills_its_rings_and_ends_when_there_is_enough(guide: Path) -> None:
    pictures = [seen(time) for time in np.arange(0, 1.5, 0.1)]
    for k in range(8):  # the right side first, as a mirror shows it, then up, the left and down
        left, up = -0.6 * np.cos(np.pi * k / 4), 0.25 * np.sin(np.pi * k / 4)
        pictures += [seen(1.5 + k + time, (left, up)) for time in np.arange(0, 1, 0.1)]
    half = run_node("guide.mjs", guide, pictures)
    assert np.min(half["turned"]) == 1
    assert np.max(half["moved"]) < 0.6
    assert half["told"][0]["request"].startswith("Look straight ahead")
    assert half["told"][30]["request"].startswith("Turn your head slowly")
    assert half["told"][-1]["request"] == "Smile, and show your teeth"
    assert half["missing"][0] == "Smile, and show your teeth."
    for k, face in enumerate(FACES):
        pictures += [seen(10 + k + time, (0, 0), face) for time in np.arange(0, 1, 0.1)]
    full = run_node("guide.mjs", guide, [*pictures, seen(29.9), seen(30)])
    assert np.min(full["moved"]) == 1
    assert full["missing"] == []
    assert "say a few sentences" in full["told"][-2]["request"]
    assert [each["done"] for each in full["told"][-2:]] == [False, True]
    short = run_node("guide.mjs", guide, [*pictures[:33], seen(44.9), seen(45)])
    assert "Turn your head further: up, left, down." in short["missing"]
    assert [each["done"] for each in short["told"][-2:]] == [False, True], "it ends all the same"


@pytest.mark.parametrize(
    ("words", "wrong"),
    [
        ("No face seen", {"scores": None, "box": None}), ("Two people here", {"faces": 2}),
        ("Too dark here", {"light": {"face": 0.1, "around": 0.15}}), ("Too far away", {"box": [0.45, 0.45, 0.55, 0.6]}),
        ("Lamp behind you", {"light": {"face": 0.2, "around": 0.8}}), ("Too close now", {"box": [0, 0, 1, 0.95]}),
        ("Off the center", {"box": [0.7, 0.3, 0.98, 0.7]}), ("The picture blurs", {"light": {"sharpness": 0.2}}),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_while_it_is(guide: Path, words: str, wrong: dict[str, Any]) -> None:
    times = np.arange(0, 6, 0.1)
    pictures = [seen(time, **(wrong if 2 <= time < 4 or 5 <= time < 5.2 else {})) for time in times]
    faults = [each["fault"] for each in run_node("guide.mjs", guide, pictures)["told"]]
    at = dict(zip(np.round(times, 1).tolist(), faults, strict=True))
    assert [at[time] for time in (1.0, 2.1, 3.0, 4.1, 5.0, 5.3, 5.9)] == [None, None, words, words, None, None, None]


@pytest.fixture(scope="module")
def camera(tmp_path_factory: pytest.TempPathFactory, test_data: Path) -> list[str]:
    """Return Chromium's options by which a clip takes the place of a camera."""
    film = tmp_path_factory.mktemp("camera") / "camera.mjpeg"
    with av.open(str(test_data / "footage" / "wojtek.mp4")) as source, av.open(str(film), "w", format="mjpeg") as out:
        stream = out.add_stream("mjpeg", rate=Fraction(25))
        stream.width, stream.height, stream.pix_fmt = 512, 512, "yuvj420p"
        for frame in source.decode(video=0):
            out.mux(stream.encode(frame.reformat(format="yuvj420p")))
        out.mux(stream.encode())
    return [FAKE, ALLOWED, f"--use-file-for-fake-video-capture={film}"]


@pytest.mark.footage
@pytest.mark.slow
def test_from_the_first_page_to_the_living_avatar(tmp_path: Path, camera: list[str]) -> None:
    """A stand-in makes the avatar. `docs/pictures/studio.py` walks the same way with `mien create` itself."""
    root, head = tmp_path / "people", drawn_head(300)
    with studio(root, STUB) as serving:
        runtime.write_portable(root / ".studio" / "grown.mien", head)
        asked = {"size": (1000, 700), "flags": camera}
        first = [
            {"click": "New person"}, {"fill": ["Who is it?", "Ada"]}, {"click": "This person has agreed"},
            {"click": "Continue"}, {"see": "Half a minute of film is enough."}, {"press": "#film"},
            {"see": "Put your face into the outline, then record."}, {"press": "#record"}, {"match": FOUR_SECONDS},
        ]  # fmt: skip
        closed = browse(serving.address, steps=first, **asked)
        (unfinished,) = told(serving, "GET", person("Ada"))[1]["films"]
        assert (unfinished["whole"], unfinished["size"] > 10_000) == (False, True), "the tab was closed"
        second = [
            {"see": "Ada"}, {"press": "#people button"}, {"press": '[aria-label="Keep film 1"]'}, {"see": "512×512"},
            {"press": "#film"}, {"see": "Put your face"}, {"press": "#record"}, {"match": FOUR_SECONDS},
            {"press": "#finish"}, {"see": "Film 2"}, {"click": "More"}, {"press": "#quality"},
            {"keys": ["Home", "Enter"]}, {"press": "#make"}, {"see": "Stop"},
        ]  # fmt: skip
        made = browse(serving.address, steps=second, **asked)
        films = told(serving, "GET", person("Ada"))[1]["films"]
        assert [each["whole"] for each in films] == [True, True]
        until(lambda: told(serving, "GET", person("Ada"))[1]["growing"] is not None, HOUR)
        (root / ".studio" / "go").touch()
        until(lambda: told(serving, "GET", person("Ada"))[1]["progress"]["state"] == "done", HOUR)
        assert told(serving, "GET", person("Ada"))[1]["settings"]["quality"] == "draft"
        write_page(root / "Ada" / "me.html", head, None)
        runtime.write_portable(root / "Ada" / "me.mien", head)
        saved = [
            {"see": "Done"}, {"press": "#people button"}, {"press": '[aria-label="Save: Page"]'}, {"press": "#be-me"},
            {"see": "The avatar follows your face."}, {"press": "#be-me"}, {"see": "Be me"},
        ]  # fmt: skip
        taken = browse(serving.address, steps=saved, downloads=tmp_path, **asked)
        own = f"http://127.0.0.1:{serving.port}/"
        for each in (closed, made, taken):
            assert each["messages"] == []
            assert all(request.startswith((own, "blob:", "data:")) for request in each["requests"])
    assert (tmp_path / "Ada me.html").read_bytes() == (root / "Ada" / "me.html").read_bytes()


FILMS = """(async () => {
  const one = (text) => document.querySelector(text), pause = () => new Promise((done) => setTimeout(done, 50));
  const press = async (text) => {
    while (one(text).disabled || one(text).hidden) await pause();
    one(text).click();
  };
  while (one("#person").hidden) await pause();
  await press("#film");
  await press("#record");
  BREAKS;
  while (!one("#message").textContent) await pause();
  const words = one("#message").textContent;
  AFTER;
  return words;
})()"""
SAVED = 'while (!one("#clock").textContent.includes("saved")) await pause();'
FAULTS = {
    "unplugged": (
        f'{SAVED} one("#camera").srcObject.getVideoTracks()[0].dispatchEvent(new Event("ended"))',
        "The camera was unplugged or switched off. What was filmed until then is kept.", True,
    ),
    "ended": (f"{SAVED} fetch = async () => {{ throw new TypeError() }}", "The studio does not answer.", False),
    "full": ("", "the disk is full; free 2 GB and try again.", False),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_what_happens_while_filming_is_told_and_keeps_the_film(
    fault: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    breaks, words, whole = FAULTS[fault]
    with studio(tmp_path / "people") as serving:
        serving.maker.people.add("Ada")
        if fault == "full":
            usage = shutil.disk_usage(tmp_path)
            monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=1 << 30))
        after = """while (!one('[aria-label="Play film 1"]')) await pause()""" if whole else ""
        steps = [FILMS.replace("BREAKS", breaks).replace("AFTER", after)]
        (message,) = browse(serving.address, steps, fragment="Ada", flags=[FAKE, ALLOWED])["results"]
        assert words in message
        (film,) = told(serving, "GET", person("Ada"))[1]["films"]
        assert (film["whole"], film["size"] > 0) == (whole, fault != "full")


def walk_offline(folder: str, film: str) -> None:
    """Add a person, give a film and make an avatar of it, without a route to anywhere. It runs in a fork."""
    if not leave_network():
        return print("NO NAMESPACE")
    raise_loopback()
    with socket.socket() as outside:
        assert outside.connect_ex(("192.0.2.1", 80)) == errno.ENETUNREACH
    refuses("this machine is on no network", Serving, Path(folder), lan=True)
    with studio(Path(folder)) as serving:
        serving.maker.people.add("Ada")
        steps = [{"give": ["#file", film]}, {"see": "Turn your head further"}, {"press": "#make"}, {"see": "Stop"}]
        told_by_page = browse(serving.address, steps=steps, fragment="Ada")
        own = (f"http://127.0.0.1:{serving.port}/", "blob:", "data:")
        assert [each for each in told_by_page["requests"] if not each.startswith(own)] == []
        assert told_by_page["messages"] == []
    return print("DONE")


def test_nothing_needs_a_network(tmp_path: Path, test_data: Path, fork_server: ForkServer) -> None:
    film = test_data / "cases" / "plain.mp4"
    process = fork_server.call("test_studio_page:walk_offline", str(tmp_path / "people"), str(film))
    assert process.wait() == 0, process.stderr[-2000:]
    if "NO NAMESPACE" in process.stdout:
        pytest.skip(NO_NAMESPACE)
    assert "DONE" in process.stdout


def test_the_page_can_be_used_by_everybody(tmp_path: Path, test_data: Path) -> None:
    """Without a mouse, and in the eyes of axe-core: the list, the dialogs, and a person in each state."""
    root = tmp_path / "people"
    people = People(root)
    with studio(root) as serving:
        for name in ("Ada", "Bad"):
            give_film(people, name, test_data / "cases" / "plain.mp4")
            assert told(serving, "POST", f"{person(name)}/making", {})[0] == 200
        until(lambda: told(serving, "GET", person("Ada"))[1]["progress"]["state"] == "making")
        settled = "await new Promise((done) => setTimeout(done, 1500));"
        steps = ['document.querySelector("#new").click();', 'document.querySelector("#not-adding").click();']
        steps += [f"location.hash = '{name}'; {settled}" for name in ("Ada", "Bad")]
        expect_usable(serving.address, settled, *steps)
        keys = ["Tab", "Enter", *"Eve", "Tab", "Space", "Tab", "Tab", "Enter"]
        steps = [{"see": "Is being made"}, {"keys": keys}, {"see": "Half a minute of film is enough."}]
        steps += [{"keys": ["Tab", "Tab", "Tab", "Enter"]}, {"see": "Phones reach this studio"}]
        assert browse(serving.address, steps=steps)["messages"] == []


REFUSED = """(async () => {
  navigator.mediaDevices.getUserMedia = async () => { throw new DOMException("", "NotAllowedError"); };
  const pause = () => new Promise((done) => setTimeout(done, 100)), message = document.querySelector("#message");
  location.hash = "Ada";
  while (document.querySelector("#person").hidden) await pause();
  document.querySelector("#film").click();
  while (!message.textContent) await pause();
  return [message.textContent, document.querySelector("#camera").hidden, document.querySelector("#film").disabled];
})()"""


def test_a_camera_that_is_refused_is_told(tmp_path: Path) -> None:
    with studio(tmp_path / "people") as serving:
        serving.maker.people.add("Ada")
        ((text, hidden, disabled),) = browse(serving.address, [REFUSED])["results"]
    assert text.startswith("The camera is not allowed. Allow it for this page")
    assert (hidden, disabled) == (True, False)
