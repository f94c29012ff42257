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
from dataclasses import asdict, dataclass, field
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

from fuzzing.judge import Result
from fuzzing.material import make_material
from fuzzing.run_lines import HEAVY, LIGHT, LINES, run_lines
from fuzzing.self_check import failures
from fuzzing.targets import TARGETS, present, spread
from fuzzing.workers import run_cases

VIEWER = "messages to a viewer"
"""Name of the format of messages."""


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
    viewer: int = 0
    """Number of messages to a running viewer."""
    self_check: bool = False
    """Whether to check first that the fuzzers can fail."""


@dataclass
class Row:
    """Figures of a format or a target."""

    outcomes: Counter[str] = field(default_factory=Counter)
    megabytes: float = 0.0
    """Most memory that a case took, beyond what its process had, in megabytes."""
    seconds: float = 0.0
    """Longest time of a case, in seconds."""

    def add(self, result: Result) -> None:
        self.outcomes[result.outcome] += 1
        if result.outcome != "finding":
            self.seconds, self.megabytes = max(self.seconds, result.seconds), max(self.megabytes, result.megabytes)

    def cells(self, name: str) -> str:
        counts = (self.outcomes.total(), *(self.outcomes[one] for one in OUTCOMES))
        figures = (*(f"{count:,}" for count in counts), f"{self.megabytes:,.0f} MB", f"{self.seconds:.1f} s")
        return f"| {name} | {' | '.join(figures)} |"


OUTCOMES = ("refused", "accepted", "stopped", "finding")


@dataclass
class Tally:
    """Figures by format and by target, and findings by cause, of a campaign."""

    formats: dict[str, Row] = field(default_factory=dict)
    targets: dict[str, Row] = field(default_factory=dict)
    whole: Row = field(default_factory=Row)
    findings: dict[str, list[Result]] = field(default_factory=dict)
    missed: list[str] = field(default_factory=list)
    """Planted faults that the fuzzers did not find in the self-check."""

    def add(self, result: Result) -> None:
        self.formats.setdefault(result.format, Row()).add(result)
        self.targets.setdefault(result.case.rsplit(":", 2)[0], Row()).add(result)
        self.whole.add(result)
        if result.outcome == "finding":
            self.findings.setdefault(result.cause, []).append(result)

    def table(self, by_target: bool = False) -> str:
        """Return a table of the figures by format or by target, then the causes with a case of each."""
        formats = [*dict.fromkeys(target.format for target in TARGETS.values()), LINES, VIEWER]
        kind, order, found = ("target", [*TARGETS], self.targets) if by_target else ("format", formats, self.formats)
        order += [name for name in found if name not in order]
        heads = (kind, "cases", *OUTCOMES[:-1], "findings", "most memory", "longest")
        rows = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
        rows += [found[name].cells(name) for name in order if name in found]
        rows += [self.whole.cells("all"), "", f"{len(self.findings)} causes:"]
        for cause, results in sorted(self.findings.items(), key=lambda item: -len(item[1])):
            rows.append(f"{len(results):6} x {cause}    --replay {results[0].case!r}")
        return "\n".join(rows)


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
            count = tally.whole.outcomes.total()
            if result.outcome == "finding" and log is not None:
                log.write(json.dumps(result.as_json()) + "\n")
                log.flush()
            if count % 500 == 0:
                print(
                    f"{count} cases in {time.monotonic() - began:.0f} s, {len(tally.findings)} causes",
                    file=sys.stderr,
                    flush=True,
                )
    print(f"{tally.whole.outcomes.total()} cases in {time.monotonic() - began:.0f} s", file=sys.stderr)
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
    jobs += [partial(_viewer_results, plan.viewer, plan.seed)] if plan.viewer else []
    seed, names = plan.seed, plan.only or present(material)
    if left_out := sorted(TARGETS.keys() - set(names)) if plan.only is None else []:
        print(f"left out, because node or usd-core is missing: {', '.join(left_out)}", file=sys.stderr)
    while plan.cases or jobs:
        cases = [f"{name}:{seed}:{number}" for name, number in spread(plan.cases, names)] if plan.cases else []
        shares = [cases[index :: plan.workers] for index in range(plan.workers)]
        jobs += [
            partial(run_cases, share, folder / f"worker{index}", material, plan.until)
            for index, share in enumerate(shares)
        ]
        yield from chain.from_iterable(job() for job in jobs) if plan.workers == 1 else _side_by_side(jobs)
        jobs, seed = [], seed + 1
        if plan.until is None or time.monotonic() >= plan.until:
            return


def _send_messages(count: int, seed: int) -> dict[str, Any]:
    from fuzzing.viewer_messages import campaign  # it needs viser, which may be missing

    return asdict(campaign(count, seed))


def _viewer_results(count: int, seed: int) -> Iterator[Result]:
    """Yield a result for each hostile message and request. The viewer is judged as a whole, after them."""
    figures = _aside(partial(_send_messages, count, seed))
    numbers = iter(range(10 * count + 100))
    known = {"megabytes": figures["memory_mib"], "seconds": figures["end_seconds"]}
    for outcome, amount in (("refused", figures["refused_requests"]), ("accepted", figures["messages"])):
        for _ in range(amount):
            yield Result(f"{VIEWER}:{seed}:{next(numbers)}", VIEWER, outcome=outcome, **known)
    for message in figures["findings"]:
        told = {"message": message[:2000], "cause": f"viewer: {message[:80]}"}
        yield Result(f"{VIEWER}:{seed}:{next(numbers)}", VIEWER, outcome="finding", findings=["viewer"], **told)


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
