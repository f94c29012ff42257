"""Checks of a .mien file besides the shapes, so that posing never fails or reads outside an array."""

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from mien.disk.inside import is_one_line
from mien.disk.limits import MAX_NUMBER, are_indices, camera_fault, is_moderate, rigid_fault, skeleton_fault
from mien.errors import UserError
from mien.runtime.baked import (
    AttributeNetwork,
    Attributes,
    BakedAvatar,
    BlendSkinned,
    ExpressionChanges,
    FeatureChanges,
    FeatureDirections,
    Filmed,
    LinearBases,
    MeshBound,
    PortableAvatar,
    Rig,
    Static,
)

MAX_SHAPES = 256
"""Largest number of expressions, plus nine for each free joint, that native/face.h accepts."""
MAX_ACTIVATIONS = 8
"""Largest number of activations that native/expression_change.h accepts, for parts other than features."""
_MAX_NAME = 1000
"""Most characters of a name or of another text."""
_MAX_LOG_SCALE = 30
"""Largest logarithm of a scale. Its exponential, and the square of that, still fit into float32."""


def check(avatar: PortableAvatar, where: str) -> None:
    """Check that numbers are moderate, indices are within their arrays, and there are as many names as rows."""
    for reason in _faults(avatar):
        raise UserError(f"{where}: {reason}; export it again with `mien export`")


def baked_fault(baked: BakedAvatar) -> str | None:
    """The reason why a baked avatar cannot be posed, or None if it can."""
    return next(_baked_faults(baked), None)


def filmed_fault(filmed: Filmed, inputs: int) -> str | None:
    """The reason why this cannot be what training saw of a face with so many inputs, or None if it can."""
    shapes = {"lowest": (inputs,), "highest": (inputs,), "directions": (inputs, inputs), "reach": (1,)}
    for name, shape in (shapes | {"head_angles": (2, 2)}).items():
        if getattr(filmed, name).shape != shape:
            return f"the shape of {name} of what was filmed does not fit"
    if not all(is_moderate(getattr(filmed, f.name)) for f in fields(filmed)):
        return f"what was filmed holds NaN, infinity or a number beyond {MAX_NUMBER:g}"
    if (filmed.lowest > filmed.highest).any() or (filmed.head_angles[:, 0] > filmed.head_angles[:, 1]).any():
        return "the lowest of what was filmed is above the highest"
    return "the reach of what was filmed is negative" if filmed.reach[0] < 0 else None


def _faults(avatar: PortableAvatar) -> Iterator[str]:
    baked, e = avatar.baked, len(avatar.expression_names)
    yield from _number_faults(avatar)
    names, free = _names(baked)
    if len(names) + 9 * len(free) > MAX_SHAPES:
        yield f"it has {len(names)} expressions and {len(free)} free joints, more than can be posed"
    yield from _baked_faults(baked)
    if avatar.expression_bounds.shape[0] != e or avatar.neutral.expression.shape[0] != e:
        yield f"it has {e} expression names, but bounds of {avatar.expression_bounds.shape[0]} expressions"
    if len(avatar.joint_names) != len(avatar.neutral.joints):
        yield f"it has {len(avatar.joint_names)} joint names, but {len(avatar.neutral.joints)} joints at rest"
    if (names, free) != (avatar.expression_names, avatar.joint_names):
        yield "its parts name different expressions or joints"
    if avatar.filmed is not None:
        fault = filmed_fault(avatar.filmed, e + 3 * len(avatar.joint_names))
        if fault is not None:
            yield fault
    if avatar.confidence is not None:
        yield from _confidence_faults(avatar.confidence, baked)
    camera = avatar.camera
    fault = camera_fault(camera.K, camera.viewmat, camera.width, camera.height)
    if fault is not None:
        yield f"its camera is not valid ({fault})"
    texts = [getattr(avatar.about, f.name) for f in fields(avatar.about)]
    if not all(map(is_one_line, (*texts, *avatar.expression_names, *avatar.joint_names))):
        yield "a name in it has several lines"
    if any(len(text) > _MAX_NAME for text in (*texts, *avatar.expression_names, *avatar.joint_names)):
        yield f"a name in it has more than {_MAX_NAME:,} characters"


