"""The table of a batch: captures as csv, json or a folder of videos, turned into rows with commands of mien."""

import csv
import difflib
import io
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from mien.avatar.methods import DEFAULT_METHOD
from mien.batch.plan import WORKSPACE, Row, with_fingerprint
from mien.batch.results import RESULT_COLUMNS
from mien.batch.store import is_url
from mien.commands import create, train
from mien.commands.parsing import options_of, parse_options, with_defaults
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
_PATHS = frozenset(
    {"calibration", "config", "face-model", "capture.mattes", "capture.landmarks", "capture.clean-plate"}
)
"""Options that name a file. It may be given beside the table."""
_OF_IMPORT, _OF_SCORES = ("face-model", "retrack"), ("protocol",)
"""Options of `mien import` and of `mien evaluate` that the row of a dataset may have."""
_OF_TRAIN, _OF_CREATE = (
    {name: value for name, value in options_of(with_defaults(command, [])) if not name.startswith("method")}
    for command in (train.Command, create.Command)
)
"""Options of both commands with their defaults, but for those of methods, which differ."""
_OPTIONS = _OF_CREATE.keys() - {"out", "name", "run", "view", "preview"} | {*_OF_IMPORT, *_OF_SCORES}
_GROUPS = {"method"} | {name.partition(".")[0] for name in _OPTIONS if "." in name}
_NO = re.compile(r"(^|\.)no-")
_NUMBER = re.compile(r"-[0-9.]+(e[+-]?[0-9]+)?", re.IGNORECASE)
_DECIMAL = re.compile(r"-?[0-9]+,[0-9]+")
"""A number with a decimal comma."""
_LEAST_MB, _FRAME_MB = 2000.0, 0.1
"""Memory of a row in megabytes: at least, and for each frame. 10 minutes of video take less than 3 GiB."""


def read_table(path: Path, for_all: Sequence[str] = ()) -> list[Row]:
    """The rows of a csv, a json, or a folder of videos.

    `for_all` has options of `mien create` for all rows, as they were typed. A cell of the table goes first.
    """
    usual, kinds = _columns_of(for_all), set[str]()
    entries = list(_entries(path))
    if not entries:
        raise UserError(f"{path}: has no rows; give a table of captures, or a folder of videos")
    place = path.parent if path.is_file() else path
    rows = [_row(place, entry, f"{path}, row {number}", kinds, usual) for number, entry in enumerate(entries, 1)]
    _check_twice([row.name for row in rows], str(path), "two rows have the name {!r}; give each row its own")
    return rows


def _columns_of(words: Sequence[str]) -> dict[str, list[str]]:
    """The words of each option that was typed, by its column. Paths are relative to the current folder."""
    columns: dict[str, list[str]] = {}
    for word in words:
        name, equals, value = word.partition("=")
        if word.startswith("--"):
            column = _NO.sub(r"\1", _column(name))
            if column in columns:
                raise UserError(f"--{column} is given twice; give it once, followed by all of its values")
            columns[column] = [value] if equals else ["no"] if column != _column(name) else []
        elif not columns:
            raise UserError(f"unknown: {word}; give one table of captures, or one folder of videos")
        else:
            columns[[*columns][-1]].append(word)
    _check_names(columns, "options of all rows")
    for column, found in columns.items():
        if column in {*_OWN} - {"method", "memory-gb"} or not (column in _OWN or _is_option(column)):
            near = difflib.get_close_matches(column, sorted(_OPTIONS), 1)
            hint = f"; did you mean --{near[0]}?" if near else ""
            raise UserError(f"unknown: --{column}{hint}; see mien batch --help, and mien create --help-all")
        resolved = [str(Path(word).resolve()) if column in _PATHS and _exists(Path(word)) else word for word in found]
        columns[column] = resolved or ["yes"]
    return columns


def _entries(path: Path) -> Iterator[dict[str, Any]]:
    if path.is_dir():
        check_no_workspace(path)
        for video in (each for each in listed(path) if each.suffix.lower() in _VIDEOS):
            yield {"video": video.name}
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


