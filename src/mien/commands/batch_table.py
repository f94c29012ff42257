"""The table of a batch: captures as csv, json or a folder of videos, turned into rows with commands of mien."""

import csv
import difflib
import io
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mien.avatar.methods import DEFAULT_METHOD
from mien.batch.plan import WORKSPACE, Row, with_fingerprint
from mien.batch.results import RESULT_COLUMNS
from mien.batch.store import is_url
from mien.commands.batch_options import (
    OF_IMPORT,
    OF_SCORES,
    OPTIONS,
    PATHS,
    check_lpips,
    check_steps,
    column_of,
    is_option,
    of_training,
    typed,
)
from mien.commands.train_options import check_method
from mien.disk.reading import is_plain_name, listed, parse_json, read_bytes
from mien.disk.tables import table_rows, text_of, with_point
from mien.disk.workspace import check_no_workspace
from mien.errors import UserError

_MAX_TABLE_BYTES = 64 << 20
_VIDEOS = frozenset({".mp4", ".mov", ".mkv", ".avi", ".webm", ".m4v"})
_OWN = ("name", "video", "videos", "dataset", "method", "methods", "memory-gb")
"""Columns that are no options."""
_OF_BATCH = {
    "out": "the row's workspace is rows/NAME in the folder of the batch, so leave that column out",
    "run": "a run has the name of its method, so leave that column out",
    "view": "nobody watches the rows of a batch, so leave that column out",
}
"""Options of `mien create` that are no columns -> why."""
_NO = re.compile(r"(^|\.)no-")
_NUMBER = re.compile(r"-[0-9.]+(e[+-]?[0-9]+)?", re.IGNORECASE)
_DECIMAL = re.compile(r"-?[0-9]+,[0-9]+")
"""A number with a decimal comma."""
_LEAST_MB, _FRAME_MB = 2000.0, 0.1
"""Memory of a row in megabytes: at least, and for each frame. 10 minutes of video take less than 3 GiB."""


@dataclass(frozen=True)
class Entry:
    """A row of the table as it was given."""

    where: str
    """Place of the row, for messages."""
    name: str
    inputs: list[str]
    dataset: bool
    """Whether the inputs are a dataset, instead of videos."""
    methods: list[str]
    """Methods that were named."""
    options: dict[str, list[str]]
    labels: dict[str, str]
    memory_mb: float


def read_table(path: Path, for_all: Sequence[str] = ()) -> list[Row]:
    """The rows of a csv, a json, or a folder of videos.

    `for_all` has options of `mien create` for all rows, as they were typed. A cell of the table goes first.
    """
    kinds = set[str]()
    return [row_of(entry, _steps(entry), kinds) for entry in read_entries(path, columns_of(for_all))]


def read_entries(path: Path, usual: Mapping[str, Sequence[str]], paper: bool = False) -> list[Entry]:
    """Read the rows of a csv, a json, or a folder of videos.

    `usual` has options of all rows. For the table of a `paper`, folders of a folder are subjects as well, and a row has
    the options of any stage.
    """
    entries = list(_entries(path, paper))
    if not entries:
        raise UserError(f"{path}: has no rows; give a table of captures, or a folder of videos")
    place = path.parent if path.is_file() else path
    found = [_entry(place, each, f"{path}, row {number}", usual, paper) for number, each in enumerate(entries, 1)]
    _check_twice([entry.name for entry in found], str(path), "two rows have the name {!r}; give each row its own")
    return found


def row_of(entry: Entry, steps: Sequence[Sequence[str]], kinds: set[str]) -> Row:
    """The row with these steps. Steps of `kinds` are checked already."""
    check_steps(steps, entry.where, kinds)
    files = [Path(word) for words in (entry.inputs, *entry.options.values()) for word in words if not is_url(word)]
    row = Row(entry.name, tuple(map(tuple, steps)), entry.labels, entry.memory_mb)
    return with_fingerprint(row, [path for path in files if _exists(path)])


