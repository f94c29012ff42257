"""flame_param.npz, the face parameters in GaussianAvatars' folders: FLAME's own, and mien's `FaceParams`.

FLAME's chain starts at the shoulders and turns about joints that follow identity, expression and offsets; a mien head
is posed by itself (`mien.face.models.flame` explains how the two correspond). With R0 and R1 the rotations of FLAME's
root and neck, J0 and J1 these joints relative to the origin o of the head frame, and t FLAME's translation: head
rotation = R0 R1, head translation = R0 (J1 - R1 J1 - J0) + J0 + o + t, neck of mien = inverse of R1.
"""

import io
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mien.disk.files import write_atomically
from mien.disk.limits import MAX_NUMBER, is_moderate
from mien.errors import UserError
from mien.face.checks import check_face_params
from mien.face.model import FaceModel
from mien.face.models.npz import read_npz
from mien.face.params import FaceParams
from mien.rotation import axis_angle_from_matrix, matrix_from_axis_angle

_POSES = {"neck_pose": ("neck",), "jaw_pose": ("jaw",), "eyes_pose": ("left_eye", "right_eye")}
"""Free joints of mien by the array that holds their axis-angle vectors."""
_PER_FRAME = {"expr": None, "rotation": 3, "neck_pose": 3, "jaw_pose": 3, "eyes_pose": 6, "translation": 3}
"""Number of columns of the arrays with a row for each timestep; None for as many as there are."""
_WANTED = (*_PER_FRAME, "shape", "static_offset", "dynamic_offset")
TEETH = (5023, 5143)
"""Vertices of FLAME, without and with the teeth that GaussianAvatars adds. Trackings may lack offsets of the teeth."""
_REMEDY = "give flame_param.npz as GaussianAvatars or `mien export` wrote it"


@torch.no_grad()
def write_flame_params(path: Path, face_model: FaceModel, face: FaceParams) -> None:
    """Write face parameters at t timesteps as flame_param.npz.

    For models in FLAME's schema, these are FLAME's parameters. For others, `rotation` and `translation` are the pose of
    the head frame, and `shape` and `expr` are coefficients of the model's own directions.
    """
    arrays = flame_params_of(path, face_model, face)
    content = io.BytesIO()
    np.savez(content, **{name: array.astype(np.float32) for name, array in arrays.items()})  # pyright: ignore
    write_atomically(path, lambda temporary: temporary.write_bytes(content.getvalue()))


@torch.no_grad()
def flame_params_of(path: Path, face_model: FaceModel, face: FaceParams) -> dict[str, np.ndarray]:
    """Return the arrays of flame_param.npz for t timesteps, the inverse of `face_of_flame_params`."""
    free = face_model.free_joint_names
    others = set(free) - {name for names in _POSES.values() for name in names}
    if others:
        raise UserError(
            f"{path}: the face model {face_model.name!r} has a joint {min(others)!r}, which flame_param.npz cannot "
            "hold; export a .mien instead"
        )
    t, joints = len(face), dict(zip(free, face.joints.unbind(1), strict=True))
    still = face.expression.new_zeros(t, 3)
    poses = {
        key: torch.cat([joints.get(name, still) for name in names], dim=1).numpy() for key, names in _POSES.items()
    }
    rotation, translation = face.head_rotation, face.head_translation
    if face_model.flame_origin is not None:
        rotation, translation = _flame_root(face_model, face)
        poses["neck_pose"] = -poses["neck_pose"]
    offsets = face.vertex_offsets
    offsets = torch.zeros_like(face_model.template) if offsets is None else offsets
    return {
        "shape": face.identity.numpy(), "expr": face.expression.numpy(), "rotation": rotation.numpy(),
        "translation": translation.numpy(), "static_offset": offsets[None].numpy(), **poses,
    }  # fmt: skip


