"""Rows of a batch for the table of a paper: each subject is imported or captured once, and every line is trained."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mien.batch.paper import Line, Paper
from mien.batch.plan import ROWS, WORKSPACE, Row
from mien.commands.batch_options import OF_SCORES, parsed, typed
from mien.commands.batch_table import Entry, row_of
from mien.commands.train_options import check_method
from mien.datasets.registry import datasets, is_dataset, people_in, recognised
from mien.errors import UserError
from mien.training.settings.splits import NAMED_SPLIT, driving_sequences

Words = Mapping[str, list[str]]
"""Options by name, without their dashes, and the words of each."""
VIDEO = "video"
"""The layout of own footage, which is captured and tracked."""
_MADE = "-made"
"""End of the names of rows that make the sequences of a subject."""
_QUIET = {"steps", "device", "face-model", "lpips-weights", "memory-gb"}
"""Options of the command line that no state of a row repeats."""


@dataclass(frozen=True)
class Person:
    """A subject's files."""

    layout: str
    """Name of the dataset, or `VIDEO`."""
    inputs: tuple[str, ...]
    tracked: bool = False
    """Whether they have a tracking that mien can use."""
    sequences: tuple[str, ...] = ()


def person_at(path: Path, where: str) -> Person:
    """The files of a subject: a dataset, or a folder of datasets of one layout."""
    inside = [path] if is_dataset(path) else [path / name for name in people_in(path)] or [path]
    try:
        found = [recognised(each)[0] for each in inside]
    except UserError as error:
        raise UserError(f"{where}: {error}") from None
    survey, names = found[0].survey, ", ".join({each.name: "" for each in found})
    if survey is None or any(each is not found[0] for each in found):
        raise UserError(f"{where}: {path}: holds {names}; give each subject a folder with sequences of one layout")
    findings = [survey(each) for each in inside]
    sequences = tuple(clip.name for each in findings for clip in each.clips)
    return Person(found[0].name, tuple(map(str, inside)), all(each.face_model for each in findings), sequences)


def with_runs(paper: Paper, path: Path, given: Words) -> Paper:
    """The table with the name of each run, and the whole number of its steps. `given` has the options as typed."""
    known = {VIDEO, *(each.name for each in datasets())}
    for layout in paper.layouts:
        if layout not in known:
            raise UserError(f"--paper {path}: layouts.{layout}: give one of {', '.join(sorted(known))}")
    rows = []
    for line in paper.rows:
        where = f"--paper {path}: row {line.name!r}"
        if line.method:
            check_method(where, line.method)
            words = _typed("train", _words({**paper.options, **line.options}))
            steps = parsed(["train", WORKSPACE, "--method", line.method, *words], where).options.steps
            line = replace(line, steps=steps, run="-".join([line.run, *given.get("steps", [])]))
        rows.append(line)
    other = (word for key, words in given.items() if key not in _QUIET for word in (f"--{key}", *words))
    return replace(paper, rows=tuple(rows), typed=" ".join(other))


def subject_rows(entries: Sequence[Entry], paper: Paper) -> list[Row]:
    """A row for each subject. Where subjects drive each other, rows that only make their sequences come first."""
    people, kinds, first = {each.name: _person(each) for each in entries}, set[str](), []
    drivers = {each.name: _drivers(people, each, paper) for each in entries}
    for entry in entries if any(drivers.values()) else ():
        steps = making_steps(people[entry.name], paper, entry.options)
        steps = [[f"{ROWS}/{entry.name}" if word == WORKSPACE else word for word in step] for step in steps]
        first.append(replace(row_of(replace(entry, name=f"{entry.name}{_MADE}"), steps, kinds), first=True))
    rows = [row_of(each, _steps(people[each.name], paper, each.options, drivers[each.name]), kinds) for each in entries]
    return [*first, *rows]


def _person(entry: Entry) -> Person:
    if entry.methods:
        raise UserError(
            f"{entry.where}: method {entry.methods[0]!r}: the paper's table names the methods; leave it out"
        )
    if not entry.dataset:
        return Person(VIDEO, tuple(entry.inputs))
    return person_at(Path(entry.inputs[0]), entry.where)


def _steps(person: Person, paper: Paper, given: Words, drivers: list[str]) -> list[list[str]]:
    """The commands of a subject's row. `given` has options that precede those of the paper."""
    steps = making_steps(person, paper, given)
    for line in (line for line in reversed(paper.rows) if line.method):  # a paper's own method is its last row
        options = _options(person, paper, line, given)
        steps.append(["train", WORKSPACE, "--run", line.run, "--method", line.method, *_typed("train", options)])
        scored = ["--resume", "--no-perceptual", *_typed("evaluate", options)]
        steps.append(["evaluate", WORKSPACE, "--run", line.run, *scored, *(["--drivers", *drivers] if drivers else [])])
    return steps


def making_steps(person: Person, paper: Paper, given: Words) -> list[list[str]]:
    """The commands that make tracked sequences of a subject's files."""
    options = _options(person, paper, Line(), given)
    tracking = ["track", WORKSPACE, *_typed("track", options)]
    if person.layout == VIDEO:
        return [["capture", *person.inputs, "--out", WORKSPACE, *_typed("capture", options)], tracking]
    tracked = person.tracked or "".join(options.get("face-model", [])).startswith("coefficients-")
    read = {key: words for key, words in options.items() if tracked or key != "face-model"}
    importing = [*_typed("import", read), "--out", WORKSPACE, "--resume"]
    return [
        *(["import", one, *importing] for one in person.inputs),
        *([] if tracked or "--retrack" in importing else [tracking]),
    ]


def _drivers(people: Mapping[str, Person], entry: Entry, paper: Paper) -> list[str]:
    """The workspaces of the other subjects that drive the subject's avatar."""
    own = people[entry.name]
    named = _options(own, paper, Line(), entry.options).get("split") == [NAMED_SPLIT]
    others = (name for name, one in people.items() if one is not own and one.layout == own.layout)
    driving = (name for name in others if not named or driving_sequences(people[name].sequences))
    return [f"{ROWS}/{name}" for name in driving if paper.cross_reenactment]


def _options(person: Person, paper: Paper, line: Line, given: Words) -> Words:
    usual = {"split": "tail"} if person.layout == VIDEO else {"split": "dataset", "protocol": person.layout}
    return {**_words({**usual, **paper.options, **paper.layouts.get(person.layout, {}), **line.options}), **given}


def _words(options: Mapping[str, Any]) -> dict[str, list[str]]:
    """The words of the options of a table. An empty text leaves an option out."""
    lists = {key: value if isinstance(value, list) else [value] for key, value in options.items() if value != ""}
    return {key: [str(each).lower() if isinstance(each, bool) else str(each) for each in lists[key]] for key in lists}


def _typed(command: str, options: Words) -> list[str]:
    """The options that are those of a command, as they are typed. `train` gets what no other command takes."""

    def takes(key: str) -> set[str]:
        groups = {"capture": "capture", "tracking": "track", "scoring": "track"}
        named = {"face-model": {"import", "track"}, "retrack": {"import"}} | dict.fromkeys(OF_SCORES, {"evaluate"})
        return named.get(key, {groups.get(key.partition(".")[0], "train")})

    return [word for key, words in options.items() if command in takes(key) for word in typed(key, words)]
