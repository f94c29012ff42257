"""Odd places give the same bytes, and what Linux, macOS and Windows do differently is in mien.system alone."""

import hashlib
import os
import re
import subprocess
import sys
from importlib.metadata import distribution
from pathlib import Path

import pytest

from capture_helpers import write_face_clip
from mien import bounded, system
from mien.cli import main
from needs import find_test_data
from toy_workspace import write_toy_workspace

OF_PLACES = ("LANG", "LC_ALL", "LC_CTYPE", "PYTHONUTF8", "PYTHONIOENCODING", "HOME", "XDG_CACHE_HOME", "MIEN_THREADS")
ASCII = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
ODD = {"MIEN_THREADS": "64", "ONE_CORE": "1", "HOME": "/proc/nowhere", **ASCII}
"""More threads than cores, one core, no home, and a locale without umlauts."""


def run_python(arguments: list[str], environment: dict[str, str], folder: Path | None = None) -> str:
    """Run Python without this process's locale, home and threads, and return its output."""
    kept = {name: value for name, value in os.environ.items() if name not in OF_PLACES}
    environment = {**kept, "PYTHONPATH": str(Path(__file__).parent), **environment}
    done = subprocess.run([sys.executable, *arguments], cwd=folder, env=environment, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()
    return done.stdout.decode()


def work(place: str, *clips: str) -> None:
    """Write into `place` a toy workspace and a capture of a clip's first frames. Names may have any encoding."""
    if os.environ.get("ONE_CORE"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    print(f"working in {place}")
    write_toy_workspace(Path(place, "toy"))
    options = ["--capture.size", "96", "--capture.max-frames", "3"]
    for clip in clips:
        assert main(["capture", clip, "--out", str(Path(place, "captured")), *options]) == 0


def hashes(place: Path) -> dict[str, str]:
    """Return digests of the files that are the same everywhere. Curves hold times, so they are left out."""
    files = [path for kind in ("*.png", "*.safetensors") for path in place.rglob(kind)]
    return {
        str(path.relative_to(place)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(files)
        if path.parent.name != "checkpoints" and path.stem != "curves"
    }


@pytest.mark.unchecked
def test_the_same_bytes_in_odd_places(tmp_path: Path) -> None:
    plain, odd, clips, test_data = tmp_path / "plain", tmp_path / "Köpfe & Gemälde" / "a place", [], find_test_data()
    if test_data is not None:
        clips = [str(tmp_path / "Frau Müller.mp4")]
        write_face_clip(Path(clips[0]), test_data, frames=3)
    plain.mkdir()
    work(str(plain), *clips)
    expected = hashes(plain)
    assert "toy/runs/toy/avatar/avatar.safetensors" in expected
    odd.mkdir(parents=True)
    code = "import sys, test_places; test_places.work(*sys.argv[1:])"
    assert "working in" in run_python(["-c", code, str(odd), *clips], ODD, odd)
    # If names are not UTF-8, a sequence's name gets "_" for what the locale lacks. Its content is the same.
    found = {name.replace("Frau M__ller", "Frau Müller"): digest for name, digest in hashes(odd).items()}
    assert found == expected


def test_help_and_names_are_printed_in_any_locale() -> None:
    """Help has characters that ASCII lacks, and names need not be UTF-8."""
    # An absolute path with an umlaut in a .pth file would stop Python under LC_ALL=C.
    for path in Path(str(distribution("mien").locate_file(""))).glob("*mien*.pth"):
        assert path.read_bytes().isascii(), f"{path}: run `make setup`"
    help_of_all = "from mien.cli import main; main(['bench', '--help-all'])"
    assert "mien bench" in run_python(["-c", help_of_all], ASCII)
    odd = "from mien import cli; cli.GROUPS['\\udcff \\u2022'] = (); cli.main([])"
    assert "\\xff \u2022:" in run_python(["-c", odd], {"LC_ALL": "C.UTF-8"})


SOURCE = Path(__file__).resolve().parents[1] / "src" / "mien"
OF_ONE_SYSTEM = re.compile(
    r"\bimport (?:fcntl|resource|termios|pwd|grp|pty|tty|syslog|msvcrt|winreg)\b"
    r"|\bfrom (?:fcntl|resource|termios|pwd|grp|pty|tty|syslog|msvcrt|winreg)\b"
    r"|\bos\.(?:pread|pwrite|kill|killpg|fork|setsid|getuid|geteuid|getloadavg|uname|mkfifo|setpriority|O_NOFOLLOW"
    r"|O_NONBLOCK|O_DIRECTORY|O_CLOEXEC|O_BINARY|sched_getaffinity|statvfs|fchmod)\b"
    r"|\bsignal\.(?:SIGHUP|SIGKILL|SIGUSR1|SIGALRM|SIGBREAK|pthread_kill|alarm)\b"
)
"""Modules and names of Python that one of the systems lacks."""


def test_only_mien_system_knows_systems_apart():
    files = {path: path.read_text(encoding="utf-8") for path in SOURCE.rglob("*.py") if path.name != "system.py"}
    assert len(files) > 300
    assert {str(path): found for path, text in files.items() if (found := OF_ONE_SYSTEM.findall(text))} == {}
    found = OF_ONE_SYSTEM.findall("import fcntl; os.kill(1, 0); signal.SIGHUP; os.getpid(); from pty import spawn")
    assert found == ["import fcntl", "os.kill", "signal.SIGHUP", "from pty"]


def test_processes_that_have_ended_do_not_live_and_the_peak_of_memory_grows_with_what_is_taken():
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as child:
        assert system.may_live(child.pid)
        child.communicate(b"\n")
    assert not system.may_live(child.pid)
    assert system.may_live(os.getpid())
    before = system.peak_memory_mb()
    assert 5 < before < 100_000
    taken = bytearray(round((before + 40) * 2**20))
    taken[:: 2**12] = b"1" * len(taken[:: 2**12])
    assert system.peak_memory_mb() > before + 20


def test_links_and_pipes_are_kept_out_with_and_without_a_flag_of_the_system(tmp_path, monkeypatch):
    assert system.NO_WAIT
    assert system.NO_LINK
    (tmp_path / "file").write_bytes(b"here")
    (tmp_path / "link").symlink_to(tmp_path / "file")
    monkeypatch.setattr(bounded, "NO_LINK", 0)
    for name, follows in (("file", False), ("link", True)):
        os.close(bounded.open_handle(tmp_path / name, os.O_RDONLY, follow_link=follows))
    pytest.raises(bounded.NotOrdinaryError, bounded.open_handle, tmp_path / "link", os.O_RDONLY, follow_link=False)
