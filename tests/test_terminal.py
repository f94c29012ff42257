"""What a terminal shows is harmless and ends quietly, and odd places give the same bytes."""

import hashlib
import io
import os
import re
import subprocess
import sys
import threading
from dataclasses import dataclass
from functools import partial
from importlib.metadata import distribution
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console

from capture_helpers import write_face_clip
from forked import ForkServer
from mien import runtime
from mien.cli import main
from mien.disk import reading as bounded
from mien.disk.workspace import Workspace
from mien.errors import UserError
from mien.machine import progress, system
from mien.machine.progress import current_stage, progress_bar, say, stages
from mien.machine.stops import Put, Terminated
from mien.machine.terminal import plain_name, printable, show
from mien.machine.threads import MAX_THREADS, asked_threads, thread_count
from mien.pipeline import stage_times, track
from mien.pipeline.stage_times import StageTimes
from needs import find_test_data
from refusals import complaint, refuses
from shared_things import write_toy_workspace

NASTY = "\x1b[2J\x07\n[red]x[/red][/]:smile:\u202e\x9b\udcff.mp4"
SHOWN = r"\x1b[2J\x07\n[red]x[/red][/]:smile:\u202e\x9b\xff.mp4"


def test_what_acts_is_shown() -> None:
    assert (printable(NASTY), printable("a\nb\t", lines=True)) == (SHOWN, "a\nb\\t")
    for harmless in ("Köpfe und Leute", "頭.mp4", "👩\u200d💻 it's", r"C:\x1b", "a\xa0b"):
        assert printable(harmless) == harmless
    assert plain_name("a\x1b[2J\n\udcffb") == "a_[2J__b"


@pytest.mark.parametrize("is_terminal", [True, False])
def test_messages_and_bars_are_harmless(is_terminal: bool, monkeypatch, capsys) -> None:
    written = io.StringIO()
    console = Console(file=written, force_terminal=is_terminal, width=300, highlight=False, markup=False, emoji=False)
    monkeypatch.setattr(progress, "console", console)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: is_terminal, raising=False)
    say(f"warning: {NASTY}: odd")
    with progress_bar(f"find the face in {NASTY}", 2) as advance:
        advance(2, f"at {NASTY}")
    show(f"name: {NASTY}")
    out, err = capsys.readouterr()
    told = written.getvalue() + err
    assert all(part in told for part in (f"warning: {SHOWN}: odd\n", f"find the face in {SHOWN}", f"at {SHOWN}"))
    assert "\x1b[2J" not in told
    assert not {"\x07", "\x9b", "\u202e"} & set(told)
    assert out == "name: " + SHOWN.replace(r"\n", "\n") + "\n"


COMPLAINTS = {
    "missing": ["capture", NASTY, "--out", "out"], "command": [NASTY],
    "option": ["capture", "--out", NASTY, NASTY, "--bogus", NASTY],
    "choice": ["capture", "a.mp4", "--out", "out", "--capture.turn", NASTY],
    "workspace": ["render", NASTY, "--out", NASTY], "model": ["face-models", "--bake", NASTY],
}  # fmt: skip


