"""The table of a batch: captures as csv, json or a folder of videos, turned into rows with commands of mien."""

import contextlib
import csv
import difflib
import io
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from mien.avatar.methods import DEFAULT_METHOD
from mien.batch.plan import WORKSPACE, Row, with_fingerprint
from mien.batch.results import RESULT_COLUMNS
from mien.batch.store import is_url
from mien.capture.settings import CaptureSettings
from mien.commands import create
from mien.commands.parsing.complaints import complaint_of
from mien.commands.parsing.options import TrainOptions, check_method, with_settings
from mien.disk.inside import is_plain_name, listed
from mien.disk.reading import parse_json, read_bytes
from mien.disk.tables import table_rows, text_of, with_point
from mien.disk.workspace import check_no_workspace
from mien.errors import UserError
from mien.tracking.settings import ScoringSettings, TrackingSettings
from mien.training.settings import AlignmentSettings, TrainSettings

_MAX_TABLE_BYTES = 64 << 20
_VIDEOS = frozenset({".mp4", ".mov", ".mkv", ".avi", ".webm", ".m4v"})
_OWN = ("name", "video", "videos", "dataset", "method", "methods", "memory-gb")
"""Columns that are no options."""
_OF_BATCH = {
    "out": "the row's workspace is rows/NAME in the folder of the batch, so leave that column out",
    "run-name": "a run has the name of its method, so leave that column out",
    "view": "nobody watches the rows of a batch, so leave that column out",
}
"""Options of `mien create` that are no columns -> why."""
_PATHS = frozenset(
    {"calibration", "config", "face-model", "capture.mattes", "capture.landmarks", "capture.clean-plate"}
)
"""Options that name a file. It may be given beside the table."""
_OF_IMPORT, _OF_SCORES = ("face-model", "retrack"), ("protocol",)
"""Options of `mien import` and of `mien evaluate` that the row of a dataset may have."""
_GROUPS = ("capture", "tracking", "alignment", "scoring", "training", "method")
_SETTINGS = {
    group: {each.name for each in fields(settings)}
    for group, settings in (
        ("capture", CaptureSettings),
        ("tracking", TrackingSettings),
        ("alignment", AlignmentSettings),
        ("scoring", ScoringSettings),
        ("training", TrainSettings),
    )
}
"""Group of options -> names of its settings."""
_ON = {
    prefix + one.name.replace("_", "-")
    for prefix, kind in (("", TrainOptions), ("capture.", CaptureSettings), ("tracking.", TrackingSettings))
    for one in fields(kind)
    if one.default is True
}
"""Flags that are on unless they are turned off."""
_NO = re.compile(r"(^|\.)no-")
"""Marks a flag that is turned off: --no-face-tuning, --capture.no-cuts."""
_NUMBER = re.compile(r"-[0-9.]+(e[+-]?[0-9]+)?", re.IGNORECASE)
_DECIMAL = re.compile(r"-?[0-9]+,[0-9]+")
"""A number with a decimal comma."""
_LEAST_MB, _FRAME_MB = 2000.0, 0.1
"""Memory of a row in megabytes: at least, and for each frame. 10 minutes of video take less than 3 GiB."""


def for_all_rows(arguments: Sequence[str]) -> tuple[list[str], dict[str, list[str]]]:
    """Take the options of `mien create` out of the arguments of `mien batch`: they count for all rows.

    Returns:
        The other arguments, and the words of each option by its column.
    """
    options: dict[str, list[str]] = {}
    words = others = list[str]()
    for argument in arguments:
        typed, equals, value = argument.partition("=")
        if argument.startswith("--"):
            column, words = _NO.sub(r"\1", _column(typed)), others
            if column in (*_options(), "method", "memory-gb", "view") or column.partition(".")[0] in _GROUPS:
                if column in options:
                    raise UserError(f"--{column} is given twice; give it once, followed by all of its values")
                words = options[column] = [value] if equals else ["no"] if column != _column(typed) else []
                continue
        words.append(argument)
    return others, {column: words or ["yes"] for column, words in options.items()}


def read_table(path: Path, for_all: Mapping[str, Sequence[str]] | None = None) -> list[Row]:
    """The rows of a table.

    Args:
        path: A csv, a json, or a folder of videos.
        for_all: Options of all rows, as `for_all_rows` returns them. A cell of the table goes first.
    """
    entries = list(_entries(path))
    if not entries:
        raise UserError(f"{path}: has no rows; give a table of captures, or a folder of videos")
    rows, kinds = [], set[str]()
    usual = {column: _from_here(column, words) for column, words in (for_all or {}).items()}
    _check_names(usual, "options of all rows")
    for number, entry in enumerate(entries, 1):
        row = _row(path.parent if path.is_file() else path, entry, f"{path}, row {number}", kinds, usual)
        rows.append(row)
    names = [row.name for row in rows]
    twice = next((name for name in names if names.count(name) > 1), None) if len(set(names)) < len(names) else None
    if twice is not None:
        raise UserError(f"{path}: two rows have the name {twice!r}; give each row a name of its own")
    return rows


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
    except FileNotFoundError:
        raise UserError(
            f"{path}: no such file or folder; give a csv or json of captures, or a folder of videos"
        ) from None
    except (OSError, ValueError, csv.Error) as error:
        raise UserError(f"{path}: cannot be read as a csv or a json list of objects ({error}); correct it") from None
    if isinstance(content, dict):
        content = content.get("rows")
    if not isinstance(content, list) or not all(isinstance(each, dict) for each in content):
        raise UserError(f"{path}: is no list of rows; give a csv with a heading, or a json list of objects")
    yield from content


