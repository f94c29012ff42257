"""Checks of a .mien file, so that posing never fails or reads outside an array."""

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from functools import cache
from typing import Any, get_args, get_type_hints

import numpy as np

from mien.disk.limits import MAX_NUMBER, are_indices, camera_fault, is_moderate, rigid_fault, skeleton_fault
from mien.disk.reading import is_one_line
from mien.errors import UserError
from mien.runtime.baked import (
    AttributeNetwork,
    Attributes,
    BakedAvatar,
    BlendSkinned,
    ExpressionChanges,
    FeatureChanges,
    Filmed,
    MeshBound,
    PortableAvatar,
    Rig,
    Static,
)

MAX_SHAPES = 256
"""Largest number of expressions, plus nine for each free joint, that native/face.h accepts."""
_MAX_NAME = 1000
"""Most characters of a name or of another text."""
MAX_LOG_SCALE = 30
"""Largest logarithm of a scale. Its exponential, and the square of that, still fit into float32."""


def check(avatar: PortableAvatar, where: str) -> None:
    """Check that numbers are moderate, indices are within their arrays, and there are as many names as rows."""
    for reason in _faults(avatar):
        raise UserError(f"{where}: {reason}; export it again with `mien export`")


def baked_fault(baked: BakedAvatar) -> str | None:
    """The reason why a baked avatar cannot be posed, or None if it can."""
    return next(_baked_faults(baked, _sizes(baked)), None)


def filmed_fault(filmed: Filmed, inputs: int) -> str | None:
    """The reason why this cannot be what training saw of a face with so many inputs, or None if it can."""
    for fault in _array_faults(filmed, {"i": inputs}, "filmed"):
        return fault
    if (filmed.lowest > filmed.highest).any() or (filmed.head_angles[:, 0] > filmed.head_angles[:, 1]).any():
        return "the lowest of what was filmed is above the highest"
    return None


def _faults(avatar: PortableAvatar) -> Iterator[str]:
    baked = avatar.baked
    names, free = _names(baked)
    if len(names) + 9 * len(free) > MAX_SHAPES:
        yield f"it has {len(names)} expressions and {len(free)} free joints, more than can be posed"
    sizes = _sizes(baked)
    yield from _baked_faults(baked, sizes)
    yield from _array_faults(avatar, sizes)
    if (names, free) != (avatar.expression_names, avatar.joint_names):
        yield "its parts name different expressions or joints"
    fault = None if avatar.filmed is None else filmed_fault(avatar.filmed, sizes["i"])
    if fault is not None:
        yield fault
    if avatar.confidence is not None and not ((avatar.confidence >= 0) & (avatar.confidence <= 1)).all():
        yield "a confidence is not a number from 0 to 1"
    camera = avatar.camera
    fault = camera_fault(camera.K, camera.viewmat, camera.width, camera.height)
    if fault is not None:
        yield f"its camera is not valid ({fault})"
    texts = [getattr(avatar.about, f.name) for f in fields(avatar.about)]
    if not all(map(is_one_line, (*texts, *avatar.expression_names, *avatar.joint_names))):
        yield "a name in it has several lines"
    if any(len(text) > _MAX_NAME for text in (*texts, *avatar.expression_names, *avatar.joint_names)):
        yield f"a name in it has more than {_MAX_NAME:,} characters"


def _names(baked: BakedAvatar) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The names of the expressions and of the free joints."""
    if isinstance(baked, Static):
        return baked.expression_names, baked.joint_names
    return baked.rig.expression_names, _free_names(baked.rig)


def _sizes(baked: BakedAvatar) -> dict[str, int]:
    """The sizes that letters of shapes have in an avatar (`mien.runtime.baked`), as far as its names say them."""
    names, free = _names(baked)
    e, j, n = len(names), len(free), len(baked.attributes.quats)
    sizes = {"e": e, "j": j, "p": 9 * j, "i": e + 3 * j, "n": n}
    if not isinstance(baked, Static):
        sizes["k"] = len(baked.rig.joint_names)
    if isinstance(baked, BlendSkinned):
        sizes["m"] = n
    if isinstance(baked, MeshBound) and baked.changes is not None:
        changes, q = baked.changes, 0 if baked.changes.head is None else baked.changes.head.directions.shape[-1]
        g = 1 if changes.shares is None else changes.shares.shape[-1]
        a = changes.directions.shape[-1] // max(g, 1) + q
        sizes |= {"r": changes.directions.shape[-1], "q": q, "g": g, "f": len(baked.faces)}
        sizes |= {"a": a, "c": a if changes.basis_columns is None else changes.basis_columns}
    return sizes


def _array_faults(value: Any, sizes: dict[str, int], path: str = "") -> Iterator[str]:
    """Arrays with NaN or huge numbers, or of another shape than annotated. `sizes` remembers those of letters."""
    for f in fields(value):
        part, place = getattr(value, f.name), f"{path}.{f.name}".lstrip(".")
        if is_dataclass(part):
            yield from _array_faults(part, sizes, place)
        for array in part if isinstance(part, tuple) else (part,):
            if isinstance(array, np.ndarray) and array.dtype.kind == "f" and not is_moderate(array):
                yield f"{place} holds NaN, infinity or a number beyond {MAX_NUMBER:g}"
        if isinstance(part, np.ndarray):
            axes = _axes(type(value))[f.name]
            if len(axes) != part.ndim or any(
                axis != "_" and size != (int(axis) if axis.isdigit() else sizes.setdefault(axis, size))
                for axis, size in zip(axes, part.shape, strict=True)
            ):
                yield f"{place} has the shape {list(part.shape)}, which does not fit the others"


@cache
def _axes(kind: type) -> dict[str, list[str]]:
    """The letters of the shapes of a class's arrays, by field."""
    found = {name: (hint, *get_args(hint)) for name, hint in get_type_hints(kind).items()}
    return {name: one.dim_str.split() for name, each in found.items() for one in each if hasattr(one, "dim_str")}


