"""Check face models and face parameters that were read, so that posing neither fails nor reads out of bounds."""

from collections.abc import Iterator

import torch
from torch import Tensor

from mien.disk.limits import MAX_NUMBER, skeleton_fault
from mien.disk.reading import is_one_line
from mien.errors import UserError
from mien.face.model import FaceModel
from mien.face.params import FaceParams

AXES = {
    "template": "v3", "faces": "f3", "uv": "u2", "uv_faces": "f3", "face_regions": "f", "identity_basis": "iv3",
    "expression_basis": "ev3", "expression_bounds": "e2", "joint_template": "k3", "joint_identity_basis": "ik3",
    "joint_rotation_basis": "ek3", "joint_translation_basis": "ek3", "skinning_weights": "vk", "pose_basis": "pv3",
    "expression_sigmas": "e", "joint_regressor": "kv", "flame_origin": "3",
}  # fmt: skip
"""Axes of the tensors of `FaceModel`."""
_OPTIONAL = ("pose_basis", "expression_sigmas", "joint_regressor", "flame_origin")
_INDICES = {"faces": "v", "uv_faces": "u", "face_regions": "r"}
"""Axis into which the values of each of these tensors are indices."""


def check_face_model(model: FaceModel, where: str, remedy: str) -> None:
    """Check that a face model's arrays fit each other, its indices are in range and its numbers are moderate.

    Its landmarks are not checked. `where` and `remedy` are for messages.
    """
    for fault in _faults(model):
        raise UserError(f"{where}: {fault}; {remedy}")


def check_face_params(model: FaceModel, face: FaceParams, where: str, remedy: str) -> None:
    """Check that face parameters belong to a face model, and are finite and moderate.

    `where` and `remedy` are for messages.
    """
    b, v = len(face), len(model.template)
    shapes = {
        "identity": (len(model.identity_basis),), "expression": (b, len(model.expression_basis)),
        "joints": (b, len(model.free_joint_names), 3), "head_rotation": (b, 3), "head_translation": (b, 3),
        "vertex_offsets": (v, 3),
    }  # fmt: skip
    for name, tensor in face.tensors().items():
        if tuple(tensor.shape) != shapes[name]:
            fault = f"{name} is {list(tensor.shape)}, but the face model {model.name!r} has {list(shapes[name])}"
            raise UserError(f"{where}: {fault}; {remedy}")
        if tensor.dtype != torch.float32:
            raise UserError(f"{where}: {name} is {tensor.dtype}, not torch.float32; {remedy}")
        if not _is_moderate(tensor):
            raise UserError(f"{where}: {name} holds NaN or numbers beyond {MAX_NUMBER:g}; {remedy}")


def _faults(model: FaceModel) -> Iterator[str]:
    texts = (model.name, *model.region_names, *model.expression_names, *model.joint_names)
    if not all(isinstance(text, str) and is_one_line(text) for text in texts):
        yield "one of its names is not a text of one line"
    fault = skeleton_fault(model.joint_names, model.joint_parents, model.joint_free)
    if fault is not None:
        yield fault
    free = sum(bool(mark) for mark in model.joint_free)
    counted = {"e": len(model.expression_names), "k": len(model.joint_names), "p": 9 * free, "2": 2, "3": 3}
    sizes = dict(counted)
    for name, axes in AXES.items():
        tensor = getattr(model, name)
        if tensor is None and name in _OPTIONAL:
            continue
        if not isinstance(tensor, Tensor) or tensor.dtype != (torch.int64 if name in _INDICES else torch.float32):
            yield f"{name} has the wrong type"
            return
        shape = tuple(tensor.shape)
        if len(shape) != len(axes) or any(
            sizes.setdefault(axis, size) != size for axis, size in zip(axes, shape, strict=True)
        ):
            yield f"{name} has the shape {list(shape)}, which does not fit the others"
            return
        if name not in _INDICES and not _is_moderate(tensor):
            yield f"{name} holds NaN or numbers beyond {MAX_NUMBER:g}"
    sizes["r"] = len(model.region_names)
    if not sizes["v"] or not sizes["f"]:
        yield "it has no vertices or no triangles"
    for name, counts in _INDICES.items():
        tensor = getattr(model, name)
        if tensor.numel() and not (int(tensor.min()) >= 0 and int(tensor.max()) < sizes[counts]):
            yield f"{name} has an index that is out of range"


def _is_moderate(tensor: Tensor) -> bool:
    return tensor.numel() == 0 or bool(tensor.max() <= MAX_NUMBER and tensor.min() >= -MAX_NUMBER)
