"""Faults of datasets by their meaning: a missing camera, hostile pickles, zip bombs, links.

Other lengths, NaN and the like are faults of a format (`fuzzing.formats`).
"""

import io
import json
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from fuzzing.formats import bomb_of, members_of, zip_of

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
    for kind in kinds if only is None else [only]:
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
        told = dice.choice(sorted(content["world_2_cam"]))
        owners = [content[key] for key in ("world_2_cam", "intrinsics") if isinstance(content.get(key), dict)]
        for owner in owners if dice.random() < 0.5 else [dice.choice(owners)]:
            owner.pop(told, None)
    elif content.get("frames") and "camera_id" in content["frames"][0]:
        told = dice.choice(sorted({frame["camera_id"] for frame in content["frames"]}))
        gone = [frame for frame in content["frames"] if frame["camera_id"] == told]
        gone = [dice.choice(gone)] if dice.random() < 0.5 else gone  # at one timestep only, or at all of them
        content["frames"] = [frame for frame in content["frames"] if frame not in gone]
    else:
        owner = dice.choice([content, *content.get("frames", [])])
        names = ("intrinsics", "world_mat", "transform_matrix", "fl_x", "fx", "cx", "cy")
        keys = [key for key in owner if key in names]
        if not keys:
            return None
        told = dice.choice(keys)
        del owner[told]
    file.write_text(json.dumps(content))
    return f"{told} of {file.relative_to(root)}"


def _hostile_pickle(root: Path, canary: Path, dice: Random) -> str | None:
    """Put a pickle that runs code where arrays are: in a checkpoint, or as an array of objects."""
    file, hostile = _pick(root, dice, (*_ARCHIVES, ".npy")), RunsCode(canary / "ran")
    if file is None:
        return None
    if file.suffix == ".frame":
        arrays = pickle.loads(members_of(file.read_bytes())["archive/data.pkl"])
        arrays[dice.choice(sorted(arrays))] = dice.choice([hostile, {"exp": hostile}, [hostile]])
        data = pickle.dumps(hostile if dice.random() < 0.3 else arrays, dice.choice([0, 2, 4]))
        file.write_bytes(zip_of({"archive/data.pkl": data, "archive/version": b"3\n"}))
        return f"{file.relative_to(root)}"
    stored = io.BytesIO()
    objects = np.empty(2, object)
    objects[:] = hostile
    np.save(stored, objects, allow_pickle=True)
    if file.suffix == ".npy":
        file.write_bytes(dice.choice([stored.getvalue(), pickle.dumps(hostile)]))
        return f"{file.relative_to(root)}"
    members = members_of(file.read_bytes())
    name = dice.choice(sorted(members))
    file.write_bytes(zip_of({**members, name: stored.getvalue()}))
    return f"{name} of {file.relative_to(root)}"


def _bomb(root: Path, canary: Path, dice: Random) -> str | None:
    """Put a small archive that unpacks to much in the place of an archive."""
    file = _pick(root, dice, _ARCHIVES)
    if file is None:
        return None
    member = "archive/data.pkl" if file.suffix == ".frame" else dice.choice(sorted(members_of(file.read_bytes())))
    file.write_bytes(bomb_of(member, _BOMB))
    return f"{member} of {file.relative_to(root)}"


def _link(root: Path, canary: Path, dice: Random) -> str | None:
    """Put a link in the place of a file or of a folder: out of the dataset, to itself, or to nothing."""
    place = dice.choice(sorted(each for each in root.rglob("*") if not each.is_symlink()))
    aside = canary / f"moved{place.suffix}"
    target = dice.choice([canary / "file", canary, aside, place, root / "nothing", Path("/"), Path("..")])
    if target == aside and not aside.exists():
        place.rename(aside)  # the link leads to what was there, and yet it leads out
    elif place.is_dir():
        place.rename(root.parent / f"{root.name}-aside")
    else:
        place.unlink()
    place.symlink_to(target)
    return f"{place.relative_to(root)} to {target}"


_FAULTS: dict[str, Callable[[Path, Path, Random], str | None]] = {
    "camera": _missing_camera, "pickle": _hostile_pickle, "bomb": _bomb, "link": _link,
}  # fmt: skip
KINDS = tuple(_FAULTS)


def _pick(root: Path, dice: Random, suffixes: tuple[str, ...]) -> Path | None:
    files = sorted(each for each in root.rglob("*") if each.is_file() and each.suffix in suffixes)
    files = [each for each in files if each.name != "truth.npz"]  # belongs to the tests
    return dice.choice(files) if files else None
