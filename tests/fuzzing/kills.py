"""Kill commands at random moments and run them again: `PYTHONPATH=tests python -m fuzzing.kills --kills 200`.

A chain begins with the files that an uninterrupted command found. The command is killed one to five times in a row, by
SIGKILL, SIGTERM or SIGINT, and then runs to its end. All files must have the bytes of the uninterrupted command.
"""

import os

os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1", MIEN_THREADS="1")

import argparse
import contextlib
import itertools
import json
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from random import Random
from typing import Any

from fuzzing.run_lines import Server
from fuzzing.same_bytes import differing_files, hidden_files

CLIP, FRAMES, SIDE = "clip.mp4", 10, 192
TRACK = (
    "--tracking.keyframes", "4", "--tracking.photometric.keyframes", "4", "--tracking.photometric.sizes", "64", "64",
    "--tracking.photometric.texture-size", "128", "--tracking.photometric.shared-steps", "1",
)  # fmt: skip
TRAIN = ("--preset", "draft", "--steps", "30", "--training.checkpoint-every", "4")
STAGES = {
    "capture": ("capture", CLIP, "--out", "W"),
    "track": ("track", "W", *TRACK),
    "train": ("train", "W", *TRAIN),
    "evaluate": ("evaluate", "W"),
    "export": ("export", "W", "--out", "me.mien"),
}
"""Name of a stage -> its command, in the order of a user."""
SIGNALS = {signal.SIGKILL: -signal.SIGKILL, signal.SIGTERM: 143, signal.SIGINT: 130}
"""Signal -> exit code of a command that has begun its work."""
_LATE = 1.1
"""Latest moment of a kill, as a multiple of the time of an uninterrupted command."""
_APART = 0.1
"""Share of commands that are new processes and not forks of one that has imported everything."""
_TO_END, _TO_FINISH = 60.0, 400.0
"""Seconds that a command has to end after a signal, and to finish undisturbed, on a busy machine."""
_ALONE = "import sys; sys.argv[0] = 'mien'; from mien.cli import main; sys.exit(main())"


@dataclass
class Tally:
    """Number of kills by stage and signal, and what was found."""

    kills: Counter[tuple[str, str]] = field(default_factory=Counter)
    late: int = 0
    """Signals to commands that had ended."""
    chains: Counter[str] = field(default_factory=Counter)
    leftovers: int = 0
    """Hidden files that stayed after chains with SIGKILL."""
    slowest: float = 0.0
    """Longest time from SIGTERM or SIGINT to the end of the process, in seconds."""
    findings: list[dict[str, Any]] = field(default_factory=list)

    def table(self) -> str:
        """Return the kills as a table of Markdown."""
        names = [signal.Signals(number).name for number in SIGNALS]
        rows = [f"| stage | {' | '.join(names)} | all | chains | findings |", "|---|" + "---|" * (len(names) + 3)]
        for stage in [*STAGES, "all"]:
            own = {key: count for key, count in self.kills.items() if stage in (key[0], "all")}
            counts = [sum(count for key, count in own.items() if key[1] == name) for name in names]
            chains = sum(self.chains.values()) if stage == "all" else self.chains[stage]
            found = sum(stage in (each["stage"], "all") for each in self.findings)
            rows.append(f"| {' | '.join(map(str, [stage, *counts, sum(counts), chains, found]))} |")
        more = f"{self.late} signals came too late; {self.leftovers} hidden files stayed after SIGKILL; "
        return "\n".join([*rows, more + f"at most {self.slowest:.1f} s from a signal to the end"])


