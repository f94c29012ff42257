"""Signals and kills stop work in an orderly way: nothing is half-written, and commands continue to the same bytes."""

import contextlib
import importlib
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import pytest

from forked import Forked, ForkServer
from fuzzing.kills import SIGNALS, differing_files, hidden_files
from mien.cli import main
from mien.evaluation.protocols import PartialScores
from mien.machine import stops
from mien.machine.stops import EXIT_HUNG_UP, EXIT_TERMINATED, HungUp, Terminated, orderly_stops, stops_put_off
from mien.media.video import read_video_frames
from mien.pipeline import draw as pictures
from shared_things import write_toy_workspace
from two_commands import RANK, Studio, run, toy_studio

KINDS = {signal.SIGINT: KeyboardInterrupt, signal.SIGTERM: Terminated, signal.SIGHUP: HungUp}
of_every_kind = pytest.mark.parametrize("number", KINDS)


def orderly(number: signal.Signals, work: Callable[[], object]) -> None:
    with pytest.raises(KINDS[number]), orderly_stops():
        work()


@of_every_kind
def test_a_second_signal_does_not_interrupt_the_removal(number: signal.Signals) -> None:
    before = [signal.getsignal(each) for each in KINDS]
    removed = []

    def work() -> None:
        try:
            signal.raise_signal(number)
        finally:
            for each in KINDS:
                signal.raise_signal(each)
            removed.append("half a file")

    orderly(number, work)
    assert (removed, [signal.getsignal(each) for each in KINDS]) == (["half a file"], before)


@of_every_kind
def test_a_stop_that_is_dropped_comes_again(number: signal.Signals) -> None:
    """Python can only report an exception in a callback of a library, or in a finaliser. The stop is not lost."""

    class Finalised:
        def __del__(self) -> None:
            signal.raise_signal(number)

    def work() -> None:
        Finalised()
        for _ in range(2000):
            time.sleep(0.05)

    hook = sys.unraisablehook
    orderly(number, work)
    assert sys.unraisablehook is hook


@of_every_kind
def test_an_error_that_a_library_makes_of_a_stop_is_the_stop(number: signal.Signals) -> None:
    """Found by killing `mien capture` while it imported: ImportError: initialization failed."""

    def work() -> None:
        try:
            signal.raise_signal(number)
        except BaseException:  # noqa: BLE001
            raise ImportError("initialization failed") from None

    orderly(number, work)


def test_a_later_signal_counts_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """A library may swallow a stop. A user who stops once more is heard."""
    monkeypatch.setattr(stops, "DEAF_SECONDS", -1.0)

    def work() -> None:
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGTERM)

    orderly(signal.SIGTERM, work)


def test_other_errors_are_raised_and_reported_as_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    class Finalised:
        def __del__(self) -> None:
            raise ZeroDivisionError

    reported = []
    monkeypatch.setattr(sys, "unraisablehook", lambda dropped: reported.append(dropped.exc_type))
    with pytest.raises(ZeroDivisionError), orderly_stops():
        raise ZeroDivisionError(bool(Finalised()))
    assert reported == [ZeroDivisionError]


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, EXIT_TERMINATED), (signal.SIGHUP, EXIT_HUNG_UP)])
def test_without_a_command_a_stop_ends_the_process(number: signal.Signals, code: int, fork_server: ForkServer) -> None:
    """A program that trains without the command line ends as a terminated process does, without a traceback."""
    ended = fork_server.call("test_stops:stop_put_off", int(number))
    assert (ended.wait(), ended.stderr) == (code, "")


def stop_put_off(number: int) -> None:
    """Get a stop in the last step, which is not lost."""
    with stops_put_off():
        signal.raise_signal(number)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_background_commands_go_on_ignoring_what_they_ignore(number: signal.Signals) -> None:
    """A shell lets commands in the background ignore Ctrl-C, and nohup lets them ignore a closed terminal."""
    signal.signal(number, signal.SIG_IGN)
    with orderly_stops(), stops_put_off() as stop:
        signal.raise_signal(number)
        assert not stop.asked()


