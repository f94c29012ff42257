"""A torso that stands still in the world while the head moves, as joints and coefficients of the head frame."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32

from mien.runtime.baked import PortableAvatar, Rig
from mien.runtime.posing import Face
from mien.runtime.rotation import axis_angle_from_matrix, matrix_from_axis_angle

TORSO = "torso"
"""Name of the joint. A rig that has it also has the joint `neck`, and the coefficients `TORSO_SHIFTS`."""
TORSO_SHIFTS = ("torsoX", "torsoY", "torsoZ")
"""Names of the coefficients that shift the torso, in metres. They are for no one to set by hand: their bounds are 0."""
NECK_SHARE = 0.5
"""Share of the torso's motion that the neck has, so that its middle keeps its girth when the head turns."""
FREE, ROOM = 0.02, 0.03
"""How far a neck lets the head go from the torso's place, in metres: freely, and how much further it can ever get.
Beyond, the torso follows. Set by eye."""


@dataclass(frozen=True, eq=False)
class StillTorso:
    """Where a torso stands."""

    rotation: Float[np.ndarray, "3 3"]
    """Its rotation in world space."""
    place: Float[np.ndarray, " 3"]
    """The origin of its frame in world space, in metres."""
    origin: Float[np.ndarray, " 3"]
    """The same in the head frame, where the joint rests."""

    def against_head(
        self, rotation: Float[np.ndarray, "t 3"], translation: Float[np.ndarray, "t 3"], free: float = FREE
    ) -> tuple[Float[np.ndarray, "t 3"], Float[np.ndarray, "t 3"]]:
        """Return how it is turned (axis-angle) and shifted against heads with these poses, in the head frame.

        A head that goes further than `free` from where it belongs takes the torso with it.
        """
        to_head = np.swapaxes(matrix_from_axis_angle(np.asarray(rotation)), 1, 2)
        away = np.einsum("tij,tj->ti", to_head, self.place - translation) - self.origin
        length = np.linalg.norm(away, axis=1, keepdims=True)
        over = np.maximum(length - free, 0)
        kept = np.where(over > 0, (free + ROOM * over / (ROOM + over)) / np.maximum(length, 1e-9), 1)
        return axis_angle_from_matrix(to_head @ self.rotation), kept * away


def torso_at_rest(avatar: PortableAvatar) -> StillTorso | None:
    """Return where the torso of the person at rest stands. None if the avatar has none."""
    rig, rest = getattr(avatar.baked, "rig", None), avatar.neutral
    if not isinstance(rig, Rig) or TORSO not in rig.joint_names:
        return None
    origin = rig.joint_template[rig.joint_names.index(TORSO)].astype(np.float64)
    first = avatar.expression_names.index(TORSO_SHIFTS[0])
    to_world = matrix_from_axis_angle(rest.head_rotation)
    turned = to_world @ matrix_from_axis_angle(rest.joints[avatar.joint_names.index(TORSO)])
    place = rest.head_translation + to_world @ (origin + rest.expression[first : first + 3])
    return StillTorso(turned, place, origin)


def on_still_torso(avatar: PortableAvatar, face: Face) -> Face:
    """Return the same face on the torso of the person at rest. An avatar without a torso keeps its face."""
    torso = torso_at_rest(avatar)
    if torso is None:
        return face
    turn, shift = torso.against_head(face.head_rotation[None], face.head_translation[None])
    joints, expression = face.joints.copy(), face.expression.copy()
    for name, share in ((TORSO, 1.0), ("neck", NECK_SHARE)):
        joints[avatar.joint_names.index(name)] = share * turn[0]
    first = avatar.expression_names.index(TORSO_SHIFTS[0])
    expression[first : first + 3] = shift[0]
    return replace(face, joints=_float32(joints), expression=_float32(expression))


def _float32(values: np.ndarray) -> Float32[np.ndarray, "..."]:
    return np.ascontiguousarray(values, np.float32)