def _row(folder: Path, entry: dict[str, Any], where: str, kinds: set[str], usual: Mapping[str, Sequence[str]]) -> Row:
    _check_names(map(str, entry), where)
    cells = {_column(key): _words(value, key, where) for key, value in entry.items()}
    original = {key: f"--{key}" for key in usual} | {_column(key): str(key).strip() for key in entry}
    cells = {key: words for key, words in cells.items() if words}
    cells |= {key: [*words] for key, words in usual.items() if not {key, "methods" * (key == "method")} & {*cells}}
    videos, dataset = cells.get("video", []) + cells.get("videos", []), cells.get("dataset", [])
    if videos and dataset:
        raise UserError(f"{where}: give it a video or a dataset, and not both")
    if not (videos or dataset):
        there = ", ".join(map(repr, original.values()))
        raise UserError(f"{where}: has no video and no dataset; its columns are {there} (commas separate columns)")
    inputs = [_input(folder, word, where) for word in videos or dataset]
    _check_twice([Path(word).stem for word in inputs], where, "two videos have the name {!r}; rename one of the files")
    name = "".join(cells.get("name", [])) or Path(inputs[0]).stem
    if not is_plain_name(name) or name.startswith((".", "-")):
        raise UserError(f"{where}: {name!r} cannot be the name of a folder; give another name")
    methods = cells.get("method", []) + cells.get("methods", []) or [DEFAULT_METHOD]
    for method in methods:
        check_method(where, method)
    _check_twice(methods, where, "method {!r} is there twice; name it once")
    options, labels = {}, {}
    for key, words in cells.items():
        if key in _OWN:
            continue
        words = [with_point(word) if _DECIMAL.fullmatch(word) else word for word in words]
        if _is_option(key):
            _check_option(key, words, original[key], bool(dataset), where)
            # A face model may be a name instead of a file.
            is_path = key in _PATHS and (key != "face-model" or _exists(folder / words[0]))
            options[key] = [_input(folder, word, where) if is_path else word for word in words]
        else:
            _check_label(key, original[key], where)
            labels[original[key]] = ";".join(words)
    steps = _steps(inputs, bool(dataset), methods, options)
    _check(steps, where, kinds)
    files = [Path(word) for words in (inputs, *options.values()) for word in words if not is_url(word)]
    row = Row(name, tuple(map(tuple, steps)), labels, _memory(cells, inputs, where))
    return with_fingerprint(row, [path for path in files if _exists(path)])


def _column(name: str) -> str:
    """The name of a column as that of an option: capture_size, --capture-size and capture-size are one."""
    return str(name).strip().removeprefix("--").replace("_", "-")


def _is_option(column: str) -> bool:
    group, dot, _ = column.partition(".")
    return bool(dot) and group in _GROUPS or column in _OPTIONS


def _check_names(names: Iterable[str], where: str) -> None:
    """Check that no column is there twice, in any spelling, and that none is an option that the batch sets."""
    seen: dict[str, str] = {}
    for name in names:
        column = _column(name)
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


def _check_option(key: str, words: Iterable[str], name: str, dataset: bool, where: str) -> None:
    """Check that an option belongs to a command of the row, and that no word of it is an option itself."""
    option = next((word for word in words if word.startswith("-") and not _NUMBER.fullmatch(word)), None)
    if option is not None:
        raise UserError(
            f"{where}: column {name!r} holds {option!r:.80}, which would be an option; give each option a column"
        )
    if not dataset and key in ("retrack", *_OF_SCORES):
        raise UserError(f"{where}: column {name!r} is for datasets; leave it empty where there is a video")
    if dataset and not (_of_training(key) or key in (*_OF_IMPORT, *_OF_SCORES)):
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
    near = difflib.get_close_matches(column, [*sorted(_OPTIONS), *_OWN], 1, 0.8)
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


def _of_training(key: str) -> bool:
    """Whether an option is one of `mien train`."""
    return key in _OF_TRAIN or key.startswith(("method.", "training."))


def _steps(inputs: list[str], dataset: bool, methods: Sequence[str], options: dict[str, list[str]]) -> list[list[str]]:
    """The commands of a row: tracked once, trained by each method."""
    typed = {key: _typed(key, words) for key, words in options.items()}
    every = [word for words in typed.values() for word in words]
    trained = [word for key, words in typed.items() if _of_training(key) for word in words]
    imported = [word for key in _OF_IMPORT for word in typed.get(key, ())]
    if dataset:
        # A row that is tried again goes on where it stopped.
        steps = [["import", *inputs, "--out", WORKSPACE, "--resume", *imported]]
    else:
        steps = [["create", *inputs, "--out", WORKSPACE, "--method", methods[0], *every]]
    for method in methods if dataset else methods[1:]:
        steps.append(["train", WORKSPACE, "--method", method, *trained])
        steps.append(["evaluate", WORKSPACE, "--run", method, *typed.get("protocol", ())])
    return steps


def _typed(key: str, words: list[str]) -> list[str]:
    """An option as it is typed. Flags have no value: a cell with yes or true turns one on, no or false turns it off."""
    if [word.lower() for word in words] not in (["true"], ["yes"], ["false"], ["no"]):
        return [f"--{key}", *words]
    is_on = words[0].lower() in ("true", "yes")
    if key.startswith(("training.", "method.")):  # their flags take a value
        return [f"--{key}", str(is_on)]
    if _OF_CREATE.get(key) is True:  # on unless it is turned off: --capture.no-cuts
        group, dot, flag = key.rpartition(".")
        return [] if is_on else [f"--{group}{dot}no-{flag}"]
    return [f"--{key}"] if is_on else []


def _check(steps: list[list[str]], where: str, kinds: set[str]) -> None:
    """Check the options of the first command that has some of the table, once for each kind of row."""
    name, *words = next(step for step in steps if step[0] != "import")
    words = ["one.mp4" if Path(word).is_absolute() or is_url(word) else word for word in words]
    kind = json.dumps([name, *words])
    if kind in kinds:
        return
    kinds.add(kind)
    if name == "create":
        at = words.index("--out")
        words = ["one.mp4", *words[at:]]
    try:
        command = parse_options(create.Command if name == "create" else train.Command, f"mien {name}", words)
        command.options.check()
        if name == "create":
            command.capture.check()
            command.tracking.check()
    except UserError as error:
        raise UserError(f"{where}: {error}") from None


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
