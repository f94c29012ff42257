"""A webcam in the exported page: a drawn head drives it, and nothing leaves the page."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from mien.export import find_webcam_files, write_packed, write_page
from mien.export.webcam import TEMPLATE, VERSION
from test_web_element import served
from web_case import WEB, browse, chromium, drawn_head, tasks_vision, violations
from webcam_case import CELL, STILL, TRUE, Clip, write_clip

FAKE = "--use-fake-device-for-media-stream"
ALLOWED = "--use-fake-ui-for-media-stream"
DENIED = "--deny-permission-prompts"
WINDOW = (640, 320)
CORRELATION = 0.9


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Clip:
    return write_clip(tmp_path_factory.mktemp("clip"))


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A page with few Gaussians, so that software WebGL leaves time for the detector."""
    chromium()
    tasks_vision()
    path = tmp_path_factory.mktemp("page") / "me.html"
    write_page(path, drawn_head(150), webcam=find_webcam_files())
    return path


def in_front(clip: Clip) -> list[str]:
    return [FAKE, ALLOWED, f"--use-file-for-fake-video-capture={clip.path}"]


def test_the_committed_part_of_the_page_is_that_of_a_fresh_build(built: Path) -> None:
    fresh = (built / "webcam.html").read_text()
    assert fresh == TEMPLATE.read_text(), "webcam.html is older than web/: run `make web`, and commit it"


def test_the_page_carries_the_notices_of_what_it_embeds(page: Path) -> None:
    read = """(async () => {
  await webcam;
  document.getElementById("more").click();
  const notices = document.getElementById("notices");
  notices.open = true;
  return [notices.innerText, notices.querySelector("pre").getBoundingClientRect().height];
})()"""
    text, height = browse(page, [read], WINDOW)["results"][0]
    named = [
        "MediaPipe Authors",
        f"vision {VERSION}",
        "TensorFlow",
        "OpenCV",
        "XNNPACK",
        "Protocol Buffers",
        "Emscripten",
    ]
    licences = ["Apache License\n", "BSD 3-Clause License", "MIT License"]
    assert [part for part in named + licences if part not in text] == []
    assert height > 50


RECORD = """(async () => {
  const viewer = await mien, camera = await webcam, log = { frames: [], faces: [], states: [] };
  const columns = %s.map((name) => viewer.avatar.expression_names.indexOf(name));
  const brush = new OffscreenCanvas(1, 440).getContext("2d", { willReadFrequently: true });
  const until = async (ready) => { while (!ready()) await new Promise((done) => setTimeout(done, 20)); };
  const { onState, onReading, video } = camera, button = document.getElementById("camera");
  camera.onState = (state, why) => (onState(state, why), log.states.push(state));
  camera.onReading = (reading) => {
    onReading(reading);
    const { expression, head_rotation } = viewer.face, driven = columns.map((k) => expression[k]);
    log.faces.push([performance.now(), reading.milliseconds, reading.work, head_rotation[1], ...driven]);
  };
  document.getElementById("mirrored").click();
  button.click();
  await until(() => camera.state === "calibrating");
  const see = (now) => {
    brush.drawImage(video, %d, 0, 1, 440, 0, 0, 1, 440);
    const pixels = brush.getImageData(0, 0, 1, 440).data, bit = (k) => +(pixels[4 * (40 * k + 20)] > 128);
    let number = 0, parity = 0;
    for (let k = 0; k < 10; ++k) (number += bit(k) << k), (parity ^= bit(k));
    if (parity === bit(10)) log.frames.push([now, number]);
    if (video.srcObject) video.requestVideoFrameCallback(see);
  };
  video.requestVideoFrameCallback(see);
  const frame = () => log.frames.at(-1)?.[1] ?? -1;
  // The automatic neutral face may be any; the button takes that of the still part.
  await until(() => camera.state === "running");
  await until(() => frame() > 90);
  await until(() => frame() < 3);
  document.getElementById("neutral").click();
  await until(() => camera.state === "running");
  log.start = log.faces.length;
  await until(() => frame() > 90);
  await until(() => frame() < 3);
  await until(() => frame() > 90);
  const tracks = video.srcObject.getTracks();
  button.click();
  log.ended = tracks.every((track) => track.readyState === "ended");
  const rest = viewer.avatar.neutral.expression;
  log.rested = viewer.face.expression.every((value, k) => value === rest[k]);
  log.label = button.textContent;
  return log;
})()"""