def columns_of(words: Sequence[str]) -> dict[str, list[str]]:
    """The words of each option that was typed, by its column. Paths are relative to the current folder."""
    columns: dict[str, list[str]] = {}
    for word in words:
        name, equals, value = word.partition("=")
        if word.startswith("--"):
            column = _NO.sub(r"\1", column_of(name))
            if column in columns:
                raise UserError(f"--{column} is given twice; give it once, followed by all of its values")
            columns[column] = [value] if equals else ["no"] if column != column_of(name) else []
        elif not columns:
            raise UserError(f"unknown: {word}; give one table of captures, or one folder of videos")
        else:
            columns[[*columns][-1]].append(word)
    _check_names(columns, "options of all rows")
    for column, found in columns.items():
        if column in {*_OWN} - {"method", "memory-gb"} or not (column in _OWN or is_option(column)):
            near = difflib.get_close_matches(column, sorted(OPTIONS), 1)
            hint = f"; did you mean --{near[0]}?" if near else ""
            raise UserError(f"unknown: --{column}{hint}; see mien batch --help, and mien create --help-all")
        # A face model may be a name instead of a file.
        for word in found if column in PATHS - {"face-model"} else ():
            if not (is_url(word) or _exists(Path(word))):
                raise UserError(f"--{column} {word}: no such file; correct the path")
            if column == "lpips-weights":
                check_lpips(Path(word))
        resolved = [str(Path(word).resolve()) if column in PATHS and _exists(Path(word)) else word for word in found]
        columns[column] = resolved or ["yes"]
    return columns


def _entries(path: Path, paper: bool) -> Iterator[dict[str, Any]]:
    if path.is_dir():
        check_no_workspace(path)
        for video in (each for each in listed(path) if each.suffix.lower() in _VIDEOS):
            yield {"video": video.name}
        for folder in (each for each in listed(path) if paper and each.is_dir()):
            yield {"dataset": folder.name}
        return
    try:
        text = read_bytes(path, _MAX_TABLE_BYTES)
        is_json = path.suffix.lower() == ".json"
        content = parse_json(text_of(text), unique_names=True) if is_json else _lines(text, path)
    except (OSError, ValueError, csv.Error) as error:
        raise UserError(f"{path}: cannot be read as a csv or a json list of objects ({error}); correct it") from None
    if isinstance(content, dict):
        content = content.get("rows")
    if not isinstance(content, list) or not all(isinstance(each, dict) for each in content):
        raise UserError(f"{path}: is no list of rows; give a csv with a heading, or a json list of objects")
    yield from content


def _lines(text: bytes, path: Path) -> list[dict[Any, Any]]:
    """The lines of a csv by column."""
    rows = [row for _, row in table_rows(io.BytesIO(text))]
    heading = rows[0] if rows else []
    _check_names(heading, str(path))
    for number, row in enumerate(rows[1:], 1):
        if len(row) > len(heading):
            raise UserError(
                f"{path}, row {number}: has more cells than the heading has columns; put texts with commas in quotes"
            )
    return [dict(zip(heading, row, strict=False)) for row in rows[1:]]


def _entry(folder: Path, entry: dict[str, Any], where: str, usual: Mapping[str, Sequence[str]], paper: bool) -> Entry:
    _check_names(map(str, entry), where)
    cells = {column_of(key): _words(value, key, where) for key, value in entry.items()}
    original = {key: f"--{key}" for key in usual} | {column_of(key): str(key).strip() for key in entry}
    cells = {key: words for key, words in cells.items() if words}
    cells |= {key: [*words] for key, words in usual.items() if not {key, "methods" * (key == "method")} & {*cells}}
    videos, dataset = cells.get("video", []) + cells.get("videos", []), cells.get("dataset", [])
    if videos and dataset:
        raise UserError(f"{where}: give it a video or a dataset, and not both")
    if not (videos or dataset):
        there = ", ".join(map(repr, original.values()))
        raise UserError(f"{where}: has no video and no dataset; its columns are {there} (commas separate columns)")
    inputs = [_input(folder, word, where) for word in videos or dataset]
    names = [Path(word).stem for word in videos or dataset]  # of links, not of what they lead to
    _check_twice(names, where, "two videos have the name {!r}; rename one of the files")
    name = "".join(cells.get("name", [])) or names[0]
    if not is_plain_name(name) or name.startswith((".", "-")):
        raise UserError(f"{where}: {name!r} cannot be the name of a folder; give another name")
    methods = cells.get("method", []) + cells.get("methods", [])
    for method in methods:
        check_method(where, method)
    _check_twice(methods, where, "method {!r} is there twice; name it once")
    options, labels = {}, {}
    for key, words in cells.items():
        if key in _OWN:
            continue
        words = [with_point(word) if _DECIMAL.fullmatch(word) else word for word in words]
        if is_option(key):
            _check_option(key, words, original[key], None if paper else bool(dataset), where)
            # A face model may be a name instead of a file.
            is_path = key in PATHS and (key != "face-model" or _exists(folder / words[0]))
            options[key] = [_input(folder, word, where) if is_path else word for word in words]
        else:
            _check_label(key, original[key], where)
            labels[original[key]] = ";".join(words)
    return Entry(where, name, inputs, bool(dataset), methods, options, labels, _memory(cells, inputs, where))


