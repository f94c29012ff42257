"""Soft limits that keep a driven avatar near what training saw: of each expression, joint, and side of the head.

Inside the filmed range nothing changes. Beyond it, values approach a limit that they never reach, with a continuous
slope, so that motion stays smooth. Common expressions have no limit but the face model's. All of it needs only numpy.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Float32

from mien.runtime.baked import Filmed
from mien.runtime.rotation import axis_angle_from_matrix, matrix_from_axis_angle

COMMON = frozenset({
    "jawOpen", "mouthSmileLeft", "mouthSmileRight", "mouthFunnel", "mouthPucker", "browInnerUp", "browOuterUpLeft",
    "browOuterUpRight", "eyeBlinkLeft", "eyeBlinkRight",
})  # fmt: skip
"""ARKit's names of what everybody does: a smile, an open mouth, vowels, raised brows, shut eyes. They reach their full
motion on every avatar: the mesh bends, and the appearance stays near its last filmed state (`ExpressionChanges`)."""
SHUT = 0.5
"""Coefficient of a blink from which a clip shows the lids shut. A mesh that closes them further tears them."""
ROOM = 0.3
"""How far other values get beyond what was filmed, as a share of the filmed distance from the person at rest."""
LEAST_EXPRESSION = 0.2
"""Least of this room for an expression, as a share of the largest coefficient of the face model, because a mesh shows
a little of any expression well."""
LEAST_JOINT = 0.1
"""Least of this room for a joint, in radians."""
LEAST_HEAD = np.radians(8.0)
"""Least of this room for the head's yaw and pitch, in radians."""

Array = Float[np.ndarray, "..."]


def soft_limits(values: Array, lowest: Array, highest: Array, rest: Array, least: Array | float) -> Array:
    """`values` as they are between `lowest` and `highest`. The excess o beyond becomes m o / (m + o), below m.

    m is `ROOM` times the distance of that limit from `rest`, and at least `least`, which is above 0. Arrays broadcast.
    """
    out = np.asarray(values, np.float64)
    for limit, sign in ((highest, 1.0), (lowest, -1.0)):
        over = np.maximum(sign * (out - limit), 0.0)
        room = np.maximum(ROOM * np.maximum(sign * (limit - rest), 0.0), least)
        out = np.where(over > 0, limit + sign * room * over / (room + over), out)
    return out


def with_filmed_blinks(
    bounds: Float[np.ndarray, "e 2"], names: Sequence[str], filmed: Filmed | None
) -> Float[np.ndarray, "e 2"]:
    """The bounds of coefficients. Those of blinks end where the person's own lids are shut, if the clip shows that."""
    found = bounds.copy()
    for index, name in enumerate(names):
        if filmed is not None and name.startswith("eyeBlink") and filmed.highest[index] >= SHUT:
            found[index, 1] = min(found[index, 1], filmed.highest[index])
    return found


def within_filmed_inputs(
    filmed: Filmed,
    inputs: Float[np.ndarray, "t i"],
    rest: Float[np.ndarray, " i"],
    bounds: Float[np.ndarray, "e 2"],
    names: Sequence[str],
) -> Float32[np.ndarray, "t i"]:
    """Expression coefficients, followed by the free joints' axis-angle vectors in radians, softly within what was seen.

    Each number has limits of its own (`soft_limits`). `bounds` are those of the coefficients that the face model can
    show, and `names` theirs: `COMMON` ones go up to them.
    """
    least = np.full(inputs.shape[1], LEAST_JOINT)
    least[: len(bounds)] = np.maximum(LEAST_EXPRESSION * np.abs(bounds).max(1), 1e-6)
    lowest, highest = filmed.lowest.astype(np.float64), filmed.highest.astype(np.float64)
    common = np.flatnonzero([name in COMMON for name in names])
    lowest[common] = np.minimum(lowest[common], bounds[common, 0])
    highest[common] = np.maximum(highest[common], with_filmed_blinks(bounds, names, filmed)[common, 1])
    limited = soft_limits(inputs, lowest, highest, rest.astype(np.float64), least).astype(np.float32)
    # What is inside keeps its bits.
    return np.where(np.abs(limited - inputs) > 1e-6, limited, inputs)


def head_angles(
    rotation: Float[np.ndarray, "t 3"], translation: Float[np.ndarray, "t 3"], eye: Float[np.ndarray, "... 3"]
) -> Float[np.ndarray, "t 2"]:
    """Yaw and pitch of the camera as the head sees it, in radians: to the subject's left, and upwards.

    Rotation (axis-angle, in radians) and translation (in metres) are those of the head frame in world space. `eye` is
    the camera's position there, for all timesteps or for each.
    """
    return _angles(_towards(rotation, translation, eye))


def within_filmed_poses(
    filmed: Filmed,
    rotation: Float[np.ndarray, "t 3"],
    translation: Float[np.ndarray, "t 3"],
    eye: Float[np.ndarray, " 3"],
) -> Float32[np.ndarray, "t 3"]:
    """Rotations of the head with which the camera sees it softly from the sides that training saw.

    Each head turns by the smallest angle that does so, and so keeps its roll. Positions stay. The arguments are those
    of `head_angles`.
    """
    towards = _towards(rotation, translation, eye)
    angles = _angles(towards)
    lowest, highest = filmed.head_angles[:, 0].astype(np.float64), filmed.head_angles[:, 1].astype(np.float64)
    limited = soft_limits(angles, lowest, highest, 0.5 * (lowest + highest), LEAST_HEAD)
    yaw, pitch = limited.T
    wanted = np.stack([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)], axis=1)
    turn = matrix_from_axis_angle(_between(wanted, towards))
    turned = axis_angle_from_matrix(matrix_from_axis_angle(rotation) @ turn).astype(np.float32)
    outside = np.abs(limited - angles).max(1, keepdims=True) > 1e-6
    return np.where(outside, turned, rotation).astype(np.float32)


def _towards(rotation: np.ndarray, translation: np.ndarray, eye: np.ndarray) -> Float[np.ndarray, "t 3"]:
    """Unit vectors from the head's origin to the camera, in the head frame."""
    ahead = np.asarray(eye, np.float64) - translation
    inside = np.einsum("tij,ti->tj", matrix_from_axis_angle(rotation), ahead)
    return inside / np.maximum(np.linalg.norm(inside, axis=1, keepdims=True), 1e-9)


def _angles(towards: Float[np.ndarray, "t 3"]) -> Float[np.ndarray, "t 2"]:
    pitch = np.arcsin(np.clip(towards[:, 1], -1, 1))
    return np.stack([np.arctan2(towards[:, 0], towards[:, 2]), pitch], axis=1)


def _between(first: Float[np.ndarray, "t 3"], second: Float[np.ndarray, "t 3"]) -> Float[np.ndarray, "t 3"]:
    """Axis-angle vectors of the smallest rotations that take unit vectors to others."""
    axis = np.cross(first, second)
    sine = np.linalg.norm(axis, axis=1, keepdims=True)
    angle = np.arctan2(sine, (first * second).sum(1, keepdims=True))
    return axis * np.where(sine > 1e-9, angle / np.maximum(sine, 1e-9), 0.0)