def _confidence_faults(confidence: np.ndarray, baked: BakedAvatar) -> Iterator[str]:
    if isinstance(baked, MeshBound) and len(confidence) != len(baked.faces):
        yield f"it has the confidence of {len(confidence)} triangles, but {len(baked.faces)} triangles"
    if not ((confidence >= 0) & (confidence <= 1)).all():
        yield "a confidence is not a number from 0 to 1"


def _names(baked: BakedAvatar) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The names of the expressions and of the free joints."""
    if isinstance(baked, Static):
        return baked.expression_names, baked.joint_names
    return baked.rig.expression_names, _free_names(baked.rig)


def _baked_faults(baked: BakedAvatar) -> Iterator[str]:
    yield from _number_faults(baked)
    names, free = _names(baked)
    attributes, n = baked.attributes, len(baked.attributes.quats)
    parts = [getattr(attributes, f.name) for f in fields(attributes)]
    if any(len(part) != n for part in parts):
        yield "its attributes have different numbers of Gaussians"
    if not np.abs(attributes.log_scales).max(initial=0) <= _MAX_LOG_SCALE:
        yield f"a scale is beyond exp({_MAX_LOG_SCALE})"
    if attributes.sh.shape[1] not in (1, 4, 9, 16):
        yield f"it has {attributes.sh.shape[1]} SH coefficients per channel, not 1, 4, 9 or 16"
    if not isinstance(baked, Static):
        yield from _rig_faults(baked.rig)
    if isinstance(baked, MeshBound):
        if not (are_indices(baked.faces, len(baked.rig.template)) and are_indices(baked.face_index, len(baked.faces))):
            yield "a triangle refers to a vertex, or a Gaussian to a triangle, that does not exist"
        if not len(baked.face_index) == len(baked.means) == n:
            yield "its centres and its attributes have different numbers of Gaussians"
        if baked.changes is not None:
            yield from _changes_faults(baked.changes, n, len(names) + 3 * len(free))
        return
    if isinstance(baked, BlendSkinned) and len(baked.rig.template) != n:
        yield f"it has {len(baked.rig.template)} points, but {n} Gaussians"
    if isinstance(baked, BlendSkinned):
        if max(abs(baked.scale_gain), abs(baked.scale_offset)) > MAX_NUMBER:
            yield f"its scales reach {baked.scale_gain:g} metres"
        if baked.color_activation == "sigmoid" and attributes.sh.shape[1] != 1:
            yield "its colours are sigmoids, but have several SH coefficients"
        yield from _still_faults(baked, n)
    if isinstance(baked, Static) and len(baked.means) != n:
        yield f"it has {len(baked.means)} points, but {n} Gaussians"
    if baked.bases is not None:
        yield from _bases_faults(baked.bases, attributes, len(names), mean_moves=isinstance(baked, Static))
    if baked.network is not None:
        yield from _network_faults(baked.network, attributes, len(names), len(free))


def _still_faults(baked: BlendSkinned, n: int) -> Iterator[str]:
    if (baked.still_weights is None) != (baked.still_pose is None):
        yield "the bone that stands still has weights or a pose, but not both"
    if baked.still_weights is not None and len(baked.still_weights) != n:
        yield f"it has {len(baked.still_weights)} weights of the bone that stands still, but {n} Gaussians"
    fault = None if baked.still_pose is None else rigid_fault(baked.still_pose)
    if fault is not None:
        yield f"the pose of the bone that stands still cannot be one: {fault}"


def _number_faults(value: Any) -> Iterator[str]:
    for name, array in _arrays(value, ""):
        if array.dtype.kind == "f" and not is_moderate(array):
            yield f"{name} holds NaN, infinity or a number beyond {MAX_NUMBER:g}"


def _bases_faults(bases: LinearBases, attributes: Attributes, e: int, mean_moves: bool) -> Iterator[str]:
    shapes = {f.name: getattr(attributes, f.name).shape for f in fields(attributes)}
    shapes["means"] = (len(attributes.quats), 3)
    for f in fields(bases):
        basis = getattr(bases, f.name)
        if basis is not None and basis.shape != (e, *shapes[f.name]):
            yield f"the shape of its basis of {f.name} does not fit"
    if bases.means is not None and not mean_moves:
        yield "it has a basis of its means, but its rig already moves them"


def _changes_faults(changes: ExpressionChanges, n: int, inputs: int) -> Iterator[str]:
    r = changes.directions.shape[1]
    # Features are blended by another operation, which takes any number of activations.
    c = r if changes.basis_columns is None else changes.basis_columns
    limited = any(part is not None for part in (changes.color, changes.opacity_logits, changes.means))
    if r < 1 or not 1 <= c <= r or (limited and c > MAX_ACTIVATIONS):
        yield f"its changes with the expression have {c} of {r} activations, not 1 to {MAX_ACTIVATIONS}"
        return
    shapes = {"rest": (inputs,), "directions": (inputs, r), "seen": (len(changes.seen), r)}
    shapes |= {"color": (n, 3, c), "opacity_logits": (n, c), "means": (n, 3, c)}
    for name, shape in shapes.items():
        part = getattr(changes, name)
        if part is not None and part.shape != shape:
            yield f"the shape of {name} of its changes with the expression does not fit"
            return
    if changes.features is not None:
        yield from _features_faults(changes.features, n, r)


def _features_faults(features: FeatureChanges, n: int, r: int) -> Iterator[str]:
    width, x = features.neutral.shape[1], features.own.shape[1]
    shapes = [array.shape for array in (features.neutral, features.basis, features.own)]
    if shapes != [(n, width), (n, r, width), (n, x)] or width == 0:
        yield "the shapes of the features of its changes with the expression do not fit"
    if len(features.weights) != 2 or len(features.biases) != 2:
        yield "the network of its features has not two layers"
        return
    hidden = len(features.biases[0])
    found = [array.shape for array in (*features.weights, *features.biases)]
    if found != [(hidden, width + x), (4, hidden), (hidden,), (4,)] or hidden == 0:
        yield "the shapes of the layers of its features do not fit"


def _rig_faults(rig: Rig) -> Iterator[str]:
    fault = skeleton_fault(rig.joint_names, rig.joint_parents, rig.joint_free)
    if fault is not None:
        yield fault
        return
    e, m, k = len(rig.expression_names), len(rig.template), len(rig.joint_names)
    shapes = {
        "template": (m, 3), "expression_basis": (e, m, 3), "joint_template": (k, 3),
        "joint_rotation_basis": (e, k, 3), "joint_translation_basis": (e, k, 3), "skinning_weights": (m, k),
    }  # fmt: skip
    for name, shape in shapes.items():
        if getattr(rig, name).shape != shape:
            yield f"the shape of its rig's {name} does not fit"
    if rig.pose_basis is not None and rig.pose_basis.shape[1:] != (m, 3):
        yield "the shape of its rig's pose_basis does not fit"
    if rig.pose_basis is not None and len(rig.pose_basis) != 9 * sum(rig.joint_free):
        yield f"it has {len(rig.pose_basis)} pose correctives for {sum(rig.joint_free)} free joints"


def _network_faults(network: AttributeNetwork, attributes: Attributes, e: int, j: int) -> Iterator[str]:
    widths = {"quats": 4, "log_scales": 3, "opacity_logits": 1, "sh": 3 * attributes.sh.shape[1]}
    if not set(network.outputs) <= set(widths):
        yield f"its network has the unknown outputs {network.outputs}"
        return
    if len(network.base) != len(attributes.quats):
        yield "its network has another number of Gaussians"
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
    if network.along is not None:
        yield from _along_faults(network, network.along, e + 3 * j)


def _along_faults(network: AttributeNetwork, along: FeatureDirections, inputs: int) -> Iterator[str]:
    (n, columns), k, features = network.base.shape, along.directions.shape[1], along.basis.shape[2]
    if features > columns:
        yield f"its network has {features} features, but {columns} columns"
    shapes = {"rest": (inputs,), "directions": (inputs, k), "basis": (n, k, features)}
    for name, shape in shapes.items():
        if getattr(along, name).shape != shape:
            yield f"the shape of {name} of its directions of features does not fit"


def _free_names(rig: Rig) -> tuple[str, ...]:
    return tuple(name for name, free in zip(rig.joint_names, rig.joint_free, strict=False) if free)


def _arrays(value: Any, path: str) -> Iterator[tuple[str, np.ndarray]]:
    if isinstance(value, np.ndarray):
        yield path, value
    elif is_dataclass(value):
        for f in fields(value):
            yield from _arrays(getattr(value, f.name), f"{path}.{f.name}".lstrip("."))
    elif isinstance(value, tuple):
        for index, item in enumerate(value):
            yield from _arrays(item, f"{path}.{index}")
