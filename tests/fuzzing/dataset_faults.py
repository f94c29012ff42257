"""Faults of datasets by their meaning: a missing camera, other lengths, NaN, hostile pickles, zip bombs, links."""

import io
import json
import os
import pickle
import zipfile
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

_BOMB = 320 << 20
"""Bytes that a bomb unpacks to. All of them are zeros."""
_ARCHIVES = (".frame", ".npz")


class RunsCode:
    """A value whose pickle makes a folder when it is read."""

    def __init__(self, place: Path) -> None:
        self.place = place

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.place),)


def faulty_dataset(root: Path, canary: Path, dice: Random, only: str | None = None) -> str:
    """Make one fault in a copy of a dataset, and return what it is.

    Args:
        root: The copy.
        canary: Folder outside of it, into which links lead and in which hostile pickles make a folder.
        dice: Random numbers.
        only: One of `KINDS`, or None for any.
    """
    kinds = list(KINDS)
    dice.shuffle(kinds)
    kinds = kinds if only is None else [only]
    for kind in kinds:
        told = _FAULTS[kind](root, canary, dice)
        if told is not None:
            return f"{kind}: {told}"
    raise AssertionError("no fault fits")


def _missing_camera(root: Path, canary: Path, dice: Random) -> str | None:
    """Take a camera out of a calibration, out of a list of frames, or the intrinsics out of a file."""
    file = _pick(root, dice, (".json",))
    if file is None:
        return None
    content = json.loads(file.read_text())
    if isinstance(content.get("world_2_cam"), dict):
        serial = dice.choice(sorted(content["world_2_cam"]))
        owners = [content[key] for key in ("world_2_cam", "intrinsics") if isinstance(content.get(key), dict)]
        for owner in owners if dice.random() < 0.5 else [dice.choice(owners)]:
            owner.pop(serial, None)
        told = serial
    elif content.get("frames") and "camera_id" in content["frames"][0]:
        told = dice.choice(sorted({frame["camera_id"] for frame in content["frames"]}))
        some = dice.random() < 0.5  # at one timestep only, or at all of them
        gone = [frame for frame in content["frames"] if frame["camera_id"] == told]
        gone = [dice.choice(gone)] if some else gone
        content["frames"] = [frame for frame in content["frames"] if frame not in gone]
    else:
        owner = dice.choice([content, *content.get("frames", [])])
        keys = [
            key for key in owner if key in ("intrinsics", "world_mat", "transform_matrix", "fl_x", "fx", "cx", "cy")
        ]
        if not keys:
            return None
        told = dice.choice(keys)
        del owner[told]
    file.write_text(json.dumps(content))
    return f"{told} of {file.relative_to(root)}"


def _other_lengths(root: Path, canary: Path, dice: Random) -> str | None:
    """Shorten or lengthen a list of numbers, an array, or the list of frames."""

    def changed(value: Any) -> Any:
        if isinstance(value, list):
            return value[:-1] if dice.random() < 0.6 else [*value, value[-1]]
        axis = dice.randrange(value.ndim)
        more = np.concatenate([value, np.take(value, [-1], axis)], axis)
        return np.take(value, range(value.shape[axis] - 1), axis) if dice.random() < 0.6 else more

    return _in_values(root, dice, lambda value: _is_list(value) or (_is_array(value) and value.ndim > 0), changed)


def _not_a_number(root: Path, canary: Path, dice: Random) -> str | None:
    """Replace a number by NaN, infinity, or a number that is too large."""
    odd = dice.choice([float("nan"), float("inf"), -float("inf"), 1e30, 1e9])

    def changed(value: Any) -> Any:
        if isinstance(value, str):
            return str(odd)
        if not _is_array(value):
            return odd
        array = value.astype(np.float64)
        array.flat[dice.randrange(array.size)] = odd
        return array.astype(value.dtype if value.dtype.kind == "f" else np.float32)

    return _in_values(root, dice, lambda value: _is_number(value) or (_is_array(value) and value.size > 0), changed)


def _hostile_pickle(root: Path, canary: Path, dice: Random) -> str | None:
    """Put a pickle that runs code where arrays are: in a checkpoint, or as an array of objects."""
    file = _pick(root, dice, (*_ARCHIVES, ".npy"))
    if file is None:
        return None
    hostile = RunsCode(canary / "ran")
    if file.suffix == ".frame":
        arrays = _read(file)
        arrays[dice.choice(sorted(arrays))] = dice.choice([hostile, {"exp": hostile}, [hostile]])
        whole = dice.random() < 0.3
        _write_frame(file, hostile if whole else arrays, dice.choice([0, 2, 4]))
        return f"{file.relative_to(root)}"
    objects = np.empty(2, object)
    objects[:] = hostile
    stored = io.BytesIO()
    np.save(stored, objects, allow_pickle=True)
    if file.suffix == ".npy":
        file.write_bytes(dice.choice([stored.getvalue(), pickle.dumps(hostile)]))
        return f"{file.relative_to(root)}"
    members = _members(file)
    name = dice.choice(sorted(members))
    _write_zip(file, {**members, name: stored.getvalue()})
    return f"{name} of {file.relative_to(root)}"


