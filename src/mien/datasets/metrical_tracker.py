"""Checkpoints of metrical-tracker: `NUMBER.frame`, a zip with one pickle, whose arrays are read without running it.

FLAME 2020 with the root and the neck at rest; the head's motion is that of the camera. Cameras are in OpenCV's
convention (`opencv.R`, `opencv.t`, `opencv.K`). The two numbers of the eyelids move vertices by fields that only
MPI may give away, and mien's FLAME has no place for them, so they are only counted.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from mien.datasets.content import REMEDY, rotation_part
from mien.datasets.flame_poses import axis_angles, face_of_flame, in_front, matrices_from_rows_6d
from mien.disk.limits import MAX_NUMBER
from mien.disk.reading import MAX_SIDE, open_archive, open_member, open_ordinary
from mien.errors import UserError
from mien.face.model import FaceModel
from mien.face.models.inert_pickle import parse_inert_pickle
from mien.face.models.npz import readable
from mien.face.params import FaceParams
from mien.machine.progress import progress_bar

VERSION = "FLAME 2020 (generic_model.pkl)"
_MAX_FRAME_BYTES = 8 << 20  # largest unpacked pickle in bytes. They have about 60 kB
_SHAPES = {
    "flame.exp": (1, 100), "flame.shape": (1, 300), "flame.jaw": (1, 6), "flame.eyes": (1, 12), "opencv.R": (1, 3, 3),
    "opencv.t": (1, 3), "opencv.K": (1, 3, 3),
}  # fmt: skip
_EYELIDS = "flame.eyelids"
_SIZE = "img_size"
_CLOSED = 0.3  # number of an eyelid above which a blink counts
_MAX_CHANGE = 0.005  # largest relative change of a focal length in a sequence. The tracker keeps it constant


TrackerCamera = tuple[Float[np.ndarray, "3 3"], tuple[int, int] | None]
"""The median intrinsics of a sequence's camera in pixels, and width and height of the pictures that were tracked. None
if the checkpoints do not tell."""


def read_tracker_camera(paths: Sequence[Path]) -> TrackerCamera:
    """Read the camera of a sequence's checkpoints."""
    return _camera(paths[0].parent, _read_arrays(paths))


def read_tracker_frames(paths: Sequence[Path], face_model: FaceModel) -> tuple[FaceParams, TrackerCamera, float]:
    """Read the checkpoints of a sequence, in order.

    Returns the faces, seen by a camera with the matrix `flame_poses.FRONT`, its camera, and the share of frames in
    which a lid is closed, which the faces do not show.
    """
    place, arrays = paths[0].parent, _read_arrays(paths)
    camera = _camera(place, arrays)
    eyes = matrices_from_rows_6d(arrays["flame.eyes"][:, 0].reshape(-1, 2, 6))
    face = face_of_flame(
        place,
        face_model,
        {
            "shape": arrays["flame.shape"][0, 0],
            "expr": arrays["flame.exp"][:, 0],
            "jaw_pose": axis_angles(matrices_from_rows_6d(arrays["flame.jaw"][:, 0])),
            "eyes_pose": axis_angles(eyes).reshape(-1, 6),
        },
    )
    viewmats = np.tile(np.eye(4), (len(paths), 1, 1))
    viewmats[:, :3, :3], viewmats[:, :3, 3] = arrays["opencv.R"][:, 0], arrays["opencv.t"][:, 0]
    lids = arrays.get(_EYELIDS)
    blinks = 0.0 if lids is None or len(lids) < len(paths) else float((lids > _CLOSED).any((1, 2)).mean())
    return in_front(face, viewmats), camera, blinks


def _read_arrays(paths: Sequence[Path]) -> dict[str, np.ndarray]:
    """The arrays of all checkpoints, in order. Those that a checkpoint may lack can have fewer rows."""
    rows: dict[str, list[np.ndarray]] = {name: [] for name in (*_SHAPES, _EYELIDS, _SIZE)}
    with progress_bar("read checkpoints", len(paths)) as advance:
        for path in paths:
            for name, array in _read_frame(path).items():
                rows[name].append(array)
            advance()
    return {name: np.stack(each) for name, each in rows.items() if each}


def _camera(place: Path, arrays: dict[str, np.ndarray]) -> TrackerCamera:
    K = np.median(arrays["opencv.K"][:, 0], axis=0)
    focal = arrays["opencv.K"][:, 0, 0, 0]
    if not np.abs(focal - K[0, 0]).max() <= _MAX_CHANGE * abs(K[0, 0]):
        raise UserError(
            f"{place}: the focal length changes from {focal.min():.1f} to {focal.max():.1f} pixels, and a sequence has "
            "one camera; track the pictures again (--retrack)"
        )
    sizes = arrays.get(_SIZE)
    if sizes is None:
        return K, None
    if (sizes != sizes[0]).any():
        raise UserError(f"{place}: {_SIZE!r} is not the same in all checkpoints; {REMEDY}")
    return K, (int(sizes[0, 1]), int(sizes[0, 0]))


def _read_frame(path: Path) -> dict[str, np.ndarray]:
    with readable(path, "a checkpoint of metrical-tracker", REMEDY):
        with open_ordinary(path) as file, open_archive(file) as archive:
            members = [member for member in archive.infolist() if member.filename.endswith("data.pkl")]
            if len(members) != 1:
                raise ValueError("it has no data.pkl")
            with open_member(archive, members[0]) as member:
                data = member.read(_MAX_FRAME_BYTES + 1)
            if len(data) > _MAX_FRAME_BYTES:
                raise ValueError(f"its data.pkl has more than {_MAX_FRAME_BYTES:,} bytes")
        found = parse_inert_pickle(data)
    arrays = {}
    for name, shape in _SHAPES.items():
        array = found.get(name)
        if not isinstance(array, np.ndarray) or array.shape != shape:
            told = list(array.shape) if isinstance(array, np.ndarray) else "nothing"
            raise UserError(f"{path}: {name!r} should have the shape {list(shape)}, here is {told}; {REMEDY}")
        if not np.abs(array).max() <= MAX_NUMBER:
            raise UserError(f"{path}: {name!r} holds NaN or numbers beyond {MAX_NUMBER:g}; {REMEDY}")
        arrays[name] = array.astype(np.float64)
    rotation_part(path, "opencv.R", arrays["opencv.R"][0])
    for name in ("flame.jaw", "flame.eyes"):
        rows = arrays[name].reshape(-1, 2, 3)
        if not np.linalg.norm(np.cross(rows[:, 0], rows[:, 1]), axis=-1).min() > 1e-3:
            raise UserError(f"{path}: {name!r} is no rotation of six numbers; {REMEDY}")
    lids = found.get(_EYELIDS)
    if isinstance(lids, np.ndarray) and lids.shape == (1, 2) and np.isfinite(lids).all():
        arrays[_EYELIDS] = lids.astype(np.float64)
    size = found.get(_SIZE)
    if isinstance(size, np.ndarray):
        if size.shape != (2,) or not ((size >= 1) & (size <= MAX_SIDE)).all():
            raise UserError(f"{path}: {_SIZE!r} is not the height and width of a picture; {REMEDY}")
        arrays[_SIZE] = size
    return arrays