class Place:
    """A folder in which commands run, always under the same path, and the files of the uninterrupted commands."""

    def __init__(self, folder: Path) -> None:
        self.box, self.told, self._kept = folder / "box", folder / "told.txt", folder / "kept"
        self.seconds: dict[str, float] = {}
        self._server = Server()

    def close(self) -> None:
        """Stop the server of forks."""
        self._server.close()

    def make_reference(self) -> None:
        """Draw a clip and run all stages undisturbed; keep the files before and after each."""
        from mien.lab.synthetic import RECIPES, write_synthetic_video

        recipe = RECIPES["demo"]
        self.box.mkdir(parents=True)
        small = replace(recipe, seconds=FRAMES / recipe.fps, width=SIDE, height=SIDE, supersample=1, texture_size=256)
        write_synthetic_video(small, self.box / CLIP, 0)
        for stage in STAGES:
            shutil.copytree(self.box, self._kept / f"before {stage}")
            began = time.monotonic()
            code, _ = self.run(stage, apart=False)
            self.seconds[stage] = time.monotonic() - began
            assert code == 0, f"{stage}: exit code {code}\n{self.told.read_text()[-2000:]}"
            shutil.copytree(self.box, self._kept / f"after {stage}")

    def begin(self, stage: str) -> None:
        """Put the files there that an uninterrupted command found."""
        shutil.rmtree(self.box)
        shutil.copytree(self._kept / f"before {stage}", self.box)

    def differences(self, stage: str) -> list[str]:
        """Return the names of the files that are not as an uninterrupted command leaves them."""
        return differing_files(self._kept / f"after {stage}", self.box)

    def run(
        self, stage: str, apart: bool, number: int | None = None, moment: float = _TO_FINISH
    ) -> tuple[int | None, float]:
        """Run a stage's command; return its exit code (None if it hangs) and its seconds after the signal.

        Args:
            stage: name of the stage.
            apart: whether the command is a new process.
            number: signal that the command gets at the moment.
            moment: seconds from the start; a command that has not ended by then and gets no signal hangs.
        """
        self.told.write_text("")
        command = _Alone(self) if apart else _Forked(self, self._server)
        command.start(list(STAGES[stage]))
        if command.ended(moment):
            return command.code(), -1.0
        sent = time.monotonic()
        with contextlib.suppress(ProcessLookupError):
            os.kill(command.pid, number or signal.SIGKILL)
        in_time = command.ended(_TO_END)
        if not in_time:
            with contextlib.suppress(OSError), self.told.open("a") as told:
                state = Path(f"/proc/{command.pid}/status").read_text().splitlines()[2]
                told.write(f"hangs: {state}, {Path(f'/proc/{command.pid}/stat').read_text().split()[13:15]} ticks\n")
            with contextlib.suppress(ProcessLookupError):
                os.kill(command.pid, signal.SIGKILL)
        code = command.code()
        return (code if in_time and number is not None else None), time.monotonic() - sent


class _Forked:
    """A command as a fork of a process that has imported everything."""

    def __init__(self, place: Place, server: Server) -> None:
        self._place, self._server, self.pid = place, server, 0

    def start(self, words: list[str]) -> None:
        told = str(self._place.told)
        request = {"words": words, "env": dict(os.environ), "folder": str(self._place.box), "stdin": os.devnull}
        self.pid = self._server.start(request | {"stdout": told, "stderr": told})

    def ended(self, seconds: float) -> bool:
        return self._server.ended(seconds)

    def code(self) -> int:
        return self._server.result()[0]


class _Alone:
    """A command as a process of its own, as a shell starts it."""

    def __init__(self, place: Place) -> None:
        self._place, self.pid = place, 0

    def start(self, words: list[str]) -> None:
        with self._place.told.open("w") as told:
            self._process = subprocess.Popen(
                [sys.executable, "-c", _ALONE, *words], cwd=self._place.box, stdin=subprocess.DEVNULL, stdout=told,
                stderr=told, preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL), start_new_session=True,
            )  # fmt: skip
        self.pid = self._process.pid

    def ended(self, seconds: float) -> bool:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(seconds)
            return True
        return False

    def code(self) -> int:
        return self._process.wait()


