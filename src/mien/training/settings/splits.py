"""Splits: which frames are held out for scoring. `SPLITS` is the table of --split.

Needs no torch, because commands check splits before any work.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from mien.disk.files import read_json, write_json
from mien.disk.reading import expect_whole
from mien.errors import UserError
from mien.training.settings import Split, TrainSettings

NAMED_SPLIT, BENCHMARK_SPLIT, OWN_SPLIT = "gaussian-avatars", "nersemble-benchmark", "dataset"

SEQUENCES = ("EMO-1", "EMO-2", "EMO-3", "EMO-4", "EXP-2", "EXP-3", "EXP-4", "EXP-5", "EXP-8", "EXP-9")
"""The sequences that GaussianAvatars trains on, except for the subject's held-out one (its supplement, table 1)."""
DRIVING = "FREE"
"""The sequence that it never trains on and that drives avatars of other subjects."""
HELD_OUT = {
    "074": "EMO-4",
    "104": "EXP-2",
    "218": "EXP-9",
    "253": "EMO-4",
    "264": "EXP-9",
    "302": "EMO-2",
    "304": "EXP-2",
    "306": "EXP-2",
    "460": "EMO-3",
}
"""The held-out sequence of each subject (table 2)."""
NOVEL_VIEW = ("08", "222200037")
"""Names of the camera that it holds out, the frontal one: its index in NeRSemble, and its serial number."""
TEST_SEQUENCES = ("FREE", "EMO-1-shout+laugh", "SEN-09-frown_events_bad", "SEN-10-port_strong_smokey")
"""Sequences that the NeRSemble benchmark's monocular task renders. It publishes only their tracking."""
TRAINING_CAMERA = "222200037"
"""The frontal camera, the only one of the monocular task that is trained on."""
TEST_CAMERAS = (TRAINING_CAMERA, "222200046", "220700191", "222200039")
"""Cameras from which the test sequences of the monocular task are rendered."""
HIDDEN_CAMERAS = ("222200046", "222200037", "222200039")
"""Cameras of the benchmark's task of novel views whose pictures are not published."""
_ID = re.compile(r"(?<![A-Z])(?:(EMO|EXP)-0?(\d)(?!\d)|FREE(?![A-Z]))")
_TEST = re.compile(r"(?<![A-Z])(?:FREE(?![A-Z])|EMO-0?1(?!\d)|SEN-0?9(?!\d)|SEN-10(?!\d))")
_BY_HAND = "choose yourself with --split none, --hold-out NAME and --hold-out-cameras ID"
_OTHER = "choose another --split"
_FILE, _FORMAT, _VERSION = "dataset.json", "mien.dataset", 1
_REMEDY = "import the dataset again into a new workspace"


@dataclass(frozen=True)
class OwnSplit:
    """What the authors of a dataset held out of one sequence."""

    timesteps: tuple[tuple[int, int], ...] = ()
    """Ranges of timesteps that are held out in all cameras: the first one, and the one after the last."""
    cameras: tuple[str, ...] = ()
    """Ids of cameras that are held out at all timesteps."""

    def holds_out(self, timestep: int) -> bool:
        """Whether a timestep is held out."""
        return any(start <= timestep < stop for start, stop in self.timesteps)

    def whole(self, timesteps: int) -> bool:
        """Whether the whole sequence of so many timesteps is held out."""
        return all(self.holds_out(timestep) for timestep in range(timesteps))


@dataclass(frozen=True)
class Recorded:
    """What a split may depend on of a captured sequence."""

    camera_ids: tuple[str, ...] = ()
    timesteps: int = 0
    own: OwnSplit | None = None


@dataclass(frozen=True)
class Recordings:
    """The sequences of a workspace that a run is asked to use."""

    sequences: Mapping[str, Recorded | None]
    """By name. None before their captures were read."""
    folder: str = ""
    """Name of the workspace's folder."""
    subject: str | None = None
    """Number of the subject in NeRSemble, if it was given."""


class HeldOut(NamedTuple):
    """Names of whole sequences, and ids of cameras."""

    sequences: tuple[str, ...]
    cameras: tuple[str, ...] | None
    """None if captures have to be read first."""


@dataclass(frozen=True)
class SplitRule:
    """A rule that says what is held out."""

    timesteps: Callable[[int, Path | None], Sequence[tuple[int, int]]] = lambda count, folder: ()
    """(number of timesteps, the sequence's folder) -> ranges of held-out timesteps."""
    held_out: Callable[[Recordings], HeldOut | None] | None = None
    """Whole sequences and cameras that are held out; None before the captures were read.

    Without it, the split leaves them to --hold-out."""
    used: Callable[[Recordings], list[str]] = lambda given: list(given.sequences)
    """The names of the sequences that a run uses."""
    of_cameras: bool = False
    """Whether `held_out` always names a sequence or a camera."""
    needs: str = ""
    """What `mien create`, which makes one sequence, lacks for it. Empty if it lacks nothing."""