@pytest.mark.slow
@pytest.mark.alone
def test_a_drawn_head_drives_jaw_and_blinks(page: Path, clip: Clip) -> None:
    """Coefficients of the avatar against the true ones of the picture that the detector saw."""
    told = browse(page, [RECORD % (json.dumps(TRUE), CELL // 2)], WINDOW, flags=in_front(clip))
    (log,) = told["results"]
    assert told["messages"] == []
    # The worker's script and two scripts of MediaPipe, all from the page's own memory.
    assert [address.partition(":")[0] for address in told["requests"]] == ["blob"] * len(told["requests"])
    assert log["states"] == ["opening", "calibrating", "running", "calibrating", "running", "off"]
    assert log["ended"] is True
    assert log["rested"] is True
    assert log["label"] == "Be me"

    frames = np.array(log["frames"])
    faces = np.array(log["faces"][log["start"] :])
    shown, seen, driven = faces[:, 0], faces[:, 1], faces[:, 4:]
    number = frames[np.abs(frames[:, :1] - seen).argmin(0), 1].astype(int)
    rate, delays = 1000 * (len(faces) - 1) / (shown[-1] - shown[0]), []
    for column, name in enumerate(TRUE):
        r = np.corrcoef(clip.truth[number, column], driven[:, column])[0, 1]
        delays.append(delay(frames[:, 0], clip.truth[frames[:, 1].astype(int), column], shown, driven[:, column]))
        print(f"{name}: r = {r:.3f}, {delays[-1]:.0f} ms after the picture, {rate:.1f} faces a second")
        assert r >= CORRELATION
        assert np.abs(driven[number < STILL, column]).mean() < 0.1
        assert driven[:, column].max() > 0.7 * clip.truth[:, column].max()
    print(f"median: {np.median(faces[:, 2]):.0f} ms of the detector, {np.median(shown - seen):.0f} ms until driven")
    assert 0 <= max(delays) < 2000
    turned = faces[:, 3] - float(drawn_head(1).neutral.head_rotation[1])
    assert np.corrcoef(clip.yaw[number], turned)[0, 1] >= CORRELATION
    assert np.polyfit(clip.yaw[number], turned, 1)[0] == pytest.approx(1, abs=0.3)


def delay(told: np.ndarray, truth: np.ndarray, shown: np.ndarray, driven: np.ndarray) -> float:
    """Return how long after a picture the page shows it, in ms: where the cross correlation is largest."""
    grid = np.arange(shown[0] + 2000, shown[-1], 10.0)

    def held(times: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
        return values[np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(values) - 1)]

    now = held(shown, driven, grid)
    lags = np.arange(0, 2000, 10.0)
    return float(lags[np.argmax([np.corrcoef(held(told, truth, grid - lag), now)[0, 1] for lag in lags])])


PRESS = """(async () => {
  await webcam;
  %s
  const button = document.getElementById("camera"), told = document.getElementById("camera-state");
  button.click();
  const said = () => /^(The camera|There|This|Browsers)/.test(told.textContent);
  for (let i = 0; i < 500 && !said(); ++i) await new Promise((done) => setTimeout(done, 20));
  return [told.textContent, button.textContent, told.getAttribute("role"), (await webcam).state];
})()"""
NO_CAMERA_API = "Object.defineProperty(navigator, 'mediaDevices', { value: undefined });"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("flags", "before", "message"),
    [
        ([FAKE, DENIED], "", "The camera is not allowed. Allow it for this page"),
        ([ALLOWED], "", "There is no camera. Connect one"),
        ([], NO_CAMERA_API, "This browser gives no camera to a page from a file. Open the file with Chrome"),
    ],
)
def test_what_is_wrong_is_said(page: Path, flags: list[str], before: str, message: str) -> None:
    told = browse(page, [PRESS % before], WINDOW, flags=flags)
    text, label, role, state = told["results"][0]
    assert text.startswith(message)
    assert (label, role, state) == ("Be me", "status", "off")
    assert told["requests"] == []


HIDE = """(async () => {
  const camera = await webcam, { video } = camera;
  document.getElementById("camera").click();
  while (camera.state !== "running") await new Promise((done) => setTimeout(done, 20));
  const tracks = video.srcObject.getTracks();
  const before = tracks.map((track) => track.readyState);
  Object.defineProperty(document, "hidden", { value: true, configurable: true });
  document.dispatchEvent(new Event("visibilitychange"));
  const after = tracks.map((track) => track.readyState);
  delete document.hidden;
  const text = document.getElementById("camera-state").textContent;
  document.getElementById("camera").click();
  while (camera.state !== "running") await new Promise((done) => setTimeout(done, 20));
  camera.stop();
  return [before, after, text, camera.state];
})()"""

TRY_TO_SEND = """(async () => {
  const away = "https://example.com/", refused = new Set();
  document.addEventListener("securitypolicyviolation", (event) => refused.add(event.effectiveDirective));
  fetch(away).catch(() => {});
  try { new WebSocket("wss://example.com/"); } catch {}
  navigator.sendBeacon(away, "x");
  const [image, form, frame, script] = ["img", "form", "iframe", "script"].map((name) => document.createElement(name));
  image.src = frame.src = script.src = form.action = away;
  document.body.append(form, frame, script);
  form.submit();
  await new Promise((done) => setTimeout(done, 1000));
  return [...refused].sort();
})()"""


@pytest.mark.slow
def test_the_camera_stops_when_the_page_is_hidden_and_starts_again(page: Path, clip: Clip) -> None:
    told = browse(page, [HIDE], WINDOW, flags=in_front(clip))
    before, after, text, state = told["results"][0]
    assert (before, after, state) == (["live"], ["ended"], "off")
    assert text == "The camera is off, because the page was hidden."


@pytest.mark.slow
def test_the_page_could_send_nothing(page: Path) -> None:
    """Its own policy forbids every way out."""
    told = browse(page, [TRY_TO_SEND], WINDOW)
    assert told["results"][0] == ["connect-src", "form-action", "frame-src", "img-src", "script-src-elem"]


CONTROLS = """(async () => {
  const camera = await webcam;
  camera.onState("running");
  const controls = document.querySelectorAll("#camera-controls button, #camera-controls input");
  return [...controls].map((control) => [control.id, control.tabIndex, control.offsetParent !== null,
    (control.labels?.[0]?.textContent ?? control.textContent).trim()]);
})()"""


@pytest.mark.slow
def test_every_control_has_a_name_and_is_reached_by_keys(page: Path) -> None:
    told = browse(page, [CONTROLS], (900, 900))
    assert told["results"][0] == [
        ["neutral", 0, True, "This is my neutral face"],
        ["mirrored", 0, True, "Mirrored"],
        ["preview", 0, True, "My picture"],
    ]


@pytest.mark.slow
@pytest.mark.parametrize("device", [[], ["dark", "touch"]])
def test_everybody_can_use_the_page(page: Path, device: list[str]) -> None:
    """axe-core finds no fault in the page with its camera's controls and notices."""
    first = 'await webcam; document.getElementById("more").click();'
    assert violations(page, (390, 700), device, first) == []


CLASS = """(async () => {
  const avatar = document.querySelector("mien-avatar"), told = document.querySelector("span");
  const until = async (ready) => { while (!ready()) await new Promise((done) => setTimeout(done, 20)); };
  await until(() => avatar.viewer);
  document.querySelector("button").click();
  await until(() => told.textContent === "running" || told.textContent.includes("fetched"));
  if (told.textContent !== "running") return told.textContent;
  const jaw = avatar.viewer.avatar.expression_names.indexOf("jawOpen"), { expression } = avatar.viewer.face;
  await until(() => expression[jaw] > 0.25);
  await until(() => expression[jaw] < 0.1);
  return told.textContent;
})()"""


@pytest.mark.slow
def test_the_class_drives_the_element(tmp_path: Path, built: Path, clip: Clip, test_data: Path) -> None:
    """The example page, from a web server, with files of the package and the model beside it."""
    write_packed(tmp_path / "me.packed", drawn_head(150))
    for name in ("element.js", "webcam.js"):
        shutil.copy(built / name, tmp_path)
    shutil.copy(WEB / "examples" / "webcam.html", tmp_path / "index.html")
    (tmp_path / "tasks-vision").symlink_to(tasks_vision())
    with served(tmp_path) as address:
        without = browse(f"{address}/index.html", [CLASS], WINDOW, flags=in_front(clip))
        (tmp_path / "face_landmarker.task").symlink_to(test_data / "mediapipe" / "face_landmarker.task")
        told = browse(f"{address}/index.html", [CLASS], WINDOW, flags=in_front(clip))
    assert without["results"] == ["face_landmarker.task cannot be fetched: the server answers 404."]
    assert told["results"] == ["running"]
    assert all(request.startswith((address, "blob:")) for request in told["requests"])