@torch.no_grad()
def read_flame_params(path: Path, face_model: FaceModel) -> FaceParams:
    """Read flame_param.npz as parameters of a face model. Nothing in it is run, and its size is limited."""
    try:
        arrays = read_npz(path, _WANTED)[1]
    except Exception as error:  # a damaged archive may fail in any way
        reason = " ".join(str(error).split())[:200]
        raise UserError(f"{path}: cannot be read as .npz ({reason}); {_REMEDY}") from None
    return face_of_flame_params(path, arrays, face_model)


@torch.no_grad()
def face_of_flame_params(path: Path, arrays: Mapping[str, np.ndarray], face_model: FaceModel) -> FaceParams:
    """Return parameters of a face model from arrays with the names and shapes of flame_param.npz.

    These are `shape` [n], `expr` [t, e], `rotation`, `translation`, `neck_pose` and `jaw_pose` [t, 3], `eyes_pose`
    [t, 6] (left, then right), and perhaps `static_offset` [1, v, 3]. Messages name `path`.
    """
    arrays = _checked(path, arrays)
    v = len(face_model.template)
    face = FaceParams(
        identity=_padded(path, "shape", arrays["shape"], len(face_model.identity_basis)),
        expression=_padded(path, "expr", arrays["expr"], len(face_model.expression_basis)),
        joints=_joints(face_model, arrays),
        head_rotation=torch.from_numpy(arrays["rotation"]),
        head_translation=torch.from_numpy(arrays["translation"]),
        vertex_offsets=_offsets(path, arrays.get("static_offset"), v),
    )
    if face_model.flame_origin is not None:
        face = _head_posed(face_model, face)
    check_face_params(face_model, face, str(path), _REMEDY)
    return face


