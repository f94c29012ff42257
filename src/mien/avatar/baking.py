"""From an avatar with tensors to the records of `mien.runtime`, which need no torch, and faces posed by them.

A method fills one of three records (`mien.runtime.baked`): `MeshBound`, `BlendSkinned` or `Static`. `as_array` converts
its tensors, and `bake_rig` converts the face model. `make_portable` adds the facts about subject, face model and camera
that a program needs, which makes the content of a .mien file.
"""

from collections.abc import Callable, Iterable
from typing import Generic, TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

import mien
from mien import runtime
from mien.arrays import is_native
from mien.avatar.avatar import Avatar
from mien.avatar.methods import method_of
from mien.avatar.ops.expression_changes import expression_inputs
from mien.avatar.store import as_array
from mien.camera import Camera
from mien.errors import UserError
from mien.face.listing import available_face_models
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.face.posing import head_poses
from mien.gaussians import Gaussians
from mien.runtime import baked
from mien.runtime.baked import About, BakedAvatar, Filmed, Neutral, PortableAvatar, Rig
from mien.runtime.checks import MAX_LOG_SCALE
from mien.runtime.filmed import head_angles


def as_log_scales(values: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Logarithms of scales for a record. Long runs shrink a few Gaussians to nothing, and no file may hold less."""
    return np.maximum(values, np.float32(-MAX_LOG_SCALE))


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

    The camera is a good first view. `to_share` says that the result leaves this machine, as a file does.
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


@torch.no_grad()
def measure_filmed(face: FaceParams, eyes: Float[Tensor, "b 3"]) -> Filmed:
    """The range of some training frames: expressions and head poses, which driving keeps to.

    `eyes` are the cameras' positions in world space, in metres.
    """
    inputs = expression_inputs(face.detach()).float().cpu()
    poses = (face.head_rotation, face.head_translation, eyes)
    angles = head_angles(*(tensor.detach().double().cpu().numpy() for tensor in poses))
    return Filmed(
        lowest=inputs.amin(0).numpy(),
        highest=inputs.amax(0).numpy(),
        head_angles=np.stack([angles.min(0), angles.max(0)], axis=1).astype(np.float32),
    )


T = TypeVar("T")


class Kept(Generic[T]):
    """A result that is kept until one of the tensors that it was made from changes."""

    def __init__(self) -> None:
        self._of: list[tuple[Tensor, int]] = []
        self._result: T | None = None

    def of(self, tensors: Iterable[Tensor], make: Callable[[], T]) -> T:
        """The result of `make`, called again only if there are other tensors, or torch has changed one in place."""
        # Held here, so that no other tensor can take the place of one that is gone.
        now = [(tensor, tensor._version) for tensor in tensors]
        same = len(now) == len(self._of) and all(
            a is b and version == before for (a, version), (b, before) in zip(now, self._of, strict=True)
        )
        if self._result is None or not same:
            self._of, self._result = now, make()
        return self._result


def can_pose_baked(like: Tensor, face: FaceParams) -> bool:
    """Whether the runtime can pose a face: on a CPU, in float32, without gradients."""
    wanted = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in face.tensors().values())
    return is_native(like) and not wanted


@torch.no_grad()
def pose_baked(baked: BakedAvatar, face: FaceParams) -> Gaussians:
    """The Gaussians of some timesteps, as a batch, from a baked avatar in the head frame."""
    found = []
    for timestep in range(len(face)):
        names = ("expression", "joints", "head_rotation", "head_translation")
        own = (getattr(face, name)[timestep].detach().float().cpu().contiguous().numpy() for name in names)
        found.append(runtime.pose(baked, runtime.Face(*own)))
    means, quats, scales, opacities, sh = (
        torch.stack([torch.from_numpy(getattr(one, name)) for one in found])
        for name in ("means", "quats", "scales", "opacities", "sh")
    )
    quats = torch.nn.functional.normalize(quats, dim=-1)
    return Gaussians(means, quats, scales, opacities, sh, head_poses(face).detach())