def _lines(text: bytes, path: Path) -> list[dict[Any, Any]]:
    """The lines of a csv by column. Cells beyond the heading have the name None."""
    rows = [row for _, row in table_rows(io.BytesIO(text))]
    heading = rows[0] if rows else []
    _check_names(heading, str(path))
    return [
        dict(zip(heading, row, strict=False)) | ({None: row[len(heading) :]} if len(row) > len(heading) else {})
        for row in rows[1:]
    ]


def _row(folder: Path, entry: dict[str, Any], where: str, kinds: set[str], usual: Mapping[str, Sequence[str]]) -> Row:
    if None in entry:
        raise UserError(f"{where}: has more cells than the heading has columns; put texts with commas in quotes")
    _check_names(map(str, entry), where)
    cells = {_column(key): _words(value, key, where) for key, value in entry.items()}
    original = {key: f"--{key}" for key in usual} | {_column(key): str(key).strip() for key in entry}
    cells = {key: words for key, words in cells.items() if words}
    cells |= {key: [*words] for key, words in usual.items() if not {key, "methods" * (key == "method")} & {*cells}}
    videos = cells.get("video", []) + cells.get("videos", [])
    dataset = cells.get("dataset", [])
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
    known = [*_options(), *({*_OF_IMPORT, *_OF_SCORES} - {"face-model"})]
    options, labels = {}, {}
    for key, words in cells.items():
        if key in _OWN:
            continue
        words = [with_point(word) if _DECIMAL.fullmatch(word) else word for word in words]
        if key in known or key.partition(".")[0] in _GROUPS and "." in key:
            _check_words(words, original[key], where)
            options[key] = [
                _input(folder, word, where) if key in _PATHS and _must_exist(folder, key, word) else word
                for word in words
            ]
            continue
        _check_label(key, original[key], known, where)
        labels[original[key]] = ";".join(words)
    _check_columns(options, original, bool(dataset), where)
    steps = _steps(inputs, bool(dataset), methods, options)
    _check(steps, where, kinds)
    files = [Path(word) for words in (inputs, *options.values()) for word in words if not is_url(word)]
    row = Row(name, tuple(map(tuple, steps)), labels, _memory(cells, inputs, where))
    return with_fingerprint(row, [path for path in files if _exists(path)])


def _from_here(name: str, words: Sequence[str]) -> list[str]:
    """The words of an option that was typed: paths are relative to the current folder, not to the table."""
    return [str(Path(word).resolve()) if name in _PATHS and _exists(Path(word)) else word for word in words]


def _column(name: str) -> str:
    """The name of a column as that of an option: capture_size, --capture-size and capture-size are one."""
    return str(name).strip().removeprefix("--").replace("_", "-")


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


def _check_words(words: Iterable[str], name: str, where: str) -> None:
    """Check that no word of an option is an option itself."""
    option = next((word for word in words if word.startswith("-") and not _NUMBER.fullmatch(word)), None)
    if option is not None:
        raise UserError(
            f"{where}: column {name!r} holds {option!r:.80}, which would be an option; give each option a column"
        )


def _must_exist(folder: Path, key: str, word: str) -> bool:
    """Whether a path has to exist. A face model may be a name instead."""
    return key != "face-model" or _exists(folder / word)


def _exists(path: Path) -> bool:
    """Whether there is such a file or folder. A name that no file can have is none."""
    try:
        return path.exists()
    except OSError:
        return False


def _check_twice(words: Sequence[str], where: str, complaint: str) -> None:
    twice = next((word for word in words if words.count(word) > 1), None)
    if twice is not None:
        raise UserError(f"{where}: {complaint.format(twice)}")


def _check_label(column: str, name: str, known: Sequence[str], where: str) -> None:
    """Check that a label is none: a misspelt option, a setting with a dash for its dot, or a column of the results."""
    group, _, setting = column.partition("-")
    if setting.replace("-", "_") in _SETTINGS.get(group, ()):
        near = [f"{group}.{setting}"]
    else:
        near = difflib.get_close_matches(column, known, 1, 0.8) or difflib.get_close_matches(column, _OWN, 1, 0.75)
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