def test_other_threads_leave_signals_alone() -> None:
    before, seen = signal.getsignal(signal.SIGTERM), []

    def work() -> None:
        with orderly_stops(), stops_put_off() as stop:
            seen.extend([signal.getsignal(signal.SIGTERM), stop.asked()])

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [before, False]


FRAMES = 6
LOOK = ["--frames", str(FRAMES), "--size", "32"]
EVALUATE = ["--no-perceptual", "--json"]
CODES = {signal.SIGKILL: -signal.SIGKILL, signal.SIGTERM: 143, signal.SIGINT: 130}


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("interrupted") / "workspace"
    write_toy_workspace(folder, timesteps=20)
    return folder


def stop(server: ForkServer, words: list[str], steps: int, how: signal.Signals) -> Forked:
    """Run a command to its end in another process that gets a signal when this many pictures are done."""
    process = server.call("test_stops:stop_itself", words, steps, int(how), exits=True)
    process.wait()
    return process


def stop_itself(words: list[str], steps: int, number: int) -> int:
    done = 0

    def counted(original: Callable[..., Any]) -> Callable[..., Any]:
        def step(*arguments: Any) -> Any:
            nonlocal done
            result = original(*arguments)
            done += 1
            if done == steps:
                os.kill(os.getpid(), number)
            return result

        return step

    pictures.draw, PartialScores.add = counted(pictures.draw), counted(PartialScores.add)
    return main(words)


def visible(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if not path.name.startswith("."))


def content(path: Path) -> list[bytes]:
    """Return the bytes of a file. A .webm holds a random number, so that its pictures are returned."""
    if path.suffix == ".webm":
        return [frame.tobytes() for _, frame in read_video_frames(path)]
    return [path.read_bytes()]


@pytest.mark.unchecked
@pytest.mark.usefixtures("short_films")
@pytest.mark.parametrize(("name", "how"), [
    ("a.mp4", signal.SIGKILL), ("a.webm", signal.SIGINT), ("a.png", signal.SIGINT), ("a_%06d.png", signal.SIGTERM),
    ("pictures", signal.SIGKILL),
])  # fmt: skip
def test_stopped_rendering_ends_alike_the_next_time(name: str, how: signal.Signals, fork_server, workspace, tmp_path):
    """A stopped rendering leaves the old file until the new one is whole. Every numbered picture is whole."""
    command = ["render", str(workspace), *LOOK, "--out"]
    undisturbed, out = tmp_path / "undisturbed", tmp_path / "out"
    assert main([*command, str(undisturbed / name)]) == 0
    several = name in ("a_%06d.png", "pictures")
    if not several:
        out.mkdir()
        (out / name).write_text("mine")
    stopped = stop(fork_server, [*command, str(out / name)], 1 if name == "a.png" else 3, how)
    assert stopped.poll() == CODES[how]
    assert ("the same command" in stopped.stderr) == (how != signal.SIGKILL)
    folder = out / "pictures" if name == "pictures" else out
    if several:
        assert len(visible(folder)) == 2
        assert all(cv2.imread(str(folder / each)) is not None for each in visible(folder))
    else:
        assert (visible(folder), (out / name).read_text()) == ([name], "mine")
    assert how == signal.SIGKILL or len(visible(folder)) == len(list(folder.iterdir())), "something half-written stays"
    assert main([*command, str(out / name)]) == 0
    files = [path for path in undisturbed.rglob("*") if path.is_file()]
    assert len(files) == (FRAMES if several else 1)
    assert all(content(out / path.relative_to(undisturbed)) == content(path) for path in files)


