"""Control characters are shown instead of sent to a terminal, and a closed output ends a command quietly."""

import io
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console

from forked import ForkServer, run_forked
from mien import progress, terminal
from mien.cli import main
from mien.commands.stages.names import sequence_name
from mien.errors import UserError
from mien.progress import progress_bar, say
from mien.terminal import counted, plain_name, printable, show
from mien.threads import MAX_THREADS, asked_threads, thread_count

NASTY = "\x1b[2J\x07\n[red]x[/red][/]:smile:\u202e\x9b\udcff.mp4"
SHOWN = r"\x1b[2J\x07\n[red]x[/red][/]:smile:\u202e\x9b\xff.mp4"


def test_what_acts_is_shown() -> None:
    assert printable(NASTY) == SHOWN
    assert printable("a\nb\t", lines=True) == "a\nb\\t"
    for harmless in ("Köpfe und Leute", "頭.mp4", "👩\u200d💻 it's", r"C:\x1b", "a\xa0b"):
        assert printable(harmless) == harmless
    assert plain_name("a\x1b[2J\n\udcffb") == "a_[2J__b"


@pytest.mark.parametrize("is_terminal", [True, False])
def test_messages_and_bars_are_harmless(
    is_terminal: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
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
    assert f"warning: {SHOWN}: odd\n" in told
    assert f"find the face in {SHOWN}" in told
    assert f"at {SHOWN}" in told
    assert "\x1b[2J" not in told + out
    assert not {"\x07", "\x9b", "\u202e"} & set(told + out)
    assert out == "name: " + SHOWN.replace(r"\n", "\n") + "\n"


COMPLAINTS = {
    "missing": ["capture", NASTY, "--out", "out"],
    "command": [NASTY],
    "option": ["capture", "--out", NASTY, NASTY, "--bogus", NASTY],
    "choice": ["capture", "a.mp4", "--out", "out", "--capture.turn", NASTY],
    "workspace": ["render", NASTY, "--out", NASTY],
    "model": ["face-models", "--bake", NASTY],
}


@pytest.mark.parametrize("arguments", COMPLAINTS.values(), ids=COMPLAINTS)
def test_complaints_are_one_harmless_line(
    arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert told.strip().isprintable()


def test_a_bug_with_an_odd_name_is_written_down(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(_: object) -> None:
        raise RuntimeError(NASTY)

    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr(sys, "argv", ["mien", NASTY])
    monkeypatch.setattr("mien.workspace.Workspace.sequence_names", fail)
    assert main(["track", str(tmp_path)]) == 1
    assert "\x1b" not in capsys.readouterr().err
    (log,) = tmp_path.glob("mien-crash-*.log")
    assert "RuntimeError" in log.read_text()


def test_names_of_videos_become_names_of_folders() -> None:
    assert sequence_name(Path(NASTY.replace("/", "")), None) == "_[2J__[red]x[red][]:smile:___"
    assert sequence_name(Path("take:1.mp4"), None) == "take:1"


@pytest.mark.parametrize(
    ("arguments", "output", "code", "words"),
    [
        ("--version", ">&-", 0, ""),
        ("--version", ">/dev/full", 2, "standard output: cannot be written (No space left on device)"),
        ("capture none.mp4 --out none", "2>&-", 2, ""),
    ],
)
def test_closed_outputs_end_quietly(arguments: str, output: str, code: int, words: str) -> None:
    mien = f"'{sys.executable}' -c 'import sys; from mien.cli import main; sys.exit(main())'"
    script = f"{mien} {arguments} {output}"
    done = subprocess.run(["bash", "-c", script], stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == code
    assert words in done.stderr
    assert done.stderr.count("\n") == (1 if words else 0)


@pytest.mark.parametrize("words", [["--help"], ["bench", "--help"], ["licenses"]])
def test_a_reader_that_is_gone_ends_the_command_quietly(fork_server: ForkServer, words: list[str]) -> None:
    done = fork_server.call("test_terminal:into_a_broken_pipe", words, 1, exits=True)
    assert (done.wait(), done.stderr) == (141, "")


def test_progress_that_nobody_reads_ends_the_command_quietly(fork_server: ForkServer, tmp_path: Path) -> None:
    done = fork_server.call("test_terminal:into_a_broken_pipe", ["demo", "--out", str(tmp_path)], 2, exits=True)
    assert (done.wait(), done.stdout) == (141, "")


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
        "import sys, os; from mien.terminal import open_closed_streams; open_closed_streams();"
        "file = open(sys.argv[1], 'wb'); os.write(1, b'chatter'); print('more'); sys.exit(file.fileno() < 3)"
    )
    path = tmp_path / "mine"
    done = subprocess.run(["bash", "-c", f"'{sys.executable}' -c \"{code}\" '{path}' >&- 2>&- <&-"], check=False)
    assert done.returncode == 0
    assert path.read_bytes() == b""


@pytest.mark.parametrize(
    "text", ["0", "-1", "abc", "100000", "1" + 30 * "0", "9" * 9000, "1.5", "\u0663", "\x1b[2J", "1 2"]
)
def test_threads_that_cannot_be_are_told(
    text: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("MIEN_THREADS", text)
    with pytest.raises(UserError, match="give a number from 1 to 1024, or unset it"):
        thread_count()
    assert main(["face-models"]) == 2
    told = capsys.readouterr().err
    assert told.startswith(f"mien: MIEN_THREADS={printable(text)[:40]}")
    assert told.count("\n") == 1
    assert len(told) < 150


def test_threads_that_can_be(monkeypatch: pytest.MonkeyPatch) -> None:
    for text in ("1", "7", str(MAX_THREADS), " 2 "):
        monkeypatch.setenv("MIEN_THREADS", text)
        assert asked_threads() == thread_count() == int(text)
    monkeypatch.setenv("MIEN_THREADS", "")
    assert asked_threads() is None
    assert thread_count() == os.cpu_count()


def test_the_runtime_tells_them_too(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from mien import runtime

    monkeypatch.setenv("MIEN_THREADS", "100000")
    with pytest.raises(UserError, match="MIEN_THREADS=100000"):
        runtime.load(tmp_path / "none.mien")


def test_the_door_needs_no_library(tmp_path: Path) -> None:
    assert terminal.__doc__
    code = "import sys, mien.terminal, mien.threads; sys.exit(bool({'torch', 'rich', 'numpy'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_instructions_that_the_machine_lacks_are_told(fork_server: ForkServer, tmp_path: Path) -> None:
    ended = run_forked(fork_server, "demo", "--out", tmp_path / "demo", env={"MIEN_ISA": "mmx"})
    assert ended.returncode == 2
    assert ended.stderr.startswith("mien: MIEN_ISA=mmx: this machine has ")
    assert len(ended.stderr.splitlines()) == 1
    assert not (tmp_path / "demo").exists()


def test_a_number_agrees_with_its_noun() -> None:
    told = [counted(count, "frame") for count in (0, 1, 2, 12_000)]
    assert told == ["0 frames", "1 frame", "2 frames", "12,000 frames"]
