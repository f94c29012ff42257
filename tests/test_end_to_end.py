"""A short demo, who can read its reports, every command without a network, the examples and the code of docs/api.md."""

import ctypes
import fcntl
import json
import os
import re
import runpy
import socket
import struct
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from batch_stub import PROGRAM
from conftest import MadeOnce
from forked import ForkServer
from fuzzing.kills import TRACK
from mien import runtime, tracking
from mien.avatar.methods import DEFAULT_METHOD
from mien.cli import COMMANDS, main
from mien.face.loading import add_face_model
from mien.formats.glb import write_glb
from mien.media.video import probe_video
from mien.tracking.settings import PhotometricSettings, TrackingSettings
from needs import NO_NAMESPACE
from shared_things import write_toy_workspace
from test_glb import mesh_model
from toy_scene import toy_face_model
from viewer_alone import page_of
from web_case import chromium, drawn_head, violations

pytestmark = [pytest.mark.unchecked, pytest.mark.usefixtures("short_films")]
RUN = Path("runs") / DEFAULT_METHOD


@pytest.fixture(scope="module")
def demo(made_once: MadeOnce, fork_server: ForkServer) -> Path:
    return made_once("demo", partial(make_demo, fork_server))


def test_demo_beats_both_baselines_and_leaves_what_people_look_at(demo: Path) -> None:
    metrics = json.loads((demo / RUN / "metrics.json").read_text())
    assert (metrics["format"], metrics["version"]) == ("mien.metrics", 1)
    entry = metrics["protocols"]["self_reenactment"]
    assert (entry["split"], entry["frames"], metrics["training"]["steps"]) == ("blocks", 2, int(DEMO[-1]))
    best = max(baseline["head"]["psnr"] for baseline in entry["baselines"].values())
    assert entry["head"]["psnr"] > best + 1
    page = (demo / RUN / "report.html").read_text(encoding="utf-8")
    assert "<h1>" in page
    assert "http://" not in page.replace("http://www.w3.org", "")
    assert probe_video(demo / "sequences/synthetic/tracking/overlay.mp4").frames == FRAMES
    assert probe_video(demo / "me.mp4").frames == 10
    assert (demo / "me.html").stat().st_size > 100_000


def test_everybody_can_read_the_reports(demo: Path, tmp_path: Path) -> None:
    chromium()
    assert main(["evaluate", "compare", str(demo), "--out", str(tmp_path / "compare.html")]) == 0
    tracked = demo / "sequences/synthetic/tracking/report.html"
    for page in (demo / RUN / "report.html", tracked, tmp_path / "compare.html"):
        for size, device in (((1280, 800), []), ((390, 844), ["dark", "touch"])):
            assert violations(page, size, device) == [], (page, device)


