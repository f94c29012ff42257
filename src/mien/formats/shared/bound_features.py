"""Static Gaussians with a network of features, in the form of bound ones: features on one triangle that never moves.

GPUs run such networks of bound Gaussians. Pages run those of others on the processor.
"""

import numpy as np

from mien.runtime.baked import ExpressionChanges, FeatureChanges, MeshBound, PortableAvatar, Rig, Static

_UNIT_FRAME = np.array([[-1 / 3, 0, 1 / 3], [2 / 3, 0, 1 / 3], [-1 / 3, 0, -2 / 3]], np.float32)
"""A triangle whose frame is the head's: the first edge is +x, the normal +y, the centre the origin, the size 1."""


def bound_features(avatar: PortableAvatar, baked: Static) -> MeshBound | None:
    """The Gaussians of an avatar, whose record is `baked`, as features on one triangle. They look the same.

    None if their changes are not those of `FeatureChanges`: another network, linear bases, or colours that depend on
    the view.
    """
    network = baked.network
    if (
        network is None
        or network.along is None
        or baked.bases is not None
        or len(network.weights) != 2
        or network.activation != "leaky_relu"
        or network.outputs != ("sh", "opacity_logits")
        or baked.attributes.sh.shape[1] != 1
    ):
        return None
    along = network.along
    width = along.basis.shape[2]
    changes = ExpressionChanges(
        rest=along.rest,
        directions=along.directions,
        seen=np.empty((0, along.directions.shape[1]), np.float32),
        features=FeatureChanges(
            neutral=np.ascontiguousarray(network.base[:, :width]),
            basis=along.basis,
            own=np.ascontiguousarray(network.base[:, width:]),
            weights=network.weights,
            biases=network.biases,
        ),
    )
    return MeshBound(
        rig=_still_rig(avatar),
        faces=np.array([[0, 1, 2]], np.int32),
        face_index=np.zeros(len(baked.means), np.int32),
        means=baked.means,
        attributes=baked.attributes,
        sh_frame="head",
        changes=changes,
    )


def _still_rig(avatar: PortableAvatar) -> Rig:
    """One triangle on a root joint. The face's joints are there, and move nothing."""
    e, names = len(avatar.expression_names), ("root", *avatar.joint_names)
    k = len(names)
    weights = np.zeros((3, k), np.float32)
    weights[:, 0] = 1
    return Rig(
        template=_UNIT_FRAME,
        expression_names=avatar.expression_names,
        expression_basis=np.zeros((e, 3, 3), np.float32),
        joint_names=names,
        joint_parents=(-1, *(0 for _ in avatar.joint_names)),
        joint_free=(False, *(True for _ in avatar.joint_names)),
        joint_template=np.zeros((k, 3), np.float32),
        joint_rotation_basis=np.zeros((e, k, 3), np.float32),
        joint_translation_basis=np.zeros((e, k, 3), np.float32),
        skinning_weights=weights,
    )