def _bomb(root: Path, canary: Path, dice: Random) -> str | None:
    """Put a small archive that unpacks to much in the place of an archive."""
    file = _pick(root, dice, _ARCHIVES)
    if file is None:
        return None
    member = "archive/data.pkl" if file.suffix == ".frame" else dice.choice(sorted(_members(file)))
    file.write_bytes(_zip_of_zeros(member))
    return f"{member} of {file.relative_to(root)}"


def _link(root: Path, canary: Path, dice: Random) -> str | None:
    """Put a link in the place of a file or of a folder: out of the dataset, to itself, or to nothing."""
    place = dice.choice(sorted(each for each in root.rglob("*") if not each.is_symlink()))
    aside = canary / f"moved{place.suffix}"
    targets = [canary / "file", canary, aside, place, root / "nothing", Path("/"), Path("..")]
    target = dice.choice(targets)
    if target == aside and not aside.exists():
        place.rename(aside)  # the link leads to what was there, and yet it leads out
    elif place.is_dir():
        place.rename(root.parent / f"{root.name}-aside")
    else:
        place.unlink()
    place.symlink_to(target)
    return f"{place.relative_to(root)} to {target}"


_FAULTS: dict[str, Callable[[Path, Path, Random], str | None]] = {
    "camera": _missing_camera, "lengths": _other_lengths, "numbers": _not_a_number, "pickle": _hostile_pickle,
    "bomb": _bomb, "link": _link,
}  # fmt: skip
KINDS = tuple(_FAULTS)


def _pick(root: Path, dice: Random, suffixes: tuple[str, ...]) -> Path | None:
    files = sorted(each for each in root.rglob("*") if each.is_file() and each.suffix in suffixes)
    files = [each for each in files if each.name != "truth.npz"]  # belongs to the tests
    return dice.choice(files) if files else None


def _in_values(root: Path, dice: Random, fits: Callable[[Any], bool], changed: Callable[[Any], Any]) -> str | None:
    """Change one value of a json file, an archive or a checkpoint."""
    file = _pick(root, dice, (".json", ".npy", ".csv", *_ARCHIVES))
    if file is None:
        return None
    content = _read(file)
    places = [place for place in _places({"": content}) if fits(place[0][place[1]])]
    if not places:
        return None
    container, key = dice.choice(places)
    container[key] = changed(container[key])
    whole = container[key] if key == "" else content
    if file.suffix == ".json":
        file.write_text(json.dumps(whole))
    elif file.suffix == ".frame":
        _write_frame(file, whole, 2)
    elif file.suffix == ".npy":
        np.save(file, whole)
    elif file.suffix == ".csv":
        file.write_text("\n".join(",".join(row) for row in whole))
    else:
        np.savez(file, **whole)
    return f"{key!r} of {file.relative_to(root)}"


def _places(value: Any) -> Iterator[tuple[Any, Any]]:
    """Yield each container with a key of it, of all that is in a value."""
    keys = value.keys() if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ()
    for key in list(keys):
        yield value, key
        yield from _places(value[key])


def _read(file: Path) -> Any:
    """Return the content of a file that a writer of the tests made."""
    if file.suffix == ".json":
        return json.loads(file.read_text())
    if file.suffix == ".frame":
        return pickle.loads(_members(file)["archive/data.pkl"])
    if file.suffix == ".npy":
        return np.load(file)
    if file.suffix == ".csv":
        return [line.split(",") for line in file.read_text().splitlines()]
    with np.load(file) as arrays:
        return dict(arrays)


def _members(file: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(file) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def _write_zip(file: Path, members: dict[str, bytes]) -> None:
    with zipfile.ZipFile(file, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)


def _write_frame(file: Path, content: Any, protocol: int) -> None:
    _write_zip(file, {"archive/data.pkl": pickle.dumps(content, protocol), "archive/version": b"3\n"})


@cache
def _zip_of_zeros(member: str) -> bytes:
    data = io.BytesIO()
    with (
        zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open(member, "w", force_zip64=True) as stream,
    ):
        for _ in range(_BOMB >> 20):
            stream.write(bytes(1 << 20))
    return data.getvalue()


def _is_list(value: Any) -> bool:
    return isinstance(value, list) and bool(value)


def _is_array(value: Any) -> bool:
    return isinstance(value, np.ndarray)


def _is_number(value: Any) -> bool:
    if isinstance(value, str):  # a cell of a table
        return value.replace(".", "", 1).isdigit()
    return isinstance(value, int | float) and not isinstance(value, bool)
