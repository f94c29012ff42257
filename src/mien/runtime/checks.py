"""What must hold in a .mien file besides the shapes, so that posing never fails or reads outside of an array."""

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from mien.errors import UserError
from mien.runtime.model import AttributeNetwork, Attributes, BlendSkinned, MeshBound, PortableAvatar, Rig, Static

MOST_SHAPES = 256
"""Expressions, and nine of each free joint, that native/face.h takes."""


def check(avatar: PortableAvatar, where: str) -> None:
    """Finite numbers, indices within their arrays, as many names as rows.

    Raises:
        UserError: something does not hold; `where` is the file it came from.
    """
    for reason in _faults(avatar):
        raise UserError(f"{where}: {reason}; export it again with `mien export`")


def _faults(avatar: PortableAvatar) -> Iterator[str]:
    for name, array in _arrays(avatar, ""):
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            yield f"{name} holds NaN or infinity"
    baked, e = avatar.baked, len(avatar.expression_names)
    if avatar.expression_bounds.shape[0] != e or avatar.neutral.expression.shape[0] != e:
        yield f"{e} expression names, but bounds of {avatar.expression_bounds.shape[0]}"
    if len(avatar.joint_names) != len(avatar.neutral.joints):
        yield f"{len(avatar.joint_names)} joint names, but {len(avatar.neutral.joints)} joints at rest"
    if isinstance(baked, Static):
        names, free = baked.expression_names, baked.joint_names
    else:
        names, free = baked.rig.expression_names, _free_names(baked.rig)
        yield from _rig_faults(baked.rig)
    if (names, free) != (avatar.expression_names, avatar.joint_names):
        yield "its parts have different expressions or joints"
    if baked.attributes.sh.shape[1] not in (1, 4, 9, 16):
        yield f"{baked.attributes.sh.shape[1]} SH coefficients, not 1, 4, 9 or 16"
    if isinstance(baked, MeshBound):
        if _outside(baked.faces, len(baked.rig.template)) or _outside(baked.face_index, len(baked.faces)):
            yield "a triangle or Gaussian names what does not exist"
        return
    if isinstance(baked, BlendSkinned) and len(baked.rig.template) != len(baked.attributes.quats):
        yield f"{len(baked.rig.template)} points, but {len(baked.attributes.quats)} Gaussians"
    if baked.network is not None:
        yield from _network_faults(baked.network, baked.attributes, e, len(avatar.joint_names))
    if avatar.camera.width < 1 or avatar.camera.height < 1:
        yield "its camera has no pixels"


def _rig_faults(rig: Rig) -> Iterator[str]:
    k = len(rig.joint_names)
    if not len(rig.joint_parents) == len(rig.joint_free) == len(rig.joint_template) == k or k == 0:
        yield "joints of different numbers"
    elif any(not -1 <= parent < index for index, parent in enumerate(rig.joint_parents)):
        yield "a joint comes before its parent"
    if rig.pose_basis is not None and len(rig.pose_basis) != 9 * sum(rig.joint_free):
        yield f"{len(rig.pose_basis)} pose correctives for {sum(rig.joint_free)} free joints"
    if len(rig.expression_names) + 9 * sum(rig.joint_free) > MOST_SHAPES:
        yield f"{len(rig.expression_names)} expressions and {sum(rig.joint_free)} free joints, more than can be posed"


def _network_faults(network: AttributeNetwork, attributes: Attributes, e: int, j: int) -> Iterator[str]:
    widths = {"quats": 4, "log_scales": 3, "opacity_logits": 1, "sh": 3 * attributes.sh.shape[1]}
    if not set(network.outputs) <= set(widths):
        yield f"its network gives {network.outputs}"
        return
    if not network.weights or len(network.weights) != len(network.biases):
        yield "its network has no layers, or layers without biases"
        return
    width = network.base.shape[1] + (3 if network.input == "displacement" else 0)
    for weight, bias in zip(network.weights, network.biases, strict=True):
        if weight.shape[1] != width or len(bias) != len(weight):
            yield "its network's layers do not fit"
        width = len(weight)
    if width != sum(widths[name] for name in network.outputs):
        yield "its network's outputs do not fit"
    if network.input == "features":
        features = network.basis.shape[2]
        joints = network.joint_basis
        if network.basis.shape[0] != e or features > network.base.shape[1]:
            yield "its network's basis does not fit"
        if joints is not None and (joints.shape[0] != 3 * j or joints.shape[2] != features):
            yield "its network's joint basis does not fit"


def _free_names(rig: Rig) -> tuple[str, ...]:
    return tuple(name for name, free in zip(rig.joint_names, rig.joint_free, strict=False) if free)


def _outside(indices: np.ndarray, count: int) -> bool:
    return indices.size > 0 and not (int(indices.min()) >= 0 and int(indices.max()) < count)


def _arrays(value: Any, path: str) -> Iterator[tuple[str, np.ndarray]]:
    if isinstance(value, np.ndarray):
        yield path, value
    elif is_dataclass(value):
        for f in fields(value):
            yield from _arrays(getattr(value, f.name), f"{path}.{f.name}".lstrip("."))
    elif isinstance(value, tuple):
        for index, item in enumerate(value):
            yield from _arrays(item, f"{path}.{index}")
