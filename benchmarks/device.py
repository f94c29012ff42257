"""Run on a GPU what needs one, in eight minutes, and print a table that can be sent to the project.

    make gpu                                                              # installs gsplat, then runs this
    python benchmarks/device.py --out out/gpu --video CLIP                # with a clip of your own

The parts are the tests marked gpu, a training step of each method with 30,000 and 100,000 Gaussians, `mien create` on a
clip (a synthetic head if none is given) with the seconds of its stages, and the paper's preset of each method on that
clip, which share the time that is left. A part that fails says so in the table, one that takes too long says how far it
came, and the next one runs. The output of each part is in the folder, with a line of a curve every ten seconds.
"""

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path

from mien.avatar.methods import METHODS

BUDGET = 480.0
"""Seconds that all parts take together at most. gsplat's compilation is one of them."""
_TESTS, _STEP, _CREATE = 120.0, 30.0, 150.0
"""Most seconds of the tests, of a method's steps and of `mien create`."""


@dataclass(frozen=True)
class Row:
    """A line of the table."""

    part: str
    result: str
    seconds: float


@dataclass
class Clock:
    """The seconds that are left of the budget."""

    end: float

    def left(self, most: float) -> float:
        """Seconds that a part may take."""
        return max(0.0, min(most, self.end - time.monotonic()))


Run = Callable[[str, list[str], float], tuple[int, str, str]]
"""Runs a command under a name for some seconds at most: its status, or 124 if they were over, output and errors."""


def runner(folder: Path) -> Run:
    """Run programs that lie beside this Python, and keep their output in a folder."""
    programs = Path(sys.executable).parent

    def run(name: str, command: list[str], seconds: float) -> tuple[int, str, str]:
        out, errors = folder / f"{name}.txt", folder / f"{name}.errors.txt"
        with out.open("w") as one, errors.open("w") as other:
            process = subprocess.Popen([programs / command[0], *command[1:]], stdout=one, stderr=other)
            try:
                status = process.wait(seconds)
            except subprocess.TimeoutExpired:
                process.terminate()  # An orderly stop says how far it came.
                try:
                    process.wait(10)
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait()
                status = 124
        return status, out.read_text(), errors.read_text()

    return run


def rows(run: Run, methods: tuple[str, ...], video: Path, workspace: Path, clock: Clock) -> Iterator[Row]:
    """Run all parts."""
    yield measured("tests", ["pytest", "-q", "-m", "gpu"], clock.left(_TESTS), run, _last_line)
    for method in methods:
        command = ["mien", "bench", "train-step", "--method", method, "--device", "cuda", "--json", "--seconds", "1.5"]
        yield measured(f"step-{method}", command, clock.left(_STEP), run, steps_in)
    command = ["mien", "create", str(video), "--out", str(workspace), "--device", "cuda"]
    yield measured("create", command, clock.left(_CREATE), run, _last_line, _stages)
    published = [method for method in methods if "paper" in METHODS[method].presets]
    for number, method in enumerate(published):
        name = f"paper-{method}"
        command = ["mien", "train", str(workspace), "--run", name, "--method", method, "--preset", "paper"]
        left = clock.left(BUDGET) / (len(published) - number)
        yield measured(name, [*command, "--device", "cuda"], left, run, _last_line, _last_step)


def measured(
    name: str,
    command: list[str],
    seconds: float,
    run: Run,
    result: Callable[[str], str],
    told: Callable[[str], str] = lambda _: "",
) -> Row:
    """Run one part. The row has the `result` of its output, or what it `told` on standard error."""
    if seconds < 1:
        return Row(name, "left out: no time was left", 0.0)
    began = time.monotonic()
    status, output, errors = run(name, command, seconds)
    took = time.monotonic() - began
    if status == 124:
        return Row(name, f"not finished after {seconds:.0f} s; {told(errors)}".rstrip("; "), took)
    if status != 0:
        return Row(name, f"failed ({status}): {_last_line(errors) or _last_line(output)}", took)
    return Row(name, told(errors) or result(output), took)


def steps_in(output: str) -> str:
    """The medians of a benchmark's steps."""
    found = [row for row in json.loads(output)["rows"] if row["name"] == "train_step"]
    return ", ".join(
        f"{one['gaussians']:,} at {one['width']}x{one['height']}: {one['median_ms']:.2f} ms" for one in found
    )


def table(machine: str, found: list[Row]) -> str:
    """The table in Markdown."""
    lines = [machine, "", "| part | result | seconds |", "|---|---|---|"]
    return "\n".join([*lines, *(f"| {row.part} | {row.result} | {row.seconds:.0f} |" for row in found)]) + "\n"


def _stages(errors: str) -> str:
    """The seconds of each stage of `mien create`, or the last thing that it said."""
    return next((line for line in errors.splitlines() if line.startswith("Done in ")), _last_line(errors))


def _last_step(errors: str) -> str:
    """The last line of a training's curve."""
    return _last_line("\n".join(line for line in errors.splitlines() if line.startswith("training: ")))


def _last_line(text: str) -> str:
    lines = [line.strip().strip("=").strip() for line in text.splitlines() if line.strip()]
    return lines[-1].replace("|", "/") if lines else ""


def main() -> int:
    """Run everything and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/gpu"), help="folder for outputs and the table")
    parser.add_argument("--video", type=Path, help="a clip of a person (default: a synthetic head of 4 s)")
    arguments = parser.parse_args()
    import torch

    from mien.lab.synthetic.captures import write_synthetic_video
    from mien.lab.synthetic.recipe import RECIPES

    if not torch.cuda.is_available():
        print("benchmarks/device.py: PyTorch finds no NVIDIA GPU here; run it on a machine that has one")
        return 2
    arguments.out.mkdir(parents=True, exist_ok=True)
    video = arguments.video
    if video is None:
        video = arguments.out / "synthetic.mp4"
        if not video.is_file():
            write_synthetic_video(replace(RECIPES["demo"], seconds=4.0), video, seed=0)
    memory = torch.cuda.get_device_properties(0).total_memory >> 30
    versions = ", ".join(f"{name} {version(name)}" for name in ("torch", "triton", "gsplat", "mien"))
    machine = f"{torch.cuda.get_device_name()} with {memory} GiB, CUDA {torch.version.cuda}, {versions}"
    clock, found = Clock(time.monotonic() + BUDGET), []
    for row in rows(runner(arguments.out), tuple(METHODS), video, arguments.out / "workspace", clock):
        found.append(row)
        print(f"{row.part}: {row.result} ({row.seconds:.0f} s)", flush=True)
        (arguments.out / "table.md").write_text(table(machine, found))
    print("\n" + table(machine, found))
    return int(any(row.result.startswith("failed") for row in found))


if __name__ == "__main__":
    sys.exit(main())