def _checked(path: Path, arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays as float32, with their numbers and axes checked."""
    for name in ("shape", *_PER_FRAME):
        if name not in arrays:
            raise UserError(f"{path}: has no {name!r}; {_REMEDY}")
    for name, array in arrays.items():
        if not is_moderate(array):
            raise UserError(f"{path}: {name!r} holds NaN or numbers beyond {MAX_NUMBER:g}; {_REMEDY}")
    t = len(arrays["expr"]) if arrays["expr"].ndim == 2 else 0
    if not 0 < t <= 1_000_000:
        raise UserError(f"{path}: 'expr' has the shape {list(arrays['expr'].shape)}, not [timesteps, n]; {_REMEDY}")
    for name, columns in _PER_FRAME.items():
        wanted = [t, columns or arrays["expr"].shape[1]]
        if list(arrays[name].shape) != wanted:
            raise UserError(f"{path}: {name!r} has the shape {list(arrays[name].shape)}, not {wanted}; {_REMEDY}")
    if arrays["shape"].ndim != 1:
        raise UserError(f"{path}: 'shape' has the shape {list(arrays['shape'].shape)}, not [n]; {_REMEDY}")
    if "dynamic_offset" in arrays and arrays["dynamic_offset"].any():
        raise UserError(f"{path}: 'dynamic_offset' is not zero, and mien has no offsets by timestep; set it to zero")
    return {name: np.ascontiguousarray(array, np.float32) for name, array in arrays.items()}


def _padded(path: Path, name: str, values: np.ndarray, count: int) -> Float[Tensor, "*b n"]:
    """`values` with `count` columns: zeros are added, and columns of zeros are left out."""
    given = values.shape[-1]
    if given > count and values[..., count:].any():
        raise UserError(
            f"{path}: {name!r} has {given} coefficients, but the face model has {count} directions; import it with the "
            "face model that it was made with (--face-model)"
        )
    padded = torch.zeros(*values.shape[:-1], count)
    padded[..., : min(given, count)] = torch.from_numpy(values[..., :count])
    return padded


def _offsets(path: Path, values: np.ndarray | None, count: int) -> Float[Tensor, "v 3"] | None:
    """Static offsets of all vertices, or None if all are zero."""
    if values is None:
        return None
    if values.shape == (1, TEETH[0], 3) and count == TEETH[1]:
        values = np.concatenate([values, np.zeros((1, count - TEETH[0], 3), np.float32)], axis=1)
    if values.shape != (1, count, 3):
        told = f"{path}: 'static_offset' has the shape {list(values.shape)}, but the face model has {count:,} vertices"
        if values.shape == (1, TEETH[1], 3) and count == TEETH[0]:
            raise UserError(f"{told}: it lacks GaussianAvatars' teeth; add a FLAME model that has them "
                            "(docs/gaussian_avatars_folder.md)")  # fmt: skip
        raise UserError(f"{told}; import it with the face model that it was made with (--face-model)")
    return torch.from_numpy(values[0]) if values.any() else None


def _joints(face_model: FaceModel, arrays: dict[str, np.ndarray]) -> Float[Tensor, "t j 3"]:
    given = {}
    for key, names in _POSES.items():
        parts = torch.from_numpy(arrays[key]).split(3, dim=1)
        given |= dict(zip(names, parts, strict=True))
    still = torch.zeros(len(arrays["expr"]), 3)
    joints = [given.get(name, still) for name in face_model.free_joint_names]
    return torch.stack(joints, dim=1) if joints else torch.zeros(len(still), 0, 3)


def _flame_joints(face_model: FaceModel, face: FaceParams) -> tuple[Float[Tensor, "t 3"], Float[Tensor, "t 3"]]:
    """FLAME's root and neck at rest with identity, expression and offsets, relative to the head frame's origin."""
    rest, names = face_model.rest_joints(face), face_model.joint_names
    root, neck, to_neck = (names.index(name) for name in ("root", "neck", "to_neck"))
    shift = torch.einsum("te,ekc->tkc", face.expression, face_model.joint_translation_basis)
    return rest[root] + shift[:, root], rest[neck] + shift[:, to_neck]


def _head_posed(face_model: FaceModel, face: FaceParams) -> FaceParams:
    """Parameters of mien from fields that hold FLAME's root rotation, translation and neck."""
    model, exact = _in_double(face_model, face)
    assert model.flame_origin is not None
    root, neck = _flame_joints(model, exact)
    index = model.free_joint_names.index("neck")
    of_root, of_neck = matrix_from_axis_angle(exact.head_rotation), matrix_from_axis_angle(exact.joints[:, index])
    moved = _turned(of_root, neck - _turned(of_neck, neck) - root)
    joints = face.joints.clone()
    joints[:, index] *= -1
    return FaceParams(
        face.identity, face.expression, joints, axis_angle_from_matrix(of_root @ of_neck).float(),
        (moved + root + model.flame_origin + exact.head_translation).float(), face.vertex_offsets,
    )  # fmt: skip


def _flame_root(face_model: FaceModel, face: FaceParams) -> tuple[Float[Tensor, "t 3"], Float[Tensor, "t 3"]]:
    """FLAME's root rotation and translation: the inverse of `_head_posed`."""
    model, exact = _in_double(face_model, face)
    assert model.flame_origin is not None
    root, neck = _flame_joints(model, exact)
    of_neck = matrix_from_axis_angle(-exact.joints[:, model.free_joint_names.index("neck")])
    of_root = matrix_from_axis_angle(exact.head_rotation) @ of_neck.mT
    moved = _turned(of_root, neck - _turned(of_neck, neck) - root)
    translation = exact.head_translation - moved - root - model.flame_origin
    return axis_angle_from_matrix(of_root).float(), translation.float()


def _in_double(face_model: FaceModel, face: FaceParams) -> tuple[FaceModel, FaceParams]:
    double = torch.zeros((), dtype=torch.float64)
    return face_model.to(double), face.to(double)


def _turned(rotations: Float[Tensor, "t 3 3"], points: Float[Tensor, "t 3"]) -> Float[Tensor, "t 3"]:
    return (rotations @ points[..., None])[..., 0]
