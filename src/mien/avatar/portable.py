"""Avatars as .mien files: the baked avatar, with the facts about subject and face model that a program needs."""

from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import mien
from mien.avatar import baked as torch_side
from mien.avatar.avatar import Avatar
from mien.avatar.baked import BakedAvatar
from mien.avatar.methods import method_of
from mien.camera import Camera
from mien.errors import UserError
from mien.face.loading import available_face_models
from mien.runtime import model as numpy_side
from mien.runtime import read_portable
from mien.runtime.model import About, Neutral, PortableAvatar


@torch.no_grad()
def make_portable(avatar: Avatar, camera: Camera, name: str) -> PortableAvatar:
    """The content of a .mien file for an avatar (`mien.runtime.write_portable` writes it).

    Args:
        avatar: A trained avatar.
        camera: A good first view, such as the one that the avatar was trained with.
        name: The subject's name.

    Raises:
        UserError: the licence of its face model does not allow passing it on.
    """
    model, subject = avatar.face_model, avatar.subject
    if not model.shareable:
        raise UserError(
            f"{name}: a .mien file holds parts of the face model {model.name!r}, whose licence is not known to allow "
            "that; export a .ply instead, train with another --face-model, or, if it does, say so: mien face-models "
            f"--add FILE --name {model.name} --shareable"
        )
    licences = {info.name: info.licence for info in available_face_models()}
    return PortableAvatar(
        baked=as_numpy(avatar.bake()),
        expression_names=model.expression_names,
        expression_bounds=as_numpy(model.expression_bounds),
        joint_names=model.free_joint_names,
        neutral=Neutral(
            as_numpy(subject.expression[0]),
            as_numpy(subject.joints[0]),
            as_numpy(subject.head_rotation[0]),
            as_numpy(subject.head_translation[0]),
        ),
        camera=numpy_side.Camera(as_numpy(camera.K), as_numpy(camera.viewmat), camera.width, camera.height),
        about=About(
            name=name,
            method=method_of(avatar.config),
            face_model=model.name,
            face_model_hash=model.content_hash,
            licence=licences.get(model.name, "unknown"),
            mien=mien.__version__,
        ),
    )


def read_baked(path: Path) -> BakedAvatar:
    """The baked avatar of a .mien file, as torch tensors.

    Raises:
        UserError: the file is missing, damaged or of another version.
    """
    return as_torch(read_portable(path).baked)


def as_numpy(value: Any) -> Any:
    """Turn tensors into arrays, and dataclasses of `mien.avatar.baked` into their namesakes of `mien.runtime.model`."""
    if isinstance(value, Tensor):
        array = value.detach().cpu().numpy()
        return np.array(array, np.float32 if value.is_floating_point() else np.int32, order="C")
    return _translated(value, numpy_side, as_numpy)


def as_torch(value: Any) -> Any:
    """The inverse of `as_numpy`."""
    if isinstance(value, np.ndarray):
        return torch.from_numpy(value.astype(np.float32 if value.dtype.kind == "f" else np.int64))
    return _translated(value, torch_side, as_torch)


def _translated(value: Any, namesakes: Any, convert: Any) -> Any:
    if is_dataclass(value):
        converted = {f.name: convert(getattr(value, f.name)) for f in fields(value)}
        return getattr(namesakes, type(value).__name__)(**converted)
    return tuple(convert(item) for item in value) if isinstance(value, tuple) else value
