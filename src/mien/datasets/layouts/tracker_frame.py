"""A checkpoint of metrical-tracker, `NUMBER.frame`: an archive of torch with a pickle of numpy arrays."""

import pickle
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mien.rotation import matrix_from_axis_angle

_NEW, _OLD = b"cnumpy._core.", b"cnumpy.core."
"""Pickles look for numpy's arrays here: numpy 2 finds both, and the old numpy of those programs only the latter."""


def write_tracker_frame(
    path: Path, flame: Mapping[str, np.ndarray], view: tuple[np.ndarray, ...], size: tuple[int, int], number: int
) -> None:
    """Write a checkpoint. FLAME's root and neck are at rest in it, and the camera moves.

    `flame` holds `shape` [300], `expr` [100], `jaw_pose` [3], and `eyes_pose` [6] (left, then right), axis-angles.
    `view` is the world-to-camera rotation and translation with OpenCV's axes, in metres, and intrinsics in pixels.
    """
    rotation, translation, K = view
    eyes = np.concatenate([_six(part) for part in np.split(flame["eyes_pose"], 2)], axis=1)
    content = {
        "flame": {
            "exp": _row(flame["expr"]), "shape": _row(flame["shape"]), "jaw": _float32(_six(flame["jaw_pose"])),
            "eyes": _float32(eyes), "eyelids": np.zeros((1, 2), np.float32),
        },
        "opencv": {"R": _row(rotation), "t": _row(translation), "K": _row(K)},
        "img_size": np.array([size[1], size[0]]), "frame_id": f"{number:05d}", "global_step": 0,
    }  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("archive/data.pkl", _pickled(content))
        archive.writestr("archive/version", "3\n")


def _pickled(content: Any) -> bytes:
    return pickle.dumps(content, protocol=2).replace(_NEW, _OLD)


def _six(axis_angle: np.ndarray) -> np.ndarray:
    """The first two rows of a rotation, [1, 6]."""
    return matrix_from_axis_angle(torch.from_numpy(axis_angle).double()).numpy()[:2].reshape(1, 6)


def _row(array: np.ndarray) -> np.ndarray:
    return _float32(array[None])


def _float32(array: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(array, np.float32)