def _baked_faults(baked: BakedAvatar, sizes: dict[str, int]) -> Iterator[str]:
    rig = None if isinstance(baked, Static) else baked.rig
    fault = None if rig is None else skeleton_fault(rig.joint_names, rig.joint_parents, rig.joint_free)
    if fault is not None:
        yield fault
        return
    if isinstance(baked, MeshBound) and baked.changes is not None:
        yield from _changes_faults(baked.changes, sizes)
    yield from _array_faults(baked, sizes, "baked")
    attributes = baked.attributes
    if not np.abs(attributes.log_scales).max(initial=0) <= MAX_LOG_SCALE:
        yield f"a scale is beyond exp({MAX_LOG_SCALE})"
    if attributes.sh.shape[1] not in (1, 4, 9, 16):
        yield f"it has {attributes.sh.shape[1]} SH coefficients per channel, not 1, 4, 9 or 16"
    if isinstance(baked, MeshBound):
        if not (are_indices(baked.faces, len(baked.rig.template)) and are_indices(baked.face_index, len(baked.faces))):
            yield "a triangle refers to a vertex, or a Gaussian to a triangle, that does not exist"
        return
    if isinstance(baked, BlendSkinned):
        if max(abs(baked.scale_gain), abs(baked.scale_offset)) > MAX_NUMBER:
            yield f"its scales reach {baked.scale_gain:g} metres"
        if baked.color_activation == "sigmoid" and attributes.sh.shape[1] != 1:
            yield "its colours are sigmoids, but have several SH coefficients"
        if (baked.still_weights is None) != (baked.still_pose is None):
            yield "the bone that stands still has weights or a pose, but not both"
        fault = None if baked.still_pose is None else rigid_fault(baked.still_pose)
        if fault is not None:
            yield f"the pose of the bone that stands still cannot be one: {fault}"
        if baked.bases is not None and baked.bases.means is not None:
            yield "it has a basis of its means, but its rig already moves them"
    if baked.network is not None:
        yield from _network_faults(baked.network, attributes)


def _changes_faults(changes: ExpressionChanges, sizes: dict[str, int]) -> Iterator[str]:
    r, g, a, c = (sizes[name] for name in "rgac")
    if r < 1 or g < 1 or r % g != 0:
        yield f"its changes with the expression have {r} activations of {g} regions"
    elif not 1 <= c <= a:
        yield f"its changes with the expression take {c} of {a} activations"
    elif changes.features is not None:
        yield from _features_faults(changes.features)


def _features_faults(features: FeatureChanges) -> Iterator[str]:
    width, x = features.neutral.shape[1], features.own.shape[1]
    if width == 0:
        yield "the changes with the expression have no features"
    if len(features.weights) != 2 or len(features.biases) != 2:
        yield "the network of its features has not two layers"
        return
    hidden = len(features.biases[0])
    found = [array.shape for array in (*features.weights, *features.biases)]
    if found != [(hidden, width + x), (4, hidden), (hidden,), (4,)] or hidden == 0:
        yield "the shapes of the layers of its features do not fit"


def _network_faults(network: AttributeNetwork, attributes: Attributes) -> Iterator[str]:
    widths = {"quats": 4, "log_scales": 3, "opacity_logits": 1, "sh": 3 * attributes.sh.shape[1]}
    if not set(network.outputs) <= set(widths):
        yield f"its network has the unknown outputs {network.outputs}"
        return
    if len(set(network.outputs)) != len(network.outputs):
        yield "its network has the same output twice"
    if not network.weights or len(network.weights) != len(network.biases):
        yield "its network has no layers, or layers without biases"
        return
    width = network.base.shape[1] + (3 if network.input == "displacement" else 0)
    for weight, bias in zip(network.weights, network.biases, strict=True):
        if weight.shape[1] != width or len(bias) != len(weight):
            yield "the shapes of its network's layers do not fit"
        width = len(weight)
    if width != sum(widths[name] for name in network.outputs):
        yield "the width of its network's outputs does not fit"
    if (network.input == "features") != (network.along is not None):
        yield f"its network has the input {network.input}, which does not fit its directions of features"
    if network.along is not None and network.along.basis.shape[-1] > network.base.shape[-1]:
        yield f"its network has {network.along.basis.shape[-1]} features, but {network.base.shape[-1]} columns"


def _free_names(rig: Rig) -> tuple[str, ...]:
    return tuple(name for name, free in zip(rig.joint_names, rig.joint_free, strict=False) if free)
