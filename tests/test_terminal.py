"""Control characters are shown instead of sent to a terminal, and a closed output ends a command quietly."""

import io
import os
import subprocess
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console

from forked import ForkServer, run_forked
from mien import progress, runtime
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
    "missing": ["capture", NASTY, "--out", "out"],
    "command": [NASTY],
    "option": ["capture", "--out", NASTY, NASTY, "--bogus", NASTY],
    "choice": ["capture", "a.mp4", "--out", "out", "--capture.turn", NASTY],
    "workspace": ["render", NASTY, "--out", NASTY],
    "model": ["face-models", "--bake", NASTY],
}


@pytest.mark.parametrize("arguments", COMPLAINTS.values(), ids=COMPLAINTS)
def test_complaints_are_one_harmless_line(arguments: list[str], tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert told.strip().isprintable()


def test_names_of_videos_become_names_of_folders() -> None:
    assert sequence_name(Path(NASTY.replace("/", "")), None) == "_[2J__[red]x[red][]:smile:___"
    assert sequence_name(Path("take:1.mp4"), None) == "take:1"


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
        "import sys, os; from mien.terminal import open_closed_streams; open_closed_streams();"
        "file = open(sys.argv[1], 'wb'); os.write(1, b'chatter'); print('more'); sys.exit(file.fileno() < 3)"
    )
    path = tmp_path / "mine"
    done = subprocess.run(["bash", "-c", f"'{sys.executable}' -c \"{code}\" '{path}' >&- 2>&- <&-"], check=False)
    assert done.returncode == 0
    assert path.read_bytes() == b""


@pytest.mark.parametrize("text", ["0", "-1", "abc", "1025", "9" * 9000, "1.5", "\u0663", "\x1b[2J", "1 2"])
def test_threads_that_cannot_be_are_told(text: str, monkeypatch, capsys) -> None:
    monkeypatch.setenv("MIEN_THREADS", text)
    for ask in (thread_count, partial(runtime.load, Path("none.mien"))):
        with pytest.raises(UserError, match="give a number from 1 to 1024, or unset it"):
            ask()
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
    assert (asked_threads(), thread_count()) == (None, os.cpu_count())


def test_instructions_that_the_machine_lacks_are_told(fork_server: ForkServer, tmp_path: Path) -> None:
    ended = run_forked(fork_server, "demo", "--out", tmp_path / "demo", env={"MIEN_ISA": "mmx"})
    assert (ended.returncode, ended.stderr.count("\n")) == (2, 1)
    assert ended.stderr.startswith("mien: MIEN_ISA=mmx: this machine has ")
    assert not (tmp_path / "demo").exists()


def test_a_number_agrees_with_its_noun() -> None:
    told = [counted(count, "frame") for count in (0, 1, 2, 12_000)]
    assert told == ["0 frames", "1 frame", "2 frames", "12,000 frames"]