def _blocks(count: int, folder: Path | None) -> Sequence[tuple[int, int]]:
    """Every fifth block of 10 timesteps, so that test poses and expressions resemble those of training.

    Sequences of fewer than 50 timesteps have shorter blocks, so that they have a fifth one.
    """
    size = min(10, max(1, count // 5))
    return [(first, first + size) for first in range(4 * size, count, 5 * size)]


def _tail(count: int, folder: Path | None) -> Sequence[tuple[int, int]]:
    return [(count - round(0.2 * count), count)]


def _named_used(given: Recordings) -> list[str]:
    """The ten sequences of a subject of GaussianAvatars.

    A sequence is recognised by the part of its name that is an id: EMO-1, EMO-1-shout+laugh and 306_EMO-1 are the same.
    """
    found: dict[str, str] = {}
    for name in given.sequences:
        key = _key(name)
        if key in found and key in SEQUENCES:
            raise UserError(
                f"--split {NAMED_SPLIT}: {found[key]} and {name} are both {key}; name one of them with --sequences"
            )
        found[key] = name
    subject, missing = _subject(given), [key for key in SEQUENCES if key not in found]
    if missing:
        raise UserError(
            f"--split {NAMED_SPLIT}: {', '.join(missing)} of subject {subject} is missing; capture it with --name "
            f"{missing[0]} and track again, or {_BY_HAND}"
        )
    return [found[key] for key in SEQUENCES]


def _named(given: Recordings) -> HeldOut:
    """A sequence of each subject, and the frontal camera (GaussianAvatars' supplement, section B, tables 1 and 2)."""
    used = _named_used(given)
    sequence, cameras = used[SEQUENCES.index(HELD_OUT[_subject(given)])], set()
    for name in used:
        one = given.sequences[name]
        if one is None:
            return HeldOut((sequence,), None)
        own = [camera for camera in one.camera_ids if camera in NOVEL_VIEW]
        if not own:
            raise UserError(
                f"--split {NAMED_SPLIT}: {name} has no camera {' or '.join(NOVEL_VIEW)}, which it holds out (there are "
                f"{', '.join(one.camera_ids)}); give the cameras their NeRSemble ids when you capture, or {_BY_HAND}"
            )
        cameras.update(own)
    return HeldOut((sequence,), tuple(sorted(cameras)))


def _benchmark(given: Recordings) -> HeldOut | None:
    """The NeRSemble benchmark (version 2), for people whose sequences are all there: it publishes no test pictures.

    With test sequences, it is the monocular task: they are held out, and all cameras but the frontal one. Without, it
    is the task of novel views: the three hidden cameras are held out.
    """
    known = [one for one in given.sequences.values() if one is not None]
    if len(known) < len(given.sequences):
        return None
    names, words = tuple(given.sequences), f"--split {BENCHMARK_SPLIT}"
    tests = tuple(name for name in names if _TEST.search(name))
    ids = tuple(dict.fromkeys(camera for one in known for camera in one.camera_ids))
    if len(tests) == len(names):
        raise UserError(f"{words}: holds out all of {', '.join(names)}, and nothing is left to train on; {_BY_HAND}")
    cameras = tuple(camera for camera in ids if (camera != TRAINING_CAMERA if tests else camera in HIDDEN_CAMERAS))
    if len(cameras) == len(ids):
        wanted = f"camera {TRAINING_CAMERA}" if tests else f"a camera besides {', '.join(HIDDEN_CAMERAS)}"
        raise UserError(f"{words}: trains on {wanted}, and there are {', '.join(ids)}; {_BY_HAND}")
    if not tests and not cameras:
        raise UserError(
            f"{words}: there is no test sequence (FREE, EMO-1, SEN-09, SEN-10) and no camera "
            f"{', '.join(HIDDEN_CAMERAS)} to hold out, because the benchmark publishes none; train with --split "
            "none, and write the submission with `mien export-dataset --format nersemble-benchmark`"
        )
    return HeldOut(tests, cameras)


def _own(given: Recordings) -> HeldOut | None:
    """What the authors of an imported dataset held out, listed in its dataset.json, so that no border moves."""
    splits: dict[str, tuple[OwnSplit, int]] = {}
    for name, one in given.sequences.items():
        if one is None:
            return None
        if one.own is None:
            raise UserError(f"--split {OWN_SPLIT}: the sequence {name} has no split of its dataset; {_OTHER}")
        splits[name] = (one.own, one.timesteps)
    whole = tuple(name for name, (own, timesteps) in splits.items() if own.whole(timesteps))
    cameras = tuple(dict.fromkeys(camera for own, _ in splits.values() for camera in own.cameras))
    if not whole and not cameras and not any(own.timesteps for own, _ in splits.values()):
        raise UserError(f"--split {OWN_SPLIT}: the dataset holds nothing out of {', '.join(splits)}; {_OTHER}")
    return HeldOut(whole, cameras)


def _own_timesteps(count: int, folder: Path | None) -> Sequence[tuple[int, int]]:
    own = read_own_split(folder)
    if own is None:
        raise UserError(f"--split {OWN_SPLIT}: {folder} has no split of its dataset; {_OTHER}")
    return own.timesteps


SPLITS: dict[Split, SplitRule] = {
    "blocks": SplitRule(_blocks),
    "tail": SplitRule(_tail),
    "none": SplitRule(),
    "gaussian-avatars": SplitRule(held_out=_named, used=_named_used, of_cameras=True, needs="ten sequences of a rig"),
    "nersemble-benchmark": SplitRule(held_out=_benchmark, of_cameras=True, needs="several sequences of a rig"),
    "dataset": SplitRule(_own_timesteps, _own, needs="the sequences of an imported dataset"),
}


def fill_in(settings: TrainSettings, given: Recordings) -> TrainSettings:
    """The settings with the whole sequences and cameras that their split holds out, as far as that is known."""
    rule = SPLITS[settings.split]
    out = None if rule.held_out is None else rule.held_out(given)
    if out is None:
        return settings
    for option, asked, wanted in (
        ("--hold-out", settings.held_out_sequences, out.sequences),
        ("--hold-out-cameras", settings.held_out_cameras, out.cameras),
    ):
        other = [name for name in asked if wanted is not None and name not in wanted]
        if other:
            raise UserError(
                f"{option} {other[0]}: --split {settings.split} decides what is held out; leave {option} out"
            )
    cameras = settings.held_out_cameras if out.cameras is None else out.cameras
    return replace(settings, held_out_sequences=out.sequences, held_out_cameras=cameras)


def driving_sequences(names: Sequence[str]) -> list[str]:
    """The names of those sequences that drive avatars of other subjects of GaussianAvatars."""
    return [name for name in names if _key(name) == DRIVING]


def _key(name: str) -> str:
    match = _ID.search(name)
    if match is None:
        return ""
    return f"{match[1]}-{match[2]}" if match[1] else DRIVING


def _subject(given: Recordings) -> str:
    known = f"the subjects are {', '.join(HELD_OUT)}"
    if given.subject is not None:
        number = given.subject.zfill(3)
        if number not in HELD_OUT:
            raise UserError(
                f"--subject {given.subject}: is not a subject of --split {NAMED_SPLIT}; {known}; {_BY_HAND}"
            )
        return number
    numbers = [number for number in re.findall(r"\d+", given.folder) if number in HELD_OUT]
    if len(set(numbers)) != 1:
        raise UserError(
            f"--split {NAMED_SPLIT}: the folder's name {given.folder!r} does not say which subject it is; give "
            f"--subject ({known}), or {_BY_HAND}"
        )
    return numbers[0]


def ranges_of(timesteps: list[int]) -> tuple[tuple[int, int], ...]:
    """Return the ranges that a list of timesteps consists of."""
    ranges: list[tuple[int, int]] = []
    for timestep in sorted(set(timesteps)):
        if ranges and ranges[-1][1] == timestep:
            ranges[-1] = (ranges[-1][0], timestep + 1)
        else:
            ranges.append((timestep, timestep + 1))
    return tuple(ranges)


def write_own_split(folder: Path, split: OwnSplit | None, about: Mapping[str, Any]) -> None:
    """Write dataset.json of a sequence: its split, if the dataset has one, and facts about the import."""
    held_out = None
    if split is not None:
        held_out = {"timesteps": [list(each) for each in split.timesteps], "cameras": list(split.cameras)}
    write_json(folder / _FILE, _FORMAT, _VERSION, {**about, "held_out": held_out})


def read_own_split(folder: Path | None) -> OwnSplit | None:
    """Return the split of a sequence. It is None for sequences that were not imported, or whose dataset has none."""
    if folder is None or not (folder / _FILE).exists():
        return None
    held_out = read_json(folder / _FILE, _FORMAT, _VERSION, remedy=_REMEDY).get("held_out")
    with expect_whole(folder / _FILE, _REMEDY):
        return held_out and OwnSplit(tuple((a, b) for a, b in held_out["timesteps"]), tuple(held_out["cameras"]))


def imported_from(folder: Path) -> str | None:
    """Return the name of the dataset that a sequence was imported from, or None if it was not imported."""
    if not (folder / _FILE).exists():
        return None
    content = read_json(folder / _FILE, _FORMAT, _VERSION, remedy=_REMEDY)
    with expect_whole(folder / _FILE, _REMEDY):
        return str(content["imported"]["dataset"])
