"""Run cases over all targets in several workers, and collect the findings by cause in a table."""

import contextlib
import json
import os
import select
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

from fuzzing.judge import Result
from fuzzing.material import make_material
from fuzzing.run_lines import HEAVY, LIGHT, LINES, run_lines
from fuzzing.self_check import failures
from fuzzing.targets import TARGETS, spread
from fuzzing.workers import run_cases


@dataclass(frozen=True)
class Plan:
    """Options of a campaign."""

    seed: int
    cases: int
    only: list[str] | None = None
    workers: int = 1
    until: float | None = None
    """Time of `time.monotonic` after which no further seed starts; None for one seed."""
    lines: int = 0
    """Number of command lines to run as well."""
    heavy: int = 0
    """Number of command lines that take long."""
    self_check: bool = False
    """Whether to check first that the fuzzers can fail."""


@dataclass
class Tally:
    """Counts by format, and findings by cause, of a campaign."""

    outcomes: Counter[tuple[str, str]] = field(default_factory=Counter)
    findings: dict[str, list[Result]] = field(default_factory=dict)
    seconds: float = 0.0
    """Longest time of a mutated input, in seconds."""
    megabytes: float = 0.0
    """Most memory that a mutated input took, in megabytes."""
    missed: list[str] = field(default_factory=list)
    """Planted faults that the fuzzers did not find in the self-check."""

    def add(self, result: Result) -> None:
        self.outcomes[result.format, result.outcome] += 1
        if result.format != LINES and result.outcome != "finding":
            self.seconds, self.megabytes = max(self.seconds, result.seconds), max(self.megabytes, result.megabytes)
        if result.outcome == "finding":
            self.findings.setdefault(result.cause, []).append(result)

    def table(self) -> str:
        """Return a table of the counts by format, then the causes with a case of each."""
        rows = ["| format | cases | refused | accepted | stopped | findings |", "|---|---|---|---|---|---|"]
        formats = [*dict.fromkeys(target.format for target in TARGETS.values()), LINES]
        total = Counter[str]()
        for name in formats:
            counts = Counter({outcome: count for (other, outcome), count in self.outcomes.items() if other == name})
            total += counts
            rows.append(_row(name, counts))
        rows += [
            _row("all", total),
            "",
            f"longest {self.seconds:.1f} s, most memory {self.megabytes:.0f} MB",
            "",
            f"{len(self.findings)} causes:",
        ]
        for cause, results in sorted(self.findings.items(), key=lambda item: -len(item[1])):
            rows.append(f"{len(results):6} x {cause}    --replay {results[0].case!r}")
        return "\n".join(rows)


def _row(name: str, counts: Counter[str]) -> str:
    cells = (sum(counts.values()), *(counts[outcome] for outcome in ("refused", "accepted", "stopped", "finding")))
    return f"| {name} | {' | '.join(f'{cell:,}' for cell in cells)} |"


def run(plan: Plan, folder: Path, findings: Path | None) -> Tally:
    """Run a plan; everything is made below `folder`. Findings are written as json lines as they come."""
    material = folder / "material"
    make_material_aside(material)
    tally, began = Tally(), time.monotonic()
    with contextlib.ExitStack() as stack:
        if plan.self_check:
            tally.missed += _aside(lambda: list(failures(folder / "self", material)))
        log = stack.enter_context(_made(findings).open("a")) if findings else None
        for result in _all_results(plan, folder, material):
            tally.add(result)
            count = sum(tally.outcomes.values())
            if result.outcome == "finding" and log is not None:
                log.write(json.dumps(result.as_json()) + "\n")
                log.flush()
            if count % 500 == 0:
                print(
                    f"{count} cases in {time.monotonic() - began:.0f} s, {len(tally.findings)} causes",
                    file=sys.stderr,
                    flush=True,
                )
    print(f"{sum(tally.outcomes.values())} cases in {time.monotonic() - began:.0f} s", file=sys.stderr)
    return tally


def _made(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def replay(case: str, folder: Path) -> Result:
    """Run one case or command line again."""
    make_material_aside(folder / "material")
    if case.startswith((LIGHT, HEAVY)):
        return next(run_lines([case], folder / "worker", folder / "material"))
    return next(run_cases([case], folder / "worker", folder / "material"))


Job = Callable[[], Iterator[Result]]
"""Job that runs its cases in a process of its own."""


def _all_results(plan: Plan, folder: Path, material: Path) -> Iterator[Result]:
    """Yield the results of the command lines beside the cases of the first seed, then those of further seeds."""
    lines = [
        f"{name}:{plan.seed}:{n}" for name, count in ((LIGHT, plan.lines), (HEAVY, plan.heavy)) for n in range(count)
    ]
    jobs: list[Job] = [partial(run_lines, lines, folder / "lines", material)]
    seed = plan.seed
    while plan.cases or jobs:
        cases = [f"{name}:{seed}:{number}" for name, number in spread(plan.cases, plan.only)] if plan.cases else []
        shares = [cases[index :: plan.workers] for index in range(plan.workers)]
        jobs += [
            partial(run_cases, share, folder / f"worker{index}", material, plan.until)
            for index, share in enumerate(shares)
        ]
        yield from chain.from_iterable(job() for job in jobs) if plan.workers == 1 else _side_by_side(jobs)
        jobs, seed = [], seed + 1
        if plan.until is None or time.monotonic() >= plan.until:
            return


def _side_by_side(jobs: list[Job]) -> Iterator[Result]:
    """Yield the results of jobs, each in a process of its own, as they come."""
    pipes, children = [], []
    for job in jobs:
        reading, writing = os.pipe()
        children.append(os.fork())
        if children[-1] == 0:
            code = 1
            try:
                with os.fdopen(writing, "w") as out:
                    for result in job():
                        out.write(json.dumps(result.as_json()) + "\n")
                        out.flush()
                code = 0
            except BaseException:
                traceback.print_exc()
            finally:
                os._exit(code)
        os.close(writing)
        pipes.append(os.fdopen(reading))
    waiting = list(pipes)
    while waiting:
        for pipe in select.select(waiting, [], [])[0]:
            # A line arrives whole: it is shorter than a pipe's buffer, or its rest follows at once.
            if line := pipe.readline():
                yield Result(**json.loads(line))
            else:
                waiting.remove(pipe)
                pipe.close()
    if any(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children):
        raise RuntimeError("a worker of the fuzzer itself failed; what it said is above")


def make_material_aside(material: Path) -> None:
    """Write whole files of every kind, in another process."""
    _aside(lambda: make_material(material))


def _aside(work: Callable[[], Any]) -> Any:
    """Run `work` in another process and return its result. This process starts no threads, so that it forks safely."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        code, errors, quiet = 1, os.dup(2), os.open(os.devnull, os.O_WRONLY)
        os.close(reading)
        try:
            os.dup2(quiet, 1)
            os.dup2(quiet, 2)
            with os.fdopen(writing, "w") as out:
                json.dump(work(), out)
            code = 0
        except BaseException:
            os.dup2(errors, 2)
            traceback.print_exc()
        finally:
            os._exit(code)
    os.close(writing)
    with os.fdopen(reading) as answer:
        told = answer.read()
    if os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) != 0:
        raise RuntimeError("the fuzzer itself failed; what it said is above")
    return json.loads(told)
