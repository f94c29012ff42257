"""Commands that are killed continue to the same bytes, and nothing has to be removed by hand.
`make kills KILLS=200` does at length what the test marked `long` does with a few kills."""

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from forked import ForkServer
from fuzzing.kills import SIGNALS, differing_files, hidden_files
from mien.cli import main
from two_commands import RANK, Studio, run, toy_studio

STAGES = {
    "capture": ("capture {pictures} --out {box}/new --name clip", signal.SIGKILL, 2),
    "train": ("train {box} --run new --steps 6 --split tail --training.checkpoint-every 2", signal.SIGTERM, 3),
    "evaluate": ("evaluate {box} --run alone --no-perceptual", signal.SIGINT, 1),
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
    stopped = fork_server.call("test_kills:run_until_a_file", words, int(number), file, exits=True)
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