def test_the_avatar_turns_and_follows_blend_shapes(demo: Path, tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text('[{"blendshapes": {"jawOpen": 0.5}}, {"blendshapes": {}}]')
    for line in (
        "render {me} --out {out}/still.png --size 64",
        "render {me} --out {out}/aside.png --size 64 --yaw 30",
        "drive {me} --by {out}/a.json --out {out}/d.webm --background transparent --size 64",
    ):
        assert main(line.format(me=demo, out=tmp_path).split()) == 0, line
    assert (tmp_path / "aside.png").read_bytes() != (tmp_path / "still.png").read_bytes()


OF_A_VIDEO = {
    "capture": "{video} --out {out}/captured",
    "track": "{out}/captured " + " ".join(TRACK),
    "align": "{out}/captured --alignment.template-steps 2 --alignment.iterations 1",
    "create": "{video} --out {out}/captured --preset draft --steps 2 --tracking.schedule landmarks",
    "batch": "{table} --out {out}/batch --program {stub}",
}
OF_A_RUN = {
    "train": "{toy} --run third --steps 2 --split tail", "evaluate": "{toy} --run toy",
    "analyze": "gaussian-avatars {toy} --run toy --parts speed --seconds 0.01",
    "study": "make {toy} --out {out}/study.html --seconds 0.2 --side 64 --runs toy third",
    "render": "{toy} --run toy --out {out}/still.png",
    "drive": "{toy} --run toy --by {toy} --out {out}/driven.mp4", "export": "{demo} --out {out}/me.html",
    "export-dataset": "{toy} --out {out}/data --format insta", "import": "{exported} --out {out}/imported",
    "face-models": "--json", "bench": "render --seconds 0.01 --json", "licenses": "--json", "plugins": "--json",
    "check": "{glb}",
}  # fmt: skip
"""Lines of every command but three: `demo` makes the subject, and `studio` and `view` have tests of their own."""
_FLAGS, _SET_FLAGS, _UP = 0x8913, 0x8914, 1


@pytest.fixture(scope="module")
def offline(demo: Path) -> Path:
    """The demo, if it was made without a network."""
    skip_if_online(demo)
    return demo


def run_all(server: ForkServer, lines: dict[str, str], **given: object) -> None:
    words = [[command, *(word.format(**given) for word in line.split())] for command, line in lines.items()]
    done = server.call("test_end_to_end:run_offline", words)
    assert done.wait() == 0, done.stderr
    told = [line for line in done.stdout.splitlines() if line.startswith("CODE")]
    assert told == [f"CODE {name} 0" for name in lines], done.stderr


def test_no_command_needs_a_network(offline: Path, fork_server: ForkServer, tmp_path: Path) -> None:
    assert {*OF_A_VIDEO, *OF_A_RUN, "demo", "studio", "view"} == set(COMMANDS)
    video = offline / VIDEO
    (tmp_path / "table.csv").write_text(f"video\n{video}\n")
    table, stub = tmp_path / "table.csv", " ".join(PROGRAM)
    run_all(fork_server, OF_A_VIDEO, video=video, out=tmp_path, table=table, stub=stub)


def test_no_command_needs_a_network_once_there_is_a_run(offline, fork_server, tmp_path, monkeypatch) -> None:
    toy, exported = tmp_path / "toy", tmp_path / "exported"
    write_toy_workspace(toy, timesteps=20)
    monkeypatch.setenv("MIEN_CACHE", str(tmp_path / "cache"))
    add_face_model(toy_face_model(), tmp_path / "toy.npz", "none")
    lines = {"export": "{toy} --out {exported} --format gaussian-avatars"}
    run_all(fork_server, lines, toy=toy, exported=exported)
    write_glb(tmp_path / "me.glb", drawn_head(50), mesh_model(drawn_head(50)), 32)
    given = {"demo": offline, "toy": toy, "exported": exported, "out": tmp_path, "glb": tmp_path / "me.glb"}
    run_all(fork_server, OF_A_RUN, **given)
    runtime.write_portable(tmp_path / "me.mien", drawn_head(50))
    viewer = fork_server.call("test_end_to_end:view_alone", str(tmp_path / "me.mien"))
    assert viewer.wait() == 0, viewer.stderr
    assert "<html" in viewer.stdout


def test_a_capture_by_litert_is_made_without_a_network(offline: Path, fork_server: ForkServer, tmp_path: Path) -> None:
    pytest.importorskip("ai_edge_litert", reason="could not import ai_edge_litert")
    line = "{video} --out {out} --capture.detector litert --capture.max-frames 2"
    run_all(fork_server, {"capture": line}, video=offline / VIDEO, out=tmp_path)


def view_alone(avatar: str) -> None:
    """Show an avatar without a route to anywhere, and print the viewer's page."""
    assert leave_network()
    raise_loopback()
    print(page_of([sys.executable, "-m", "mien.cli", "view", avatar, "--port", "0"]))


def raise_loopback() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        asked = struct.pack("16sH14x", b"lo", 0)
        _, flags = struct.unpack("16sH14x", fcntl.ioctl(any_socket, _FLAGS, asked))
        fcntl.ioctl(any_socket, _SET_FLAGS, struct.pack("16sH14x", b"lo", flags | _UP))


ROOT = Path(__file__).parents[1]
SUBJECT = "out/examples/subject"


def run_script(name: str, folder: Path, *arguments: str) -> None:
    with pytest.MonkeyPatch.context() as patched:
        patched.chdir(folder)
        patched.setattr(sys, "argv", [name, *arguments])
        runpy.run_path(str(ROOT / "examples" / name), run_name="__main__")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("examples")
    run_script("03_synthetic_capture.py", folder, "--out", SUBJECT, "--seconds", "0.24", "--size", "64")
    return folder


@pytest.fixture(scope="module")
def trained(folder: Path) -> Path:
    run_script("05_train_and_evaluate.py", folder, SUBJECT, "--steps", "20", "--gaussians", "9000")
    return folder


@pytest.fixture
def short_tracking(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let `mien.tracking.track` take few keyframes and steps where it is given no settings."""
    pixels = PhotometricSettings(keyframes=4, sizes=(64, 64), texture_size=128, shared_steps=1)
    few = TrackingSettings(keyframes=4, photometric=pixels)
    monkeypatch.setattr(tracking, "track", partial(tracking.track, settings=few))


def test_gaussians_are_fitted_and_a_face_is_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run_script("01_fit_gaussians.py", tmp_path, "--out", "fit.png", "--steps", "60")
    errors = [float(line.split()[-1]) for line in capsys.readouterr().out.splitlines() if line.startswith("step")]
    assert errors[-1] < 0.3 * errors[0]
    assert (tmp_path / "fit.png").is_file()
    run_script("02_face_model.py", tmp_path, "--out", "face.png", "--size", "64")
    assert "jawOpen" in capsys.readouterr().out


@pytest.mark.usefixtures("short_tracking")
def test_capture_and_track(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # A drawn head with lines over it is still a face.
    overlay = f"{SUBJECT}/sequences/synthetic/tracking/overlay.mp4"
    run_script("04_capture_and_track.py", folder, overlay, "--out", "out/examples/me", "--max-frames", "6")
    assert "landmark residual" in capsys.readouterr().out
    assert (folder / "out/examples/me/sequences/overlay/tracking/overlay.mp4").is_file()


def test_training_by_the_example_and_by_the_command_gives_the_same_bytes(trained: Path) -> None:
    runs = trained / SUBJECT / "runs"
    metrics = json.loads((runs / "example/metrics.json").read_text())
    assert metrics["protocols"]["self_reenactment"]["head"]["psnr"] > 0
    options = ("--run", "by_command", "--steps", "20", "--method.density.max-gaussians", "9000")
    assert main(["train", str(trained / SUBJECT), *options]) == 0
    for name in ("avatar/avatar.safetensors", "avatar/avatar.json", "face_track.safetensors"):
        assert (runs / "example" / name).read_bytes() == (runs / "by_command" / name).read_bytes(), name
    one, other = (json.loads((runs / name / "config.json").read_text()) for name in ("example", "by_command"))
    assert all(one[part] == other[part] for part in ("method", "settings", "data"))


def test_the_avatar_is_drawn_driven_and_run_without_torch(trained: Path) -> None:
    run_script("06_render_expressions.py", trained, SUBJECT, "--run", "example", "--out", "e.png", "--size", "48")
    run_script("07_drive.py", trained, SUBJECT, "--by", SUBJECT, "--run", "example", "--out", "driven.mp4")
    for name in ("e.png", "driven.mp4"):
        assert (trained / name).stat().st_size > 1000
    assert main(["export", str(trained / SUBJECT), "--run", "example", "--out", str(trained / "avatar.mien")]) == 0
    run_script("08_runtime.py", trained, "avatar.mien", "--out", "frames", "--frames", "3", "--size", "48")
    assert len(list((trained / "frames").glob("*.png"))) == 3


@pytest.mark.usefixtures("short_tracking")
def test_api_page(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    page = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    assert len(blocks) == 10
    monkeypatch.chdir(folder)
    exec("\n".join(blocks), {"__name__": "__main__"})
    assert "Gaussians" in capsys.readouterr().out


DEMO = ("--seconds", "0.8", "--steps", "120")
FRAMES = 12
"""Number of frames of the clip."""
VIDEO = "synthetic-0-0.8s.mp4"
ONLINE = "online"
"""Name of the file that the demo's folder has if it was made with a network, since there can be no namespace."""
_NEW_USER, _NEW_NETWORK = 0x10000000, 0x40000000


def write_demo(folder: str) -> None:
    """Run `mien demo` in this process, which must be a fork."""
    if not leave_network():
        (Path(folder) / ONLINE).touch()
    shorten()
    assert main(["demo", "--out", folder, *DEMO]) == 0


def shorten() -> None:
    """Let this process draw small demos, and films of few pictures."""
    from mien.evaluation import living
    from mien.lab.synthetic import RECIPES

    small = {"width": 192, "height": 192, "fps": FRAMES / 0.8, "supersample": 1, "texture_size": 256}
    RECIPES["demo"] = replace(RECIPES["demo"], **small)
    living.FPS = 2


def run_offline(lines: list[list[str]]) -> None:
    """Run commands one after the other without a network, and print the exit code of each."""
    assert leave_network()
    shorten()
    for line in lines:
        sys.argv = ["mien", *line]
        print("CODE", line[0], main(line), flush=True)


def leave_network() -> bool:
    """Move this process into a network namespace that has not even a loopback; return whether that is possible."""
    if sys.platform != "linux":
        return False
    user, group = os.getuid(), os.getgid()
    if ctypes.CDLL(None).unshare(_NEW_USER | _NEW_NETWORK):
        return False
    Path("/proc/self/setgroups").write_text("deny")
    Path("/proc/self/uid_map").write_text(f"0 {user} 1")
    Path("/proc/self/gid_map").write_text(f"0 {group} 1")
    assert [name for _, name in socket.if_nameindex()] == ["lo"]
    with socket.socket() as no_socket:
        assert no_socket.connect_ex(("127.0.0.1", 9)) == 101, "the loopback is down: the network is unreachable"
    return True


def skip_if_online(demo: Path) -> None:
    if (demo / ONLINE).exists():
        pytest.skip(NO_NAMESPACE)


def make_demo(server: ForkServer, folder: Path) -> None:
    process = server.call("test_end_to_end:write_demo", str(folder))
    assert process.wait() == 0, process.stderr[-2000:]