def run_chain(case: str, stage: str, place: Place, tally: Tally) -> None:
    """Kill a command once or several times, let it finish, and compare what it leaves."""
    dice, told, faults = Random(case), [], []
    place.begin(stage)
    hard = False
    for _ in range(dice.randint(1, 5)):
        number, apart = dice.choice(list(SIGNALS)), dice.random() < _APART
        moment = dice.uniform(0, _LATE * (place.seconds[stage] + (place.seconds["start"] if apart else 0)))
        code, after = place.run(stage, apart, number, moment)
        text = place.told.read_text(errors="replace")
        told.append(f"{signal.Signals(number).name} after {moment:.2f} s{', apart' * apart}: {code}; {text[-1500:]}")
        if code == 0:
            # It took less time than the last one: other programs may have used the cores then.
            place.seconds[stage] = min(place.seconds[stage], moment)
            tally.late += 1
            continue
        tally.kills[stage, signal.Signals(number).name] += 1
        hard |= number == signal.SIGKILL
        if number != signal.SIGKILL:
            tally.slowest = max(tally.slowest, after)
        faults += _faults(number, code, text)
    began = time.monotonic()
    code, _ = place.run(stage, apart=False)
    place.seconds[stage] = max(place.seconds[stage], time.monotonic() - began)
    told.append(f"then: {code}; {place.told.read_text(errors='replace')[-1500:]}")
    tally.chains[stage] += 1
    if code != 0:
        faults.append("does not go on")
    else:
        faults += [f"other bytes: {name}" for name in place.differences(stage)]
    left = hidden_files(place.box)
    tally.leftovers += len(left) if hard else 0
    if left and not hard:
        faults.append(f"left: {', '.join(sorted(left)[:5])}")
    if faults:
        tally.findings.append({"case": case, "stage": stage, "faults": faults, "told": told})


def _faults(number: int, code: int | None, told: str) -> list[str]:
    if code is None:
        return ["hangs"]
    if code == SIGNALS[signal.Signals(number)]:
        lines = [line for line in told.splitlines() if line.startswith("mien: ")]
        quiet = number == signal.SIGKILL or len(lines) == 1
        return ([] if quiet else ["not one line"]) + (["traceback"] if "Traceback" in told else [])
    # Before and after the work, a signal ends a process as it ends any other.
    return [] if code == -number else [f"exit code {code}"]


def main() -> int:
    """Run chains until there are so many kills or the time is over. The exit code is 1 if something was found."""
    parser = argparse.ArgumentParser(prog="fuzzing.kills", description=__doc__)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=None, help="begin no chain after so long")
    parser.add_argument("--only", nargs="*", choices=list(STAGES), default=list(STAGES), help="stages that are killed")
    parser.add_argument("--findings", type=Path, default=None, help="file of json lines for what is found")
    asked = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="mien-kills-"))
    tally, place = Tally(), Place(folder)
    until = None if asked.minutes is None else time.monotonic() + 60 * asked.minutes
    try:
        place.make_reference()
        place.seconds["start"] = _seconds_of_start()
        for chain in itertools.count():
            if sum(tally.kills.values()) >= asked.kills or (until is not None and time.monotonic() > until):
                break
            stage = asked.only[chain % len(asked.only)]
            run_chain(f"{stage}:{asked.seed}:{chain}", stage, place, tally)
            if chain % 5 == 0:
                print(f"{sum(tally.kills.values())} kills, {len(tally.findings)} findings", file=sys.stderr, flush=True)
    finally:
        place.close()
        shutil.rmtree(folder, ignore_errors=True)
    if asked.findings is not None:
        asked.findings.parent.mkdir(parents=True, exist_ok=True)
        asked.findings.write_text("".join(json.dumps(each) + "\n" for each in tally.findings))
    print(tally.table())
    for each in tally.findings:
        print(f"{each['case']}: {'; '.join(each['faults'])}")
    return int(bool(tally.findings))


def _seconds_of_start() -> float:
    began = time.monotonic()
    subprocess.run([sys.executable, "-c", "import mien.commands.stages.evaluating"], check=True)
    return time.monotonic() - began


if __name__ == "__main__":
    sys.exit(main())