def _check_names(names: Iterable[str], where: str) -> None:
    """Check that no column is there twice, in any spelling, and that none is an option that the batch sets."""
    seen: dict[str, str] = {}
    for name in names:
        column = column_of(name)
        if column in seen:
            raise UserError(f"{where}: columns {seen[column]!r} and {name!r} are the same; keep one of them")
        seen[column] = name
        if not column:
            raise UserError(f"{where}: a column has no name; give it one, or remove it")
        if column in _OF_BATCH:
            raise UserError(f"{where}: column {name!r} cannot be set; {_OF_BATCH[column]}")


def _words(value: Any, name: object, where: str) -> list[str]:
    """The words of a cell: separated by semicolons in csv, or a list in json."""
    if isinstance(value, dict):
        raise UserError(f"{where}: column {name!r} holds an object; write a setting as a column, such as capture.size")
    each = value if isinstance(value, list) else str("" if value is None else value).split(";")
    return [text for one in each if (text := str(one).strip())]


def _check_option(key: str, words: Iterable[str], name: str, dataset: bool | None, where: str) -> None:
    """Check that an option belongs to a command of the row, and that no word of it is an option itself.

    The row has a dataset, or a video, or either one (None).
    """
    option = next((word for word in words if word.startswith("-") and not _NUMBER.fullmatch(word)), None)
    if option is not None:
        raise UserError(
            f"{where}: column {name!r} holds {option!r:.80}, which would be an option; give each option a column"
        )
    if dataset is False and key in ("retrack", *OF_SCORES):
        raise UserError(f"{where}: column {name!r} is for datasets; leave it empty where there is a video")
    if dataset and not (of_training(key) or key in (*OF_IMPORT, *OF_SCORES)):
        raise UserError(f"{where}: column {name!r} is for videos; leave it empty where there is a dataset")


def _exists(path: Path) -> bool:
    """Whether there is such a file or folder. A name that no file can have is none."""
    try:
        return path.exists()
    except OSError:
        return False


def _check_twice(words: Sequence[str], where: str, complaint: str) -> None:
    if len({*words}) < len(words):
        raise UserError(f"{where}: {complaint.format(next(word for word in words if words.count(word) > 1))}")


def _check_label(column: str, name: str, where: str) -> None:
    """Check that a label is neither a misspelt option nor a column of the results."""
    near = difflib.get_close_matches(column, [*sorted(OPTIONS), *_OWN], 1, 0.8)
    if near:
        raise UserError(f"{where}: column {name!r} is no option; did you mean {near[0]!r}? Labels need other names")
    if name in RESULT_COLUMNS:
        raise UserError(f"{where}: column {name!r} is one of the results; give the label another name")


def _input(folder: Path, word: str, where: str) -> str:
    if is_url(word):
        return word
    path = folder / word
    if not _exists(path):
        raise UserError(f"{where}: {path}: no such file; correct the table (paths are relative to it)")
    return str(path.resolve())


def _steps(entry: Entry) -> list[list[str]]:
    """The commands of a row: tracked once, trained by each method."""
    options, methods = entry.options, entry.methods or [DEFAULT_METHOD]

    def words(takes: Callable[[str], bool]) -> list[str]:
        return [word for key, given in options.items() if takes(key) for word in typed(key, given)]

    if entry.dataset:
        # A row that is tried again goes on where it stopped.
        imported = ["--out", WORKSPACE, "--resume", *words(OF_IMPORT.__contains__)]
        steps = [["import", each, *imported] for each in entry.inputs]
    else:
        steps = [["create", *entry.inputs, "--out", WORKSPACE, "--method", methods[0], *words(lambda key: True)]]
    for method in methods if entry.dataset else methods[1:]:
        steps.append(["train", WORKSPACE, "--method", method, *words(of_training)])
        steps.append(["evaluate", WORKSPACE, "--run", method, *words(OF_SCORES.__contains__)])
    return steps


def _memory(cells: dict[str, list[str]], inputs: list[str], where: str) -> float:
    """Megabytes that a row needs: as its column says, or from the number of its frames."""
    if "memory-gb" in cells:
        try:
            given = float("".join(cells["memory-gb"]))
        except ValueError:
            given = 0.0
        if not 0 < given < 1e6:
            raise UserError(f"{where}: memory_gb {';'.join(cells['memory-gb'])}: give a number of gigabytes above 0")
        return 1000 * given
    return _LEAST_MB + _FRAME_MB * sum(_count_frames(Path(word)) for word in inputs if not is_url(word))


def _count_frames(source: Path) -> int:
    """About how many frames a video or a folder of pictures has; 0 if that cannot be told, which the row reports."""
    from mien.media.video import probe_video

    try:
        return len(listed(source)) if source.is_dir() else probe_video(source).frames
    except (UserError, OSError):
        return 0
