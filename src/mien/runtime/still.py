"""Gaussians that change with the face and stand still: bound to triangles that never move, so that GPUs run them."""

from typing import TypeGuard

import numpy as np
from jaxtyping import Float32, Int32

from mien.runtime.baked import Attributes, BakedAvatar, ExpressionChanges, MeshBound, Rig

_UNIT_FRAME = np.array([[-1 / 3, 0, 1 / 3], [2 / 3, 0, 1 / 3], [-1 / 3, 0, -2 / 3]], np.float32)
"""A triangle whose frame is the head's: the first edge is +x, the normal +y, the centre the origin, the size 1."""


def standing_still(
    means: Float32[np.ndarray, "n 3"],
    attributes: Attributes,
    expression_names: tuple[str, ...],
    joint_names: tuple[str, ...],
    changes: ExpressionChanges,
    face_index: Int32[np.ndarray, " n"] | None = None,
) -> MeshBound:
    """Gaussians in the head frame that nothing moves: all of their triangles are the same one.

    `joint_names` are the free joints. `face_index` has the rows of `changes.shares`. None stands for one region.
    """
    e, names = len(expression_names), ("root", *joint_names)
    k, triangles = len(names), 1 if changes.shares is None else len(changes.shares)
    rig = Rig(
        template=_UNIT_FRAME,
        expression_names=expression_names,
        expression_basis=np.zeros((e, 3, 3), np.float32),
        joint_names=names,
        joint_parents=(-1, *(0 for _ in joint_names)),
        joint_free=(False, *(True for _ in joint_names)),
        joint_template=np.zeros((k, 3), np.float32),
        joint_rotation_basis=np.zeros((e, k, 3), np.float32),
        joint_translation_basis=np.zeros((e, k, 3), np.float32),
        skinning_weights=np.eye(1, k, dtype=np.float32).repeat(3, axis=0),
    )
    return MeshBound(
        rig=rig,
        faces=np.tile(np.arange(3, dtype=np.int32), (triangles, 1)),
        face_index=np.zeros(len(means), np.int32) if face_index is None else face_index,
        means=means,
        attributes=attributes,
        sh_frame="head",
        changes=changes,
    )


def follows_mesh(baked: BakedAvatar) -> TypeGuard[MeshBound]:
    """Whether Gaussians are bound to the mesh of a person, which that of `standing_still` is not."""
    return isinstance(baked, MeshBound) and not np.array_equal(baked.rig.template, _UNIT_FRAME)
