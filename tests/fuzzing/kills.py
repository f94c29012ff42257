"""Kill commands at random moments and run them again: `PYTHONPATH=tests python -m fuzzing.kills --kills 200`.

A chain begins with the files that an uninterrupted command found. The command is killed one to five times in a row, by
SIGKILL, SIGTERM or SIGINT, and then runs to its end. All files must have the bytes of the uninterrupted command."""

import argparse
import itertools
import json
import os
import re
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

from safetensors.numpy import load_file

from forked import Forked, ForkServer
from mien.lab.synthetic import RECIPES
from mien.lab.synthetic.captures import write_synthetic_video

CLIP, FRAMES, SIDE = "clip.mp4", 10, 192
TRACK = (
    "--tracking.keyframes", "4", "--tracking.photometric.keyframes", "4", "--tracking.photometric.sizes", "64", "64",
    "--tracking.photometric.texture-size", "128", "--tracking.photometric.shared-steps", "1",
)  # fmt: skip
TRAIN = ("--preset", "draft", "--steps", "30", "--training.checkpoint-every", "4")
STAGES = {
    "capture": ("capture", CLIP, "--out", "W"), "track": ("track", "W", *TRACK), "train": ("train", "W", *TRAIN),
    "evaluate": ("evaluate", "W"), "export": ("export", "W", "--out", "me.mien"),
}  # fmt: skip
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
        rows = ["| stage | SIGKILL | SIGTERM | SIGINT | chains | findings |", "|---|---|---|---|---|---|"]
        for stage in STAGES:
            counts = [self.kills[stage, number.name] for number in SIGNALS]
            found = sum(each["stage"] == stage for each in self.findings)
            rows.append(f"| {' | '.join(map(str, [stage, *counts, self.chains[stage], found]))} |")
        more = f"{self.kills.total()} kills; {self.late} signals came too late; at most {self.slowest:.1f} s from one "
        return "\n".join([*rows, more + f"to the end; {self.leftovers} hidden files stayed after SIGKILL"])


class Place:
    """A folder in which commands run, always under the same path, and the files of the uninterrupted commands."""

    def __init__(self, folder: Path, server: ForkServer) -> None:
        """Draw a clip and run all stages undisturbed; keep the files before and after each."""
        self.box, self.kept, self._server = folder / "box", folder / "kept", server
        began, recipe = time.monotonic(), RECIPES["demo"]
        subprocess.run([sys.executable, "-c", "import mien.pipeline.evaluate"], check=True)
        self.seconds = {"start": time.monotonic() - began}
        self.box.mkdir(parents=True)
        small = replace(recipe, seconds=FRAMES / recipe.fps, width=SIDE, height=SIDE, supersample=1, texture_size=256)
        write_synthetic_video(small, self.box / CLIP, 0)
        for stage in STAGES:
            shutil.copytree(self.box, self.kept / f"before {stage}")
            began = time.monotonic()
            code, told, _ = self.run(stage)
            self.seconds[stage] = time.monotonic() - began
            assert code == 0, f"{stage}: exit code {code}\n{told[-2000:]}"
            shutil.copytree(self.box, self.kept / f"after {stage}")

    def run(
        self, stage: str, apart: bool = False, number: int = signal.SIGKILL, moment: float = _TO_FINISH
    ) -> tuple[int | None, str, float]:
        """Run a stage's command, as a fork or as a new process (`apart`), which gets a signal at a moment in seconds.
        Return the exit code (None if it hangs), what it told, and its seconds after the signal."""
        start = self._server.call("fuzzing.kills:run_anew", STAGES[stage], cwd=self.box, exits=True) if apart else None
        command = start or self._server.mien(*STAGES[stage], cwd=self.box)
        sent = time.monotonic()
        if not _ended(command, moment):
            sent = time.monotonic()
            command.send_signal(number)
            hangs = not _ended(command, _TO_END)
            command.kill()
            if hangs:
                return None, command.stdout + command.stderr, _TO_END
        return command.wait(), command.stdout + command.stderr, time.monotonic() - sent


def run_anew(words: list[str]) -> None:
    """Become a new Python that runs a command."""
    os.execv(sys.executable, [sys.executable, "-c", _ALONE, *words])


def _ended(command: Forked, seconds: float) -> bool:
    """Wait at most so long for the end of a command; return whether it has ended."""
    until = time.monotonic() + seconds
    while command.poll() is None and time.monotonic() < until:
        time.sleep(0.002)
    return command.poll() is not None


