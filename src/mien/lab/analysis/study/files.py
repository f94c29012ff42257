"""A study on disk: the key, which says what the page's opaque names stand for, and the answers. Needs no torch."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from mien.disk.files import expect_whole, read_json, write_json
from mien.disk.inside import is_one_line, listed
from mien.disk.limits import checked_whole
from mien.disk.reading import parse_json, read_bytes
from mien.errors import UserError
from mien.lab.analysis.study.shuffling import shuffled

QUESTIONS = {"quality": "visual quality", "expression": "expression accuracy"}
"""The questions of the study, by their names in answer files (MonoGaussianAvatar, supplement A.5)."""
MOST_RUNS = 8
"""Largest number of runs beside the truth."""
ANSWERS, KEY, VERSION = "mien.study_answers", "mien.study_key", 1
_KEY_REMEDY = "make the study again with the same seed and runs"
_AGAIN = "ask the participant to save it again, or leave it out"
_MAX_BYTES = 1 << 20
"""Largest answer file, in bytes. 200 clips take some 60 kB."""
_NAME = re.compile(r"[0-9a-f]{8,32}")
_MAX_TIMESTEP = 1 << 40


@dataclass(frozen=True)
class KeyClip:
    """What a clip of the page shows."""

    name: str
    """The clip's opaque name."""
    workspace: str
    """Name of the workspace's folder."""
    sequence: str
    camera_id: str
    first: int
    """The first timestep."""
    timesteps: int
    tiles: dict[str, str]
    """The run of each opaque name of a tile."""


@dataclass(frozen=True)
class StudyKey:
    """What the page does not say."""

    study: str
    """The study's opaque name."""
    seed: int
    runs: tuple[str, ...]
    """Labels of the compared runs, in the order of the tables."""
    clips: tuple[KeyClip, ...]


@dataclass(frozen=True)
class Answer:
    """The answers of a participant to one clip."""

    clip: KeyClip
    shown: tuple[str, ...]
    """The runs from left to right."""
    choices: dict[str, str]
    """The chosen run by question."""


@dataclass(frozen=True)
class Answers:
    """The answers of one participant to all clips, in the key's order."""

    participant: str
    """The participant's random number, as 8 hex digits."""
    clips: tuple[Answer, ...]


def key_path(page: Path) -> Path:
    """The key beside a page."""
    return page.with_name(f"{page.stem}.key.json")


def write_key(path: Path, key: StudyKey) -> None:
    """Write the key of a study."""
    write_json(path, KEY, VERSION, {**asdict(key), "runs": list(key.runs), "clips": [asdict(one) for one in key.clips]})


def read_key(path: Path) -> StudyKey:
    """Read the key of a study."""
    content = read_json(path, KEY, VERSION, "`mien study make`", _KEY_REMEDY)
    with expect_whole(path, _KEY_REMEDY):
        key = StudyKey(
            _opaque(content["study"]),
            checked_whole(content["seed"], 0, 2**63 - 1),
            tuple(map(_label, content["runs"])),
            tuple(_key_clip(entry) for entry in content["clips"]),
        )
        if not key.clips or len({clip.name for clip in key.clips}) < len(key.clips):
            raise ValueError("its clips are missing or not unique")
        if not 2 <= len(key.runs) <= MOST_RUNS:
            raise ValueError(f"it has {len(key.runs)} runs")
        if any(sorted(clip.tiles.values()) != sorted(key.runs) for clip in key.clips):
            raise ValueError("a clip does not show each run once")
    return key


def read_answers(path: Path, key: StudyKey) -> Answers:
    """Read the answers of one participant."""
    content = _answer_json(path)
    with expect_whole(path, _AGAIN):
        study, participant = _opaque(content["study"]), _opaque(content["participant"])
        if study != key.study:
            raise UserError(
                f"{path}: answers study {study}, but the key is of study {key.study}; give the key of its page"
            )
        entries = {_opaque(entry["clip"]): entry for entry in content["answers"]}
        if len(entries) < len(content["answers"]):
            raise ValueError("it answers a clip twice")
        unknown = sorted(entries.keys() - {clip.name for clip in key.clips})
        if unknown:
            raise ValueError(f"it answers {unknown[0]}, which is no clip of the study")
        missing = len(key.clips) - len(entries)
        if missing:
            raise ValueError(f"{missing} of {len(key.clips)} clips have no answer")
        return Answers(participant, tuple(_answer(entries[clip.name], clip, key, participant) for clip in key.clips))


def read_all_answers(paths: Sequence[Path], key: StudyKey) -> list[Answers]:
    """Read answer files, and all .json files of folders, sorted by participant."""
    seen: dict[str, tuple[Path, Answers]] = {}
    for path in _answer_files(paths):
        answers = read_answers(path, key)
        if answers.participant in seen:
            other = seen[answers.participant][0]
            raise UserError(f"{path}: is of participant {answers.participant}, as {other} is; give each one once")
        seen[answers.participant] = path, answers
    return [seen[participant][1] for participant in sorted(seen)]


def _answer_files(paths: Sequence[Path]) -> list[Path]:
    found: list[Path] = []
    for path in paths:
        if not path.is_dir():
            found.append(path)
            continue
        inner = [one for one in listed(path, "*.json") if not one.name.endswith(".key.json")]
        if not inner:
            raise UserError(f"{path}: has no answer file (.json); put the participants' files there")
        found += inner
    return found


def _answer_json(path: Path) -> Mapping[str, Any]:
    try:
        content = parse_json(read_bytes(path, _MAX_BYTES).decode("utf-8"), unique_names=True)
    except FileNotFoundError:
        raise UserError(f"{path}: no such file; give the files that participants saved") from None
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: cannot be read as json ({error}); {_AGAIN}") from None
    found = (content.get("format"), content.get("version")) if isinstance(content, dict) else (None, None)
    if found != (ANSWERS, VERSION):
        raise UserError(
            f"{path}: has format {found[0]!r:.80} version {found[1]!r:.80}, expected {ANSWERS!r} version {VERSION}; "
            "give the files that participants saved"
        )
    return content


def _answer(entry: Mapping[str, Any], clip: KeyClip, key: StudyKey, participant: str) -> Answer:
    shown = [_opaque(name) for name in entry["shown"]]
    if shown != shuffled(list(clip.tiles), key.study, participant, clip.name):
        raise ValueError(f"the order of clip {clip.name} is not that of its participant")
    choices = {question: clip.tiles[_opaque(entry[question])] for question in QUESTIONS}
    return Answer(clip, tuple(clip.tiles[name] for name in shown), choices)


def _key_clip(entry: Mapping[str, Any]) -> KeyClip:
    tiles = {_opaque(tile): _label(run) for tile, run in entry["tiles"].items()}
    return KeyClip(
        _opaque(entry["name"]),
        _label(entry["workspace"]),
        _label(entry["sequence"]),
        _label(entry["camera_id"]),
        checked_whole(entry["first"], 0, _MAX_TIMESTEP),
        checked_whole(entry["timesteps"], 1, _MAX_TIMESTEP),
        tiles,
    )


def _opaque(name: object) -> str:
    if not isinstance(name, str) or _NAME.fullmatch(name) is None:
        raise ValueError(f"{name!r:.40} is not a name of a page")
    return name


def _label(name: object) -> str:
    if not is_one_line(name) or not name:
        raise ValueError(f"{name!r:.40} is not a name")
    return str(name)