@pytest.fixture(scope="module")
def evaluated(workspace: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A workspace whose run was scored undisturbed."""
    folder = shutil.copytree(workspace, tmp_path_factory.mktemp("evaluated") / "workspace")
    assert main(["evaluate", str(folder), *EVALUATE]) == 0
    return folder


@pytest.mark.unchecked
@pytest.mark.usefixtures("short_films")
def test_figures_stay_whole_where_the_report_is_interrupted(evaluated: Path, tmp_path: Path, monkeypatch) -> None:
    folder = shutil.copytree(evaluated, tmp_path / "w")
    run = folder / "runs/toy"
    before = (run / "metrics.json").read_bytes()

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    for part in ("write_report", "write_comparison_video"):
        with monkeypatch.context() as patched:
            patched.setattr(importlib.import_module("mien.evaluation.evaluate"), part, interrupted)
            assert main(["evaluate", str(folder), *EVALUATE]) == 130
        assert (run / "metrics.json").read_bytes() == before
    assert main(["evaluate", str(folder), *EVALUATE]) == 0
    assert [path.name for path in run.rglob(".*")] == []


STAGES = {
    "capture": ("capture {pictures} --out {box}/new --name clip", signal.SIGKILL, 2),
    "train": ("train {box} --run new --steps 6 --split tail --training.checkpoint-every 2", signal.SIGTERM, 3),
    "evaluate": ("evaluate {box} --run alone --no-perceptual", signal.SIGKILL, 1),
    "export": ("export {box} --run alone --out {box}/me.mien", signal.SIGKILL, 1),
}
"""Name of a stage -> its command, a signal, and before which of its files it comes."""


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Studio]:
    folder = tmp_path_factory.mktemp("kills")
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("MIEN_CACHE", str(folder / "cache"))
        made = toy_studio(folder / "studio", folder / "cache")
        assert main(["train", str(made.root), "--run", "alone", "--steps", "3", "--split", "tail", *RANK]) == 0
        yield made


@pytest.mark.unchecked
@pytest.mark.parametrize("stage", STAGES)
def test_a_command_that_is_stopped_before_it_puts_a_file_in_place_goes_on(
    stage: str, studio: Studio, fork_server: ForkServer, tmp_path: Path
) -> None:
    line, number, file = STAGES[stage]
    box, whole = tmp_path / "box", tmp_path / "whole"
    words = [word.format(box=box, pictures=studio.video) for word in line.split()]
    words += studio.capture_options if stage == "capture" else RANK if stage == "train" else []
    shutil.copytree(studio.root, box)
    assert fork_server.call("two_commands:run", words, exits=True).wait() == 0
    box.rename(whole)
    shutil.copytree(studio.root, box)
    stopped = fork_server.call("test_stops:run_until_a_file", words, int(number), file, exits=True)
    assert stopped.wait() == SIGNALS[number]
    assert differing_files(whole, box) != [], "the command was not stopped"
    assert fork_server.call("two_commands:run", words, exits=True).wait() == 0
    assert differing_files(whole, box) == []
    assert number == signal.SIGKILL or not hidden_files(box)


def run_until_a_file(words: list[str], number: int, file: int) -> int:
    """Run a command in this process, which must be a fork, and send it a signal before it puts a file in place."""
    replace, count = Path.replace, 0

    def counted(self: Path, target: str | os.PathLike[str]) -> Path:
        nonlocal count
        count += 1
        if count == file:
            os.kill(os.getpid(), number)
        return replace(self, target)

    Path.replace = counted
    return run(words)


@pytest.mark.long
def test_random_kills_leave_nothing_to_do_by_hand(tmp_path: Path) -> None:
    seed, findings = os.environ.get("MIEN_SEED", "0"), tmp_path / "kills.jsonl"
    words = ["-m", "fuzzing.kills", "--kills", "12", "--seed", seed, "--findings", str(findings)]
    result = subprocess.run([sys.executable, *words], cwd=Path(__file__).parent, capture_output=True, text=True)
    assert result.returncode == 0, f"seed {seed}:\n{result.stdout}\n{result.stderr[-3000:]}\n{findings.read_text()}"
    assert " kills; " in result.stdout
