"""The workspace of a short `mien demo` with small pictures, made in a network namespace where there is one."""

import ctypes
import os
import socket
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from forked import ForkServer
from mien.cli import main
from needs import NO_NAMESPACE

DEMO = ("--seconds", "0.8", "--steps", "60")
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
    process = server.call("demo_case:write_demo", str(folder))
    assert process.wait() == 0, process.stderr[-2000:]