@pytest.mark.parametrize("arguments", COMPLAINTS.values(), ids=COMPLAINTS)
def test_complaints_are_one_harmless_line(arguments: list[str], tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    assert complaint(capsys, *arguments).isprintable()


FULL = "mien: standard output: cannot be written (No space left on device); correct that and run the command again\n"


@pytest.mark.parametrize(("arguments", "code", "told"), [
    ("--version >&-", 0, ""),
    ("--version >/dev/full", 2, FULL),
    ("capture none.mp4 --out none 2>&-", 2, ""),
])  # fmt: skip
def test_closed_outputs_end_quietly(arguments: str, code: int, told: str) -> None:
    mien = f"'{sys.executable}' -c 'import sys; from mien.cli import main; sys.exit(main())'"
    done = subprocess.run(["bash", "-c", f"{mien} {arguments}"], stderr=subprocess.PIPE, text=True, check=False)
    assert (done.returncode, done.stderr) == (code, told)


@pytest.mark.parametrize(("words", "number"), [("--help", 1), ("licenses", 1), ("demo --out out", 2)])
def test_a_reader_that_is_gone_ends_the_command_quietly(fork_server: ForkServer, words: str, number: int) -> None:
    done = fork_server.call("test_terminal:into_a_broken_pipe", words.split(), number, exits=True)
    assert (done.wait(), done.stdout + done.stderr) == (141, "")


@dataclass(frozen=True)
class Hello:
    """A command that says something."""

    out: Path

    def check(self) -> None:
        """Accept everything."""

    def run(self) -> None:
        """Say something."""
        say("hello")


def into_a_broken_pipe(words: list[str], number: int) -> int:
    """Run a command in this process, which must be a fork, where nobody reads its output. `demo` only says hello."""
    sys.modules["mien.commands.demo"] = SimpleNamespace(Command=Hello)  # type: ignore[assignment]
    reading, writing = os.pipe()
    os.dup2(writing, number)
    os.close(reading)
    os.close(writing)
    return main(words)


def test_a_closed_output_is_not_taken_by_the_next_file(tmp_path: Path) -> None:
    """The next file that is opened does not take a closed output, or else a library's messages would land in it."""
    code = (
        "import sys, os; from mien.machine.terminal import open_closed_streams; open_closed_streams();"
        "file = open(sys.argv[1], 'wb'); os.write(1, b'chatter'); print('more'); sys.exit(file.fileno() < 3)"
    )
    path = tmp_path / "mine"
    done = subprocess.run(["bash", "-c", f"'{sys.executable}' -c \"{code}\" '{path}' >&- 2>&- <&-"], check=False)
    assert (done.returncode, path.read_bytes()) == (0, b"")


@pytest.mark.parametrize("text", ["0", "-1", "abc", "1025", "9" * 9000, "1.5", "\u0663", "\x1b[2J", "1 2"])
def test_threads_that_cannot_be_are_told(text: str, monkeypatch, capsys) -> None:
    monkeypatch.setenv("MIEN_THREADS", text)
    for ask in (thread_count, partial(runtime.load, Path("none.mien"))):
        refuses("give a number from 1 to 1024, or unset it", ask)
    told = complaint(capsys, "face-models")
    assert told.startswith(f"mien: MIEN_THREADS={printable(text)[:40]}")
    assert len(told) < 150


def test_threads_that_can_be(monkeypatch: pytest.MonkeyPatch) -> None:
    for text in ("1", "7", str(MAX_THREADS), " 2 "):
        monkeypatch.setenv("MIEN_THREADS", text)
        assert asked_threads() == thread_count() == int(text)
    monkeypatch.setenv("MIEN_THREADS", "")
    assert (asked_threads(), thread_count()) == (None, os.cpu_count())


class Clock:
    """Clock that a test sets."""

    def __init__(self) -> None:
        self.now = 0.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(progress, "time", clock)
    return clock


def test_stages_are_told(capsys) -> None:
    with stages("capture", "training") as begin:
        begin("training")
        assert current_stage() == "training"
    assert current_stage() is None
    assert capsys.readouterr().err == "stage 2 of 2 (training)\n"


def test_each_stage_has_its_seconds_and_cores_and_one_with_nothing_to_do_keeps_them(monkeypatch, tmp_path) -> None:
    clock, processor = Clock(), [0.0]
    monkeypatch.setattr(stage_times, "time", clock)
    monkeypatch.setattr(stage_times, "peak_memory_mb", lambda: 2000.0)
    monkeypatch.setattr(stage_times.os, "times", lambda: (processor[0] / 2, 0.0, processor[0] / 2, 0.0, 0.0))
    for capture, training in ((10.0, 20.0), (0.5, 15.0)):
        times = StageTimes(tmp_path / "stages.json")
        with stages("capture", "training") as tell, times.one_by_one(tell) as begin:
            for name, seconds in (("capture", capture), ("training", training)):
                begin(name)
                clock.now += seconds
                processor[0] += 1.5 * seconds
    assert StageTimes(tmp_path / "stages.json").seconds() == {"capture": 10.0, "training": 15.0}
    assert times.told() == "capture 10 s on 1.5 cores, training 15 s on 1.5 cores; 2.1 GB of memory"


def test_times_that_cannot_be_read_are_measured_anew(tmp_path) -> None:
    for content in ('{"format": "mien.stage_times", "version": 1, "stages": {"capture": {"seconds": "x"}}}', "[]"):
        (tmp_path / "stages.json").write_text(content)
        assert StageTimes(tmp_path / "stages.json").stages == {}


@pytest.mark.parametrize(("durations", "status", "told"), [
    ([10.0, 10.0], "clip", ["1/2 in 10 s; clip", "2/2 in 20 s; clip"]),
    (
        [100.0, 10.0, 10.0, *[0.0] * 17], "",
        ["1/20 in 100 s", "2/20 in 110 s", "3/20 in 120 s, ETA 170 s", "20/20 in 120 s"],
    ),
])  # fmt: skip
def test_a_slow_first_item_does_not_count_and_the_last_line_comes_once(
    durations: list[float], status: str, told: list[str], clock: Clock, capsys
) -> None:
    with progress_bar("Tracking", len(durations)) as advance:
        for seconds in durations:
            clock.now += seconds
            advance(status=status)
    assert capsys.readouterr().err.splitlines() == [f"Tracking: {each}" for each in told]


def test_work_beside_has_no_bar_and_its_error_is_told(monkeypatch, capsys) -> None:
    """Of two bars, one would spoil the other."""

    def show(*_: object) -> None:
        with progress_bar("Overlay", 2) as advance:
            advance(2)
        say("See report.html")
        raise UserError("the disk is full")

    monkeypatch.setattr(track, "show_trackings", show)
    meanwhile = track.showing_meanwhile(Workspace(Path()), [], "auto")
    with pytest.raises(UserError, match="the disk is full"), meanwhile, progress_bar("training", 1) as advance:
        advance()
    told = [line.partition(" in ")[0] for line in capsys.readouterr().err.splitlines()]
    assert sorted(told) == ["See report.html", "training: 1/1"]


@pytest.mark.parametrize("kind", [KeyboardInterrupt, Terminated])
def test_work_beside_ends_when_a_command_is_stopped(kind: type[BaseException], monkeypatch) -> None:
    asked, shown, ask = threading.Event(), [], Put.ask

    def show(*_: object) -> None:
        with progress_bar("Overlay", 2) as advance:
            assert asked.wait(60)
            advance()
            shown.append("the whole film")

    monkeypatch.setattr(track, "show_trackings", show)
    monkeypatch.setattr(Put, "ask", lambda *given: ask(*given) or asked.set())
    with pytest.raises(kind), track.showing_meanwhile(Workspace(Path()), [], "auto"):
        raise kind
    assert (asked.is_set(), shown) == (True, [])


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
    code = "import sys, test_terminal; test_terminal.work(*sys.argv[1:])"
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
    odd = "from mien import cli; cli.GROUPS['\\udcff \\u2022'] = {}; cli.main([])"
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
