"""Faults of datasets by their meaning: a missing camera, hostile pickles, zip bombs, links.
Other lengths, NaN and the like are faults of a format (`fuzzing.formats`)."""

import json
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from fuzzing.formats import bomb_of, members_of, npy_of, zip_of

_BOMB = 320 << 20
"""Bytes that a bomb unpacks to. All of them are zeros."""
_INTRINSICS = ("intrinsics", "world_mat", "transform_matrix", "fl_x", "fx", "cx", "cy")


class RunsCode:
    """A value whose pickle makes a folder when it is read."""

    def __init__(self, place: Path) -> None:
        self.place = place

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.place),)


def faulty_dataset(root: Path, canary: Path, dice: Random, only: str | None = None) -> str:
    """Make one fault in a copy of a dataset, of any kind or of one, and return what it is.
    Links lead into the folder `canary` outside, and hostile pickles make a folder there."""
    kinds = list(KINDS)
    dice.shuffle(kinds)
    files = sorted(each for each in root.rglob("*") if each.is_file() and each.name != "truth.npz")  # for the tests
    for kind in kinds if only is None else [only]:
        suffixes, fault = _FAULTS[kind]
        if fitting := [each for each in files if not suffixes or each.suffix in suffixes]:
            file = dice.choice(fitting)
            if told := fault(file, root, canary, dice):
                return f"{kind}: {told} of {file.relative_to(root)}"
    raise AssertionError("no fault fits")


def _missing_camera(file: Path, root: Path, canary: Path, dice: Random) -> str:
    """Take a camera out of a calibration, out of a list of frames, or the intrinsics out of a file."""
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
        told = dice.choice([key for key in owner if key in _INTRINSICS] or [""])
        owner.pop(told, None)
    file.write_text(json.dumps(content))
    return told


def _hostile_pickle(file: Path, root: Path, canary: Path, dice: Random) -> str:
    """Put a pickle that runs code where arrays are: in a checkpoint, or as an array of objects."""
    hostile, name = RunsCode(canary / "ran"), "archive/data.pkl"
    objects = np.empty(2, object)
    objects[:] = hostile
    if file.suffix == ".npy":
        file.write_bytes(dice.choice([npy_of(objects), pickle.dumps(hostile)]))
        return "array"
    members = members_of(file.read_bytes())
    if file.suffix == ".frame":
        arrays = pickle.loads(members[name])
        arrays[dice.choice(sorted(arrays))] = dice.choice([hostile, {"exp": hostile}, [hostile]])
        members[name] = pickle.dumps(hostile if dice.random() < 0.3 else arrays, dice.choice([0, 2, 4]))
    else:
        name = dice.choice(sorted(members))
        members[name] = npy_of(objects)
    file.write_bytes(zip_of(members))
    return name


def _bomb(file: Path, root: Path, canary: Path, dice: Random) -> str:
    """Put a small archive that unpacks to much in the place of an archive."""
    member = "archive/data.pkl" if file.suffix == ".frame" else dice.choice(sorted(members_of(file.read_bytes())))
    file.write_bytes(bomb_of(member, _BOMB))
    return member


def _link(file: Path, root: Path, canary: Path, dice: Random) -> str:
    """Put a link in the place of a file or of its folder: out of the dataset, to itself, or to nothing."""
    place = dice.choice([file, *(each for each in file.parents if root in each.parents)])
    aside = canary / f"moved{place.suffix}"
    target = dice.choice([canary / "file", canary, aside, place, root / "nothing", Path("/"), Path("..")])
    if target == aside or place.is_dir():  # the link leads to what was there, and yet it leads out
        place.rename(aside if target == aside else root.parent / f"{root.name}-aside")
    else:
        place.unlink()
    place.symlink_to(target)
    return f"{place.name} to {target}"


_FAULTS: dict[str, tuple[tuple[str, ...], Callable[[Path, Path, Path, Random], str]]] = {
    "camera": ((".json",), _missing_camera), "pickle": ((".frame", ".npz", ".npy"), _hostile_pickle),
    "bomb": ((".frame", ".npz"), _bomb), "link": ((), _link),
}  # fmt: skip
KINDS = tuple(_FAULTS)
