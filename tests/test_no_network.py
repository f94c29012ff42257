"""Every command works, and finds nobody to call, in a network namespace that has not even a loopback."""

import fcntl
import socket
import struct
import sys
from functools import partial
from pathlib import Path

import pytest

from batch_stub import PROGRAM
from conftest import MadeOnce
from demo_case import VIDEO, leave_network, make_demo, skip_if_online
from forked import ForkServer
from fuzzing.kills import TRACK
from mien import runtime
from mien.avatar import make_portable
from mien.cli import COMMANDS
from mien.face import add_face_model
from test_avatar import new_avatar
from toy_scene import toy_camera, toy_face_model
from toy_workspace import write_toy_workspace
from viewer_alone import page_of

pytestmark = pytest.mark.unchecked

OF_A_VIDEO = {
    "capture": "{video} --out {out}/captured",
    "track": "{out}/captured " + " ".join(TRACK),
    "align": "{out}/captured --alignment.template-steps 2 --alignment.iterations 1",
    "create": "{video} --out {out}/captured --preset draft --steps 2 --alignment.when never " + " ".join(TRACK),
    "batch": "{table} --out {out}/batch --program {stub}",
}
OF_A_RUN = {
    "train": "{toy} --run third --steps 2 --split tail",
    "evaluate": "{toy} --run toy",
    "analyze": "gaussian-avatars {toy} --run toy --parts speed --seconds 0.01",
    "study": "make {toy} --out {out}/study.html --seconds 0.2 --side 64 --runs toy third",
    "render": "{toy} --run toy --out {out}/still.png",
    "drive": "{toy} --run toy --by {toy} --out {out}/driven.mp4",
    "export": "{demo} --out {out}/me.html",
    "import": "{exported} --out {out}/imported",
    "face-models": "--json",
    "bench": "render --seconds 0.01 --json",
    "licenses": "--json",
    "plugins": "--json",
}
"""Lines of every command but two: `demo` makes the subject, and `view` has a test of its own."""
_FLAGS, _SET_FLAGS, _UP = 0x8913, 0x8914, 1


@pytest.fixture(scope="module")
def demo(made_once: MadeOnce, fork_server: ForkServer) -> Path:
    folder = made_once("demo", partial(make_demo, fork_server))
    skip_if_online(folder)
    return folder


def run_all(server: ForkServer, lines: dict[str, str], **given: object) -> None:
    words = [[command, *(word.format(**given) for word in line.split())] for command, line in lines.items()]
    done = server.call("demo_case:run_offline", words)
    assert done.wait() == 0, done.stderr
    told = [line for line in done.stdout.splitlines() if line.startswith("CODE")]
    assert told == [f"CODE {name} 0" for name in lines], done.stderr


def test_every_command_is_tried() -> None:
    assert {*OF_A_VIDEO, *OF_A_RUN, "demo", "view"} == set(COMMANDS)


def test_no_command_needs_a_network(demo: Path, fork_server: ForkServer, tmp_path: Path) -> None:
    video = demo / VIDEO
    (tmp_path / "table.csv").write_text(f"video\n{video}\n")
    stub, table = " ".join(PROGRAM), tmp_path / "table.csv"
    run_all(fork_server, OF_A_VIDEO, video=video, out=tmp_path, table=table, stub=stub)


def test_no_command_needs_a_network_once_there_is_a_run(
    demo: Path, fork_server: ForkServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    toy, exported = tmp_path / "toy", tmp_path / "exported"
    write_toy_workspace(toy, timesteps=20)
    monkeypatch.setenv("MIEN_CACHE", str(tmp_path / "cache"))
    add_face_model(toy_face_model(), tmp_path / "toy.npz", "none")
    lines = {"export": "{toy} --out {exported} --format gaussian-avatars"}
    run_all(fork_server, lines, toy=toy, exported=exported)
    run_all(fork_server, OF_A_RUN, demo=demo, toy=toy, exported=exported, out=tmp_path)


def test_a_capture_by_litert_is_made_without_a_network(demo: Path, fork_server: ForkServer, tmp_path: Path) -> None:
    pytest.importorskip("ai_edge_litert", reason="could not import ai_edge_litert")
    line = "{video} --out {out} --capture.detector litert --capture.max-frames 2"
    run_all(fork_server, {"capture": line}, video=demo / VIDEO, out=tmp_path)


def test_the_viewer_needs_no_network_but_the_loopback(demo: Path, fork_server: ForkServer, tmp_path: Path) -> None:
    avatar = make_portable(new_avatar("gaussian_avatars"), toy_camera(32), "toy")
    runtime.write_portable(tmp_path / "me.mien", avatar)
    viewer = fork_server.call("test_no_network:view_alone", str(tmp_path / "me.mien"))
    assert viewer.wait() == 0, viewer.stderr
    assert "<html" in viewer.stdout


def view_alone(avatar: str) -> None:
    """Raise the loopback of a new network namespace, show an avatar, and print the viewer's page."""
    assert leave_network()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        asked = struct.pack("16sH14x", b"lo", 0)
        _, flags = struct.unpack("16sH14x", fcntl.ioctl(any_socket, _FLAGS, asked))
        fcntl.ioctl(any_socket, _SET_FLAGS, struct.pack("16sH14x", b"lo", flags | _UP))
    print(page_of([sys.executable, "-m", "mien.cli", "view", avatar, "--port", "0"]))
