"""Gaussians of headgas in the form of bound ones, which web pages draw: features on one triangle that never moves."""

import numpy as np

from mien.errors import UserError
from mien.runtime import MeshBound, PortableAvatar, Rig, Static
from mien.runtime.baked import ExpressionChanges, FeatureChanges

_UNIT_FRAME = np.array([[-1 / 3, 0, 1 / 3], [2 / 3, 0, 1 / 3], [-1 / 3, 0, -2 / 3]], np.float32)
"""A triangle whose frame is the head's: the first edge is +x, the normal +y, the centre the origin, the size 1."""
_REACH = np.float32(1e6)
"""Length of activations that no face has, so that none is shortened."""


def bound_features(avatar: PortableAvatar) -> MeshBound:
    """The Gaussians of an avatar of headgas as features on one triangle. They look the same.

    Raises:
        UserError: the network is not that of headgas, or colours depend on the view.
    """
    baked = avatar.baked
    assert isinstance(baked, Static)
    network, name = baked.network, avatar.about.name
    if (
        network is None
        or network.along is None
        or len(network.weights) != 2
        or network.outputs != ("sh", "opacity_logits")
    ):
        raise UserError(
            f"{name}: a page draws avatars of headgas with --method.variant full; train one, or export a .mien"
        )
    if baked.attributes.sh.shape[1] != 1:
        raise UserError(
            f"{name}: colours depend on the view ({baked.attributes.sh.shape[1]} coefficients), and a page draws "
            "avatars of headgas with one colour; train with --method.sh-degree 0, or export a .mien"
        )
    along = network.along
    width = along.basis.shape[2]
    changes = ExpressionChanges(
        rest=along.rest,
        directions=along.directions,
        reach=np.array([_REACH]),
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
