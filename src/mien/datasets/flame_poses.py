"""Heads of trackers in FLAME's terms: rigid motions of the whole head, and the one camera of monocular trackers."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from mien.camera import Camera
from mien.errors import UserError
from mien.face.model import FaceModel
from mien.face.models.flame_params import face_of_flame_params
from mien.face.params import FaceParams
from mien.rotation import axis_angle_from_matrix, matrix_from_axis_angle

AXES = np.diag([1.0, -1.0, -1.0])
"""Turns OpenCV's axes of a camera (x right, y down, z ahead) into OpenGL's (x right, y up, z back), and back."""
FRONT = np.diag([1.0, -1.0, -1.0, 1.0])
"""World-to-camera matrix of the one camera of a monocular sequence, as `mien track` places it."""


def needed_flame(path: Path, face_model: FaceModel | None, version: str) -> FaceModel:
    """Return the face model that the user named, which has to be FLAME of the version that the tracking belongs to."""
    if face_model is None:
        raise UserError(
            f"{path}: its tracking needs {version}, which mien may not contain; give it with --face-model FILE.pkl "
            "(docs/face_models.md), or track the pictures with mien's own model (--retrack)"
        )
    if face_model.flame_origin is None:
        raise UserError(
            f"{path}: its tracking needs {version}, and the face model {face_model.name!r} is not in FLAME's schema; "
            "give FLAME with --face-model FILE.pkl, or track the pictures with mien's own model (--retrack)"
        )
    return face_model


def face_of_flame(path: Path, face_model: FaceModel, arrays: Mapping[str, np.ndarray]) -> FaceParams:
    """Return face parameters from some of the arrays of flame_param.npz. Missing poses are at rest.

    They are `shape` [n] and `expr` [t, e], and perhaps others (`mien.face.models.flame_params.face_of_flame_params`).
    """
    t = len(arrays["expr"])
    rest = {name: np.zeros((t, 3)) for name in ("rotation", "translation", "neck_pose", "jaw_pose")}
    return face_of_flame_params(path, {**rest, "eyes_pose": np.zeros((t, 6)), **arrays}, face_model)


def carried(
    face: FaceParams, rotations: Float[np.ndarray, "*t 3 3"], translations: Float[np.ndarray, "*t 3"]
) -> FaceParams:
    """Return the same faces after a rigid motion of each: x -> R x + t, in float64."""
    turns, shifts = (torch.from_numpy(np.ascontiguousarray(each, np.float64)) for each in (rotations, translations))
    pose = matrix_from_axis_angle(face.head_rotation.double())
    place = (turns @ face.head_translation.double()[..., None])[..., 0] + shifts
    return replace(face, head_rotation=axis_angle_from_matrix(turns @ pose).float(), head_translation=place.float())


def in_front(face: FaceParams, viewmats: Float[np.ndarray, "*t 4 4"]) -> FaceParams:
    """Return faces seen by a moving camera as moving faces seen by the camera `FRONT`.

    `viewmats` are world-to-camera matrices with OpenCV's axes: one for each timestep, or one of a camera that stands.
    """
    return carried(face, AXES @ viewmats[..., :3, :3], viewmats[..., :3, 3] @ AXES)


def camera_of(K: Float[np.ndarray, "3 3"], viewmat: Float[np.ndarray, "4 4"], size: tuple[int, int]) -> Camera:
    """Return a camera for pictures of this width and height."""
    return Camera(torch.tensor(K, dtype=torch.float32), torch.tensor(viewmat, dtype=torch.float32), *size)


def viewmats_from_opengl(poses: Float[np.ndarray, "*t 4 4"]) -> Float[np.ndarray, "*t 4 4"]:
    """World-to-camera matrices with OpenCV's axes, from camera-to-world matrices with OpenGL's."""
    return np.linalg.inv(poses @ np.diag([1.0, -1.0, -1.0, 1.0]))


def pinhole(fx: float, fy: float, cx: float, cy: float) -> Float[np.ndarray, "3 3"]:
    """Return a matrix of intrinsics in pixels."""
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


def matrices_from_rows_6d(values: Float[np.ndarray, "*b 6"]) -> Float[np.ndarray, "*b 3 3"]:
    """Return rotations from six numbers each: the first two rows, made orthonormal (Zhou et al. 2019)."""
    first = values[..., :3] / np.linalg.norm(values[..., :3], axis=-1, keepdims=True)
    second = values[..., 3:] - (first * values[..., 3:]).sum(-1, keepdims=True) * first
    second = second / np.linalg.norm(second, axis=-1, keepdims=True)
    return np.stack([first, second, np.cross(first, second)], axis=-2)


def axis_angles(matrices: Float[np.ndarray, "*b 3 3"]) -> Float[np.ndarray, "*b 3"]:
    """Return the axis-angle vector of each rotation."""
    return axis_angle_from_matrix(torch.from_numpy(np.ascontiguousarray(matrices))).numpy()
