"""From an avatar with tensors to the records of `mien.runtime`, which need no torch: what `Avatar.bake` is built from.

A method fills one of three records (`mien.runtime.baked`): `MeshBound`, `BlendSkinned` or `Static`. `as_array` converts
its tensors, and `bake_rig` converts the face model. `make_portable` adds the facts about subject, face model and camera
that a program needs, which makes the content of a .mien file.
"""

import numpy as np
import torch
from jaxtyping import Shaped
from torch import Tensor

import mien
from mien.avatar.avatar import Avatar
from mien.avatar.methods import method_of
from mien.camera import Camera
from mien.errors import UserError
from mien.face.listing import available_face_models
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.runtime import baked
from mien.runtime.baked import About, Neutral, PortableAvatar, Rig


def as_array(tensor: Tensor) -> Shaped[np.ndarray, "..."]:
    """A copy of a tensor as a contiguous array: float32 for floating point, int32 for everything else."""
    return np.array(tensor.detach().cpu().numpy(), np.float32 if tensor.is_floating_point() else np.int32, order="C")


@torch.no_grad()
def bake_rig(face_model: FaceModel, subject: FaceParams) -> Rig:
    """A face model's vertices with one subject's identity and offsets applied."""
    return Rig(
        template=as_array(face_model.rest_vertices(subject)),
        expression_names=face_model.expression_names,
        expression_basis=as_array(face_model.expression_basis),
        joint_names=face_model.joint_names,
        joint_parents=face_model.joint_parents,
        joint_free=face_model.joint_free,
        joint_template=as_array(face_model.rest_joints(subject)),
        joint_rotation_basis=as_array(face_model.joint_rotation_basis),
        joint_translation_basis=as_array(face_model.joint_translation_basis),
        skinning_weights=as_array(face_model.skinning_weights),
        pose_basis=None if face_model.pose_basis is None else as_array(face_model.pose_basis),
    )


def make_portable(avatar: Avatar, camera: Camera, name: str, to_share: bool = True) -> PortableAvatar:
    """The content of a .mien file for an avatar (`mien.runtime.write_portable` writes it).

    Args:
        avatar: A trained avatar.
        camera: A good first view, such as the one that the avatar was trained with.
        name: The subject's name.
        to_share: Whether the result leaves this machine, as a file does.
    """
    model, subject = avatar.face_model, avatar.subject
    if to_share and not model.shareable:
        raise UserError(
            f"{name}: a .mien file holds parts of the face model {model.name!r}, and its licence is not known to allow "
            "that; export a .ply instead, or train with another --face-model; if the licence does allow it, run "
            f"`mien face-models --add FILE --name {model.name} --shareable`"
        )
    licences = {info.name: info.licence for info in available_face_models()}
    return PortableAvatar(
        baked=avatar.bake(),
        expression_names=model.expression_names,
        expression_bounds=as_array(model.expression_bounds),
        joint_names=model.free_joint_names,
        neutral=Neutral(
            expression=as_array(subject.expression[0]),
            joints=as_array(subject.joints[0]),
            head_rotation=as_array(subject.head_rotation[0]),
            head_translation=as_array(subject.head_translation[0]),
        ),
        camera=baked.Camera(as_array(camera.K), as_array(camera.viewmat), camera.width, camera.height),
        about=About(
            name=name,
            method=method_of(avatar.config),
            face_model=model.name,
            face_model_hash=model.content_hash,
            licence=licences.get(model.name, "unknown"),
            mien=mien.__version__,
        ),
        filmed=avatar.filmed,
    )
