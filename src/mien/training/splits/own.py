"""The split that a dataset's authors published: what of an imported sequence is held out, in its dataset.json.

Frames are listed, not computed from shares, so that a shorter import never moves the border.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mien.disk.files import read_json, write_json
from mien.disk.inside import is_one_line
from mien.errors import UserError
from mien.training.settings import TrainSettings

OWN_SPLIT = "dataset"
"""Name of the split, for --split."""
FORMAT, VERSION = "mien.dataset", 1
_FILE = "dataset.json"
_REMEDY = "import the dataset again into a new workspace"
_MAX_RANGES, _MAX_CAMERAS = 100_000, 1000
_BY_HAND = "choose another --split"


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
    held_out = None if split is None else {"timesteps": [list(each) for each in split.timesteps],
                                           "cameras": list(split.cameras)}  # fmt: skip
    write_json(folder / _FILE, FORMAT, VERSION, {**about, "held_out": held_out})


def read_own_split(folder: Path | None) -> OwnSplit | None:
    """Return the split of a sequence. It is None for sequences that were not imported, or whose dataset has none."""
    if folder is None or not (folder / _FILE).exists():
        return None
    path = folder / _FILE
    held_out = read_json(path, FORMAT, VERSION, remedy=_REMEDY).get("held_out")
    if held_out is None:
        return None
    ranges, cameras = (held_out.get(key) if isinstance(held_out, dict) else None for key in ("timesteps", "cameras"))
    if not isinstance(ranges, list) or not isinstance(cameras, list) or not _are_ranges(ranges):
        raise UserError(f"{path}: 'held_out' is damaged; {_REMEDY}")
    if len(cameras) > _MAX_CAMERAS or not all(is_one_line(each) for each in cameras):
        raise UserError(f"{path}: 'held_out' names impossible cameras; {_REMEDY}")
    return OwnSplit(tuple((start, stop) for start, stop in ranges), tuple(cameras))


def imported_from(folder: Path) -> str | None:
    """Return the name of the dataset that a sequence was imported from, or None if it was not imported."""
    if not (folder / _FILE).exists():
        return None
    imported = read_json(folder / _FILE, FORMAT, VERSION, remedy=_REMEDY).get("imported")
    name = imported.get("dataset") if isinstance(imported, dict) else None
    return name if is_one_line(name) else None


def with_own_split(
    settings: TrainSettings, splits: Mapping[str, OwnSplit | None], timesteps: Mapping[str, int]
) -> TrainSettings:
    """The settings with whole sequences and cameras that the dataset holds out filled in.

    Args:
        settings: Settings whose `split` is `OWN_SPLIT`.
        splits: The split of each sequence, by the sequence's name.
        timesteps: The number of timesteps of each sequence.
    """
    bare = [name for name, split in splits.items() if split is None]
    if bare:
        raise UserError(f"--split {OWN_SPLIT}: the sequence {bare[0]} has no split of its dataset; {_BY_HAND}")
    known = {name: split for name, split in splits.items() if split is not None}
    whole = tuple(name for name, split in known.items() if split.whole(timesteps[name]))
    cameras = tuple(dict.fromkeys(camera for split in known.values() for camera in split.cameras))
    if not whole and not cameras and not any(split.timesteps for split in known.values()):
        raise UserError(f"--split {OWN_SPLIT}: the dataset holds nothing out of {', '.join(known)}; {_BY_HAND}")
    for option, given, wanted in (
        ("--hold-out", settings.held_out_sequences, whole),
        ("--hold-out-cameras", settings.held_out_cameras, cameras),
    ):
        other = [name for name in given if name not in wanted]
        if other:
            raise UserError(f"{option} {other[0]}: --split {OWN_SPLIT} decides what is held out; leave {option} out")
    return replace(settings, held_out_sequences=whole, held_out_cameras=cameras)


def _are_ranges(ranges: list[Any]) -> bool:
    def is_range(each: Any) -> bool:
        return (
            isinstance(each, list) and len(each) == 2 and all(type(number) is int for number in each)
            and 0 <= each[0] < each[1]
        )  # fmt: skip

    return len(ranges) <= _MAX_RANGES and all(is_range(each) for each in ranges)