def _options() -> list[str]:
    """The options of `mien create` that a column may set, without settings of groups."""
    own = {one.name for one in fields(create.Command)} - {
        "videos",
        "out",
        "view",
        "preview",
        "options",
        "run_name",
        "name",
    }
    train = {one.name for one in fields(TrainOptions)} - {"method"}
    return sorted(name.replace("_", "-") for name in (own | train) - {*_GROUPS})


def _check_columns(options: dict[str, list[str]], original: dict[str, str], dataset: bool, where: str) -> None:
    """Check that each option belongs to a command of the row: videos are captured and tracked, datasets imported."""
    for key in options:
        if not dataset and key in (*_OF_IMPORT, *_OF_SCORES) and key != "face-model":
            raise UserError(f"{where}: column {original[key]!r} is for datasets; leave it empty where there is a video")
        if dataset and not (_of_training(key) or key in (*_OF_IMPORT, *_OF_SCORES)):
            raise UserError(
                f"{where}: column {original[key]!r} is for videos, which are captured and tracked; leave it empty "
                "where there is a dataset"
            )


def _of_training(key: str) -> bool:
    """Whether an option is one of `mien train`."""
    own = {one.name.replace("_", "-") for one in fields(TrainOptions)}
    return key in own or key.startswith(("method.", "training."))


def _steps(inputs: list[str], dataset: bool, methods: Sequence[str], options: dict[str, list[str]]) -> list[list[str]]:
    """The commands of a row: tracked once, trained by each method."""

    def typed(wanted: Callable[[str], bool]) -> list[str]:
        return [word for key, words in options.items() if wanted(key) for word in _typed(key, words)]

    trained = typed(_of_training)
    if dataset:
        # A row that is tried again goes on where it stopped.
        steps = [["import", *inputs, "--out", WORKSPACE, "--resume", *typed(lambda key: key in _OF_IMPORT)]]
    else:
        steps = [["create", *inputs, "--out", WORKSPACE, "--method", methods[0], *typed(lambda key: True)]]
    for method in methods if dataset else methods[1:]:
        steps.append(["train", WORKSPACE, "--method", method, *trained])
        steps.append(["evaluate", WORKSPACE, "--run", method, *typed(lambda key: key in _OF_SCORES)])
    return steps


def _typed(key: str, words: list[str]) -> list[str]:
    """An option as it is typed. Flags have no value: a cell with yes or true turns one on, no or false turns it off."""
    if [word.lower() for word in words] not in (["true"], ["yes"], ["false"], ["no"]):
        return [f"--{key}", *words]
    is_on = words[0].lower() in ("true", "yes")
    if key.startswith(("training.", "method.")):  # their flags take a value
        return [f"--{key}", str(is_on)]
    if key in _ON:
        group, dot, flag = key.rpartition(".")
        return [] if is_on else [f"--{group}{dot}no-{flag}"]
    return [f"--{key}"] if is_on else []


def _check(steps: list[list[str]], where: str, kinds: set[str]) -> None:
    """Check the options of the first command, once for each kind of row."""
    import tyro

    first = steps[0]
    words = ["one.mp4" if Path(word).is_absolute() or is_url(word) else word for word in first]
    kind = json.dumps(words)
    if kind in kinds or first[0] != "create":
        return
    kinds.add(kind)
    local = [word for word in first[1:] if word != WORKSPACE and not is_url(word)]
    out = local.index("--out")
    arguments = [*(local[:out] or ["one.mp4"]), "--out", "out", *local[out + 1 :]]
    told = io.StringIO()
    options: Any = create.Command
    style = (tyro.conf.FlagCreatePairsOff, tyro.conf.DisallowNone)
    try:
        with contextlib.redirect_stderr(told), contextlib.redirect_stdout(told):
            options = with_settings(create.Command, arguments)
            command = tyro.cli(options, args=arguments, config=style)
        command.options.check()
        command.capture.check()
        command.tracking.check()
    except SystemExit:
        why = complaint_of(told.getvalue(), arguments, options, style)
        raise UserError(f"{where}: {why}; see mien create --help-all") from None
    except UserError as error:
        raise UserError(f"{where}: {error}") from None


def _memory(cells: dict[str, list[str]], inputs: list[str], where: str) -> float:
    """Megabytes that a row needs: as its column says, or from the number of its frames."""
    from mien.pipeline.expected import count_captured

    if "memory-gb" in cells:
        try:
            given = float("".join(cells["memory-gb"]))
        except ValueError:
            given = 0.0
        if not 0 < given < 1e6:
            raise UserError(f"{where}: memory_gb {';'.join(cells['memory-gb'])}: give a number of gigabytes above 0")
        return 1000 * given
    videos = [Path(word) for word in inputs if not is_url(word)]
    return _LEAST_MB + _FRAME_MB * sum(count_captured(video, CaptureSettings()) for video in videos)
