"""What Linux, macOS and Windows do differently is in mien.system alone, and its functions answer here."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

from mien import system

SOURCE = Path(__file__).resolve().parents[1] / "src" / "mien"
MODULES = {"fcntl", "resource", "termios", "pwd", "grp", "pty", "tty", "syslog", "msvcrt", "winreg"}
"""Modules of Python that one of the systems lacks."""
OS_NAMES = {
    "pread", "pwrite", "kill", "killpg", "fork", "setsid", "getuid", "geteuid", "getloadavg", "uname", "mkfifo",
    "setpriority", "O_NOFOLLOW", "O_NONBLOCK", "O_DIRECTORY", "O_CLOEXEC", "O_BINARY", "sched_getaffinity", "statvfs",
    "fchmod",
}  # fmt: skip
SIGNAL_NAMES = {"SIGHUP", "SIGKILL", "SIGUSR1", "SIGALRM", "SIGBREAK", "pthread_kill", "alarm"}


def of_one_system(source: str) -> list[str]:
    """What of a source text is missing on some system."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found += [each.name for each in node.names if each.name.split(".")[0] in MODULES]
        elif isinstance(node, ast.ImportFrom) and node.module in MODULES:
            found.append(node.module)
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            names = {"os": OS_NAMES, "signal": SIGNAL_NAMES}.get(node.value.id, set())
            found += [f"{node.value.id}.{node.attr}"] if node.attr in names else []
    return found


def test_only_mien_system_knows_systems_apart():
    files = {path: path.read_text(encoding="utf-8") for path in SOURCE.rglob("*.py") if path.name != "system.py"}
    assert len(files) > 300
    assert set(of_one_system("import fcntl; os.kill(1, 0); signal.SIGHUP; os.getpid()")) == {
        "fcntl", "os.kill", "signal.SIGHUP",
    }  # fmt: skip
    assert {str(path): found for path, text in files.items() if (found := of_one_system(text))} == {}


def test_processes_that_have_ended_do_not_live():
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as child:
        assert system.may_live(child.pid)
        child.communicate(b"\n")
    assert not system.may_live(child.pid)
    assert system.may_live(os.getpid())


def test_the_peak_of_memory_grows_with_what_is_taken():
    before = system.peak_memory_mb()
    assert 5 < before < 100_000
    taken = bytearray(round((before + 40) * 2**20))
    taken[:: 2**12] = b"1" * len(taken[:: 2**12])
    assert system.peak_memory_mb() > before + 20


def test_bytes_are_written_and_read_at_an_offset(tmp_path):
    with (tmp_path / "file").open("w+b", buffering=0) as file:
        assert system.write_at(file.fileno(), b"abcdef", 0) == 6
        assert system.write_at(file.fileno(), memoryview(b"XY"), 2) == 2
        assert system.read_at(file.fileno(), 3, 1) == b"bXY"
        assert system.read_at(file.fileno(), 9, 6) == b""


@pytest.mark.parametrize("flag", [system.NO_WAIT, system.NO_LINK])
def test_this_system_has_the_flags_that_keep_links_and_pipes_out(flag):
    assert flag


def test_without_a_flag_against_links_they_are_refused_all_the_same(tmp_path, monkeypatch):
    from mien import bounded

    (tmp_path / "file").write_bytes(b"here")
    (tmp_path / "link").symlink_to(tmp_path / "file")
    monkeypatch.setattr(bounded, "NO_LINK", 0)
    os.close(bounded.open_handle(tmp_path / "file", os.O_RDONLY, follow_link=False))
    os.close(bounded.open_handle(tmp_path / "link", os.O_RDONLY, follow_link=True))
    with pytest.raises(bounded.NotOrdinaryError):
        bounded.open_handle(tmp_path / "link", os.O_RDONLY, follow_link=False)