def run_chain(case: str, stage: str, place: Place, tally: Tally) -> None:
    """Put the files there that an uninterrupted command found, kill it up to five times, let it finish, and compare."""
    dice, told, faults, hard = Random(case), [], [], False
    shutil.rmtree(place.box)
    shutil.copytree(place.kept / f"before {stage}", place.box)
    for _ in range(dice.randint(1, 5)):
        number, apart = dice.choice(list(SIGNALS)), dice.random() < _APART
        moment = dice.uniform(0, _LATE * (place.seconds[stage] + (place.seconds["start"] if apart else 0)))
        code, text, after = place.run(stage, apart, number, moment)
        told.append(f"{number.name} after {moment:.2f} s{', apart' * apart}: {code}; {text[-1500:]}")
        if code == 0:
            # It took less time than the last one: other programs may have used the cores then.
            place.seconds[stage] = min(place.seconds[stage], moment)
            tally.late += 1
            continue
        tally.kills[stage, number.name] += 1
        hard |= number == signal.SIGKILL
        tally.slowest = max(tally.slowest, after if number != signal.SIGKILL else 0)
        faults += _faults(number, code, text)
    began = time.monotonic()
    code, text, _ = place.run(stage)
    place.seconds[stage] = max(place.seconds[stage], time.monotonic() - began)
    told.append(f"then: {code}; {text[-1500:]}")
    tally.chains[stage] += 1
    other = differing_files(place.kept / f"after {stage}", place.box)
    faults += [f"other bytes: {name}" for name in other] if code == 0 else ["does not go on"]
    left = sorted(hidden_files(place.box))
    tally.leftovers += len(left) if hard else 0
    faults += [f"left: {', '.join(left[:5])}"] if left and not hard else []
    if faults:
        tally.findings.append({"case": case, "stage": stage, "faults": faults, "told": told})


def _faults(number: signal.Signals, code: int | None, told: str) -> list[str]:
    if code is None:
        return ["hangs"]
    if code == SIGNALS[number]:
        lines = [line for line in told.splitlines() if line.startswith("mien: ")]
        quiet = number == signal.SIGKILL or len(lines) == 1
        return ([] if quiet else ["not one line"]) + (["traceback"] if "Traceback" in told else [])
    # Before and after the work, a signal ends a process as it ends any other.
    return [] if code == -number else [f"exit code {code}"]


# What two folders differ in, apart from what a clock or a meter has measured

_MEASURED = frozenset({"seconds", "seconds_per_frame", "step_ms_median", "peak_memory_mb", "fingerprint", "checksum"})
"""Entries of json files: times and memory, the times of files in a cache's fingerprint, and the sum over all."""
_MEASURED_TENSORS = frozenset({"step_ms", "curves.step_ms", "seconds", "peak_memory_mb"})
_MEASURED_TEXT = r"<b>[\d.]+ (?:m?s|min \d+ s)</b>|Peak memory [\d,.]+ MB|<h3>Step time, ms</h3>.*?</svg>"
"""Times, memory, and a chart of times."""


def differing_files(one: Path, other: Path) -> list[str]:
    """Return the names of the visible files in which two folders differ. Of checkpoints, both must have one: a stop
    leaves one of its own."""
    ours, theirs = visible_files(one), visible_files(other)
    alone = sorted(name for name in ours ^ theirs if "/checkpoints/" not in name)
    return alone + [name for name in sorted(ours & theirs) if not _same(one / name, other / name)]


def visible_files(folder: Path) -> set[str]:
    paths = {path.relative_to(folder) for path in folder.rglob("*") if path.is_file()}
    return {str(path) for path in paths if not any(part.startswith(".") for part in path.parts)}


def hidden_files(folder: Path) -> set[str]:
    """Return the paths of what is hidden: unfinished files, locks and kept pieces."""
    return {str(path.relative_to(folder)) for path in folder.rglob(".*")}


def _same(one: Path, other: Path) -> bool:
    return one.read_bytes() == other.read_bytes() or _content(one) == _content(other)


def _content(path: Path) -> Any:
    if path.suffix == ".json":
        return json.loads(path.read_text(), object_hook=_without_measured)
    if path.suffix == ".safetensors":
        tensors = load_file(path).items()
        return {name: (one.dtype, one.shape, one.tobytes()) for name, one in tensors if name not in _MEASURED_TENSORS}
    if path.suffix == ".html":
        return re.sub(_MEASURED_TEXT, "", path.read_text(), flags=re.DOTALL)
    return path.read_bytes()


def _without_measured(entries: dict[str, Any]) -> dict[str, Any]:
    return {name: each for name, each in entries.items() if name not in _MEASURED}


def main() -> int:
    """Run chains until there are so many kills or the time is over. The exit code is 1 if something was found."""
    parser = argparse.ArgumentParser(prog="fuzzing.kills", description=__doc__)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=None, help="begin no chain after so long")
    parser.add_argument("--only", nargs="*", choices=list(STAGES), default=list(STAGES), help="stages that are killed")
    parser.add_argument("--findings", type=Path, default=None, help="file of json lines for what is found")
    asked = parser.parse_args()
    os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1", MIEN_THREADS="1")
    tally = Tally()
    until = None if asked.minutes is None else time.monotonic() + 60 * asked.minutes
    with tempfile.TemporaryDirectory(prefix="mien-kills-") as folder, ForkServer() as server:
        place = Place(Path(folder), server)
        for chain in itertools.count():
            if sum(tally.kills.values()) >= asked.kills or (until is not None and time.monotonic() > until):
                break
            stage = asked.only[chain % len(asked.only)]
            run_chain(f"{stage}:{asked.seed}:{chain}", stage, place, tally)
            if chain % 5 == 0:
                print(f"{sum(tally.kills.values())} kills, {len(tally.findings)} findings", file=sys.stderr, flush=True)
    if asked.findings is not None:
        asked.findings.parent.mkdir(parents=True, exist_ok=True)
        asked.findings.write_text("".join(json.dumps(each) + "\n" for each in tally.findings))
    print(tally.table())
    for each in tally.findings:
        print(f"{each['case']}: {'; '.join(each['faults'])}")
    return int(bool(tally.findings))


if __name__ == "__main__":
    sys.exit(main())
