"""The table of a paper: its lines, how each is trained and scored, and the paper's figures (`mien batch --paper`)."""

import itertools
import re
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from mien.batch.plan import Batch
from mien.batch.results import latex_table, markdown_table, mean_of, numbers
from mien.disk.config import no_such_setting, overlay
from mien.disk.files import write_atomically
from mien.disk.reading import read_bytes
from mien.errors import UserError
from mien.machine.terminal import counted

_SCORES = ("psnr", "ssim", "l1", "lpips", "perceptual", "seconds_per_frame")
_TRANSFER = (
    "expression_error", "expression_error_still", "head_rotation_error_degrees", "head_rotation_error_still_degrees",
    "mouth_correlation", "eyes_correlation", "faces_found",
)  # fmt: skip
FIGURES = (
    *map(".".join, itertools.product(("self_reenactment", "novel_view"), _SCORES)),
    *map(".fitted.".join, itertools.product(("self_reenactment", "novel_view"), _SCORES[:5])),
    *(f"cross_reenactment.{name}" for name in _TRANSFER), "gaussians", "training_hours",
)  # fmt: skip
"""Figures that a column may have: of held-out frames as tracked, of the same with fitted faces, of driven avatars, and
of the training."""


@dataclass(frozen=True)
class Line:
    """A line of the table."""

    name: str = ""
    method: str = ""
    """The method that is trained. Empty if the line has the paper's figures alone."""
    options: dict[str, Any] = field(default_factory=dict)
    """Options of the line's commands, without their dashes. They precede those of the table."""
    paper: tuple[str, ...] = ()
    """The paper's figure for each column, as it is printed there. "" if there is none."""
    run: str = ""
    """Name of the run."""
    steps: int = 0
    """Number of steps of the whole training. 0 if no paper says it."""


@dataclass(frozen=True)
class Paper:
    """A table of a paper."""

    title: str = ""
    source: str = ""
    """The paper, and where its figures are."""
    subjects: int = 0
    """Number of the paper's subjects."""
    options: dict[str, Any] = field(default_factory=dict)
    """Options of all lines: those of `mien import`, `capture`, `track`, `train` and `evaluate`."""
    layouts: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Options by the layout of a subject's files: the name of a dataset, or `video`. They precede `options`."""
    cross_reenactment: bool = False
    """Whether the other subjects drive each avatar."""
    columns: dict[str, str] = field(default_factory=dict)
    """Heading of each column -> its figure."""
    rows: tuple[Line, ...] = ()
    typed: str = ""
    """Options of the command line that no paper has, for the state of each row."""


def read_paper(path: Path) -> Paper:
    """Read a table, and check everything in it that needs no other file."""
    if not path.exists():
        raise UserError(f"--paper {path}: no such file; give a table as in examples/papers")
    try:
        content = tomllib.loads(read_bytes(path, 1 << 20).decode("utf-8"))
    except (OSError, ValueError) as error:
        raise UserError(
            f"--paper {path}: cannot be read as TOML ({error}); give a file as in examples/papers"
        ) from None
    rows = content.pop("rows", None)
    if not isinstance(rows, list) or not rows:
        raise UserError(f"--paper {path}: has no rows; add a [[rows]] with a name and a method")
    places = {f"--paper {path}: row {number}": row for number, row in enumerate(rows, 1)}
    for where, given in ((f"--paper {path}", content), *places.items()):
        made = {"run", "steps", "typed"} & {*given} if isinstance(given, dict) else ()
        if made:
            raise UserError(f"{where}: {min(made)}: there is no such setting; options such as steps go into options")
    paper = overlay(Paper(), content, f"--paper {path}", "a table")
    lines = [overlay(Line(), row, where, "a row") for where, row in places.items()]
    for heading, figure in paper.columns.items():
        if figure not in FIGURES:
            raise UserError(no_such_setting(f"--paper {path}: column {heading!r} {figure!r}", "a result", (), FIGURES))
    for line in lines:
        if len(line.paper) not in (0, len(paper.columns)):
            raise UserError(
                f"--paper {path}: row {line.name!r} has {counted(len(line.paper), 'figure')} of the paper for "
                f'{counted(len(paper.columns), "column")}; give one for each, or "" for none'
            )
    runs = [re.sub(r"\W+", "-", line.name.lower()).strip("-_") for line in lines]
    for line, run in zip(lines, runs, strict=True):
        if not run or runs.count(run) > 1:
            raise UserError(f"--paper {path}: two rows have the name {line.name!r}, or it has no letters; give another")
    return replace(paper, rows=tuple(replace(line, run=run) for line, run in zip(lines, runs, strict=True)))


def plain_table(rows: Sequence[dict[str, Any]]) -> Paper:
    """The table of a batch without a paper: a row for each method."""
    methods = dict.fromkeys(str(row["method"]) for row in rows if row.get("method"))
    columns = {"PSNR, dB": "psnr", "SSIM": "ssim", "ST-LPIPS": "perceptual"}
    lines = tuple(Line(method, method, run=method) for method in methods)
    return Paper(subjects=len({row["name"] for row in rows}), columns=columns, rows=lines)


def table_of(rows: Sequence[dict[str, Any]], paper: Paper) -> list[list[str]]:
    """A heading and a line for each row: means of our results over subjects, the paper's figures, and the state."""
    beside = [any(line.paper and line.paper[index] != "" for line in paper.rows) for index in range(len(paper.columns))]
    heading = [[name, "paper"] if theirs else [name] for name, theirs in zip(paper.columns, beside, strict=True)]
    table = [["", *itertools.chain.from_iterable(heading), "state"]]
    for line in paper.rows:
        own, cells = [row for row in rows if line.method and row.get("run") == line.run], []
        for index, figure in enumerate(paper.columns.values()):
            cells += [mean_of(own, figure)] + [line.paper[index] if line.paper else ""] * beside[index]
        table.append([line.name, *cells, _state(line, own, paper)])
    return table


def _state(line: Line, own: Sequence[dict[str, Any]], paper: Paper) -> str:
    """Say what our figures of a line are: a whole run, a short one with what it lacks, or none."""
    if not (line.method and own):
        return "not run" if line.method else "the paper's figures alone"
    steps = min(numbers(own, "steps"), default=0)
    short = [f"{steps:,.0f} of {line.steps:,} steps"] if steps < line.steps else []
    short += [f"{len(own)} of {counted(paper.subjects, 'subject')}"] if len(own) < paper.subjects else []
    state = f"run short: {', '.join(short)}" if short else f"run: {counted(len(own), 'subject')}"
    return state + (f"; with {paper.typed}" if paper.typed else "")


def write_table(batch: Batch, rows: Sequence[dict[str, Any]], paper: Paper | None) -> list[list[str]]:
    """Write table.md and table.tex of the results, by a paper's table or else by methods. Returns the table."""
    table, about = table_of(rows, paper or plain_table(rows)), ""
    if paper is not None:
        about = f"# {paper.title}\n\n{paper.source}. Our figures are means over subjects, with their deviation.\n\n"
    for name, text in (("table.md", about + markdown_table(table)), ("table.tex", latex_table(table))):
        write_atomically(batch.root / name, lambda aside, text=text: aside.write_text(text, encoding="utf-8"))
    return table
