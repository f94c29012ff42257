"""Files of strangers inside a dataset: paths that stay in it, json and arrays with checked numbers and shapes.

Nothing in them is run, and their size is limited. This file needs no torch: datasets are surveyed before any work.
"""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mien.disk.limits import MAX_NUMBER
from mien.disk.reading import is_one_line, open_ordinary, parse_json, read_bytes
from mien.errors import UserError
from mien.face.models.npz import parse_npy, read_npz, readable

REMEDY = "copy the files of the dataset again"


def sniff(path: Path) -> bytes:
    """Return the beginning of a file, in which the keys of a json's first frame are; nothing if it cannot be read."""
    try:
        with open_ordinary(path) as file:
            return file.read(1 << 20)
    except (OSError, ValueError):
        return b""


def read_object(path: Path) -> dict[str, Any]:
    """Read a json object. Its numbers may be NaN, because those that are used are checked by `numbers`."""
    with readable(path, "json", REMEDY):
        content = parse_json(read_bytes(path, 512 << 20).decode("utf-8"), constants=True)  # of 20,000 frames: 50 MB
    if not isinstance(content, dict):
        raise UserError(f"{path}: holds no object with names; {REMEDY}")
    return content


def frames_of(path: Path, content: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the list `frames` of a json file."""
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames:
        raise UserError(f"{path}: has no list 'frames' with an entry for each frame; {REMEDY}")
    for number, frame in enumerate(frames):
        if not isinstance(frame, dict):
            raise UserError(f"{path}: frame {number} is no object with names; {REMEDY}")
    return frames


def read_frames(path: Path) -> list[dict[str, Any]]:
    """Read the list `frames` of a json file."""
    return frames_of(path, read_object(path))


def pictures_of(
    path: Path, root: Path, frames: Sequence[Mapping[str, Any]], endings: Sequence[str] = ("",)
) -> list[Path]:
    """Return the files inside `root` that each frame of a json file names as its picture (`inner`)."""
    return [inner(path, root, frame.get("file_path"), endings) for frame in frames]


def numbers(path: Path, content: Mapping[str, Any], name: str, shape: tuple[int | None, ...]) -> np.ndarray:
    """Return an entry of a json object as a float64 array.

    In the shape that it must have, None stands for any length above 0, and () is that of a single number.
    """
    if name not in content:
        raise UserError(f"{path}: has no {name!r}; {REMEDY}")
    try:
        values = np.array(content[name], np.float64) if _is_numeric(content[name]) else None
    except (ValueError, TypeError, OverflowError):  # such as rows of different lengths
        values = None
    if values is None or values.ndim != len(shape) or 0 in values.shape or any(
        size is not None and size != found for size, found in zip(shape, values.shape, strict=True)
    ):  # fmt: skip
        told = "a number" if not shape else f"numbers in the shape {[size or 'n' for size in shape]}"
        raise UserError(f"{path}: {name!r} is not {told}; {REMEDY}")
    if not np.abs(values).max() <= MAX_NUMBER:
        raise UserError(f"{path}: {name!r} holds NaN or numbers beyond {MAX_NUMBER:g}; {REMEDY}")
    return values


def scalars(path: Path, content: Mapping[str, Any], *names: str) -> tuple[float, ...]:
    """Return entries of a json object that are single numbers."""
    return tuple(float(numbers(path, content, name, ())) for name in names)


def stacked(path: Path, frames: Sequence[Mapping[str, Any]], name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Return an entry of each frame [t, *shape]."""
    return np.stack([numbers(path, frame, name, shape) for frame in frames])


def stacked_poses(
    path: Path, frames: Sequence[Mapping[str, Any]], name: str, shape: tuple[int, ...] = (4, 4)
) -> np.ndarray:
    """Return a rigid motion of each frame [t, *shape], after a check of its rotation."""
    return np.stack([rotation_part(path, name, matrix) for matrix in stacked(path, frames, name, shape)])


def rotation_part(path: Path, name: str, matrix: np.ndarray) -> np.ndarray:
    """Return the matrix after a check that its first three columns and rows are orthonormal, up to a reflection."""
    rotation = matrix[:3, :3]
    if not np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-3:
        raise UserError(f"{path}: the rotation in {name!r} is not orthonormal; {REMEDY}")
    return matrix


def inner(path: Path, root: Path, name: object, endings: Sequence[str] = ("",)) -> Path:
    """Return the path of a file inside `root` that the file `path` names, relative to its own folder.

    The name may lack one of the endings; the first one whose file exists is added.
    """
    if not is_one_line(name) or not 0 < len(str(name)) <= 500 or Path(str(name)).is_absolute():
        raise UserError(f"{path}: {str(name)[:60]!r} is not the name of a file in the dataset; {REMEDY}")
    named = path.parent / str(name)
    for ending in endings:
        place = named.with_name(named.name + ending)
        if is_file_inside(root, place):
            return place
    raise UserError(f"{named}{endings[0]}: is missing; {REMEDY}")


def is_file_inside(root: Path, place: Path) -> bool:
    """Whether a file is there."""
    try:
        whole = place.resolve()
        if not whole.is_relative_to(root.resolve()):
            raise UserError(f"{place}: leads out of the dataset {root}; copy the file to its place instead")
        return whole.is_file()
    except (OSError, ValueError, RuntimeError):  # a name that is too long, or a link to itself
        return False


def png_has_opacity(path: Path) -> bool:
    """Whether a file is a PNG with opacities, by its beginning."""
    head = sniff(path)
    if head[:8] != b"\x89PNG\r\n\x1a\n":
        return False
    return head[25:26] in (b"\x04", b"\x06") or b"tRNS" in head.partition(b"IDAT")[0]


def check_file_inside(root: Path, place: Path) -> None:
    """Check that a file is there."""
    if not is_file_inside(root, place):
        raise UserError(f"{place}: is missing, or no file; {REMEDY}")


def numbered_files(folder: Path, ending: str, beginning: str = "") -> dict[int, Path]:
    """Return the files of a folder whose names are whole numbers after `beginning`, by these, in increasing order."""
    if not folder.is_dir():
        return {}
    found = {}
    for place in folder.iterdir():
        if place.suffix.lower() != ending or not place.stem.startswith(beginning):
            continue
        number = place.stem.removeprefix(beginning)
        if number.isascii() and number.isdigit() and len(number) < 10:
            found[int(number)] = place
    return dict(sorted(found.items()))


def _is_numeric(content: Any) -> bool:
    if isinstance(content, list):
        return all(map(_is_numeric, content))
    return isinstance(content, (int, float)) and not isinstance(content, bool)


def read_arrays(path: Path, axes: Mapping[str, str], sizes: Mapping[str, int]) -> dict[str, np.ndarray]:
    """Return arrays of an .npz by name. Floating point numbers become float32, and other types stay.

    `axes` has a letter for each axis of each array, such as "tyx3". Axes of one letter are equally long, and a digit is
    a length. `sizes` are lengths that are known, by letter.
    """
    from mien.face.models.schema import check_arrays

    with readable(path, ".npz", REMEDY):
        arrays = read_npz(path, tuple(axes))[1]
    shapes = {name: " ".join(letters) for name, letters in axes.items()}
    check_arrays(path, arrays, shapes, "it cannot be read", REMEDY, sizes)
    return {name: each.astype(np.float32) if each.dtype.kind == "f" else each for name, each in arrays.items()}


def read_npy(path: Path) -> np.ndarray:
    """Return the array of an .npy file of plain numbers."""
    with readable(path, ".npy", REMEDY):
        return parse_npy(read_bytes(path, 16 << 20))


def read_some_arrays(path: Path, names: Collection[str]) -> dict[str, np.ndarray]:
    """Return those of the named arrays of an .npz that it has, as float64, after a check of their numbers."""
    with readable(path, ".npz", REMEDY):
        arrays = read_npz(path, names)[1]
    for name, array in arrays.items():
        if array.size and not np.abs(array.astype(np.float64)).max() <= MAX_NUMBER:
            raise UserError(f"{path}: {name!r} holds NaN or numbers beyond {MAX_NUMBER:g}; {REMEDY}")
    return {name: array.astype(np.float64) for name, array in arrays.items()}
