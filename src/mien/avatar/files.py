"""Avatars on disk: a folder with avatar.json, avatar.safetensors and, if its licence allows it, the face model."""

from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mien.avatar.avatar import Avatar
from mien.avatar.methods import method_named, method_of
from mien.disk.config import decode, encode, for_loading
from mien.disk.files import file_digest, read_json, read_tensors, write_json, write_tensors
from mien.disk.limits import MAX_NUMBER
from mien.disk.locks import read_beside_writers
from mien.disk.reading import check_subtrees, check_tree, expect_whole
from mien.errors import UserError
from mien.face.checks import check_face_params
from mien.face.loading import load_face_model, read_face_model, read_landmarks, write_face_model
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.runtime.baked import Filmed
from mien.runtime.checks import baked_fault, filmed_fault

_AVATAR, _VERSION = "mien.avatar", 1
_REMEDY = "delete the run's training.json, if it is there, and train it again with `mien train`"


@dataclass(frozen=True)
class _Content:
    kind: str
    """The method's name."""
    config: dict[str, Any]
    gaussians: int
    face_model: str
    face_model_hash: str
    face_model_carried: bool
    tensors_sha256: str


def write_avatar(folder: Path, avatar: Avatar) -> None:
    """Write an avatar. avatar.json is written last, so a folder that has it is complete."""
    tensors = {f"avatar.{name}": tensor for name, tensor in avatar.state_dict().items()}
    tensors |= {f"subject.{name}": tensor for name, tensor in avatar.subject.tensors().items()}
    if avatar.filmed is not None:
        tensors |= {f"filmed.{f.name}": torch.from_numpy(getattr(avatar.filmed, f.name)) for f in fields(avatar.filmed)}
    write_tensors(folder / "avatar.safetensors", tensors)
    carried = avatar.face_model.shareable
    if carried:
        write_face_model(folder / "face_model", avatar.face_model)
    content = _Content(
        kind=method_of(avatar.config),
        config=encode(avatar.config),
        gaussians=len(avatar.store),
        face_model=avatar.face_model.name,
        face_model_hash=avatar.face_model.content_hash,
        face_model_carried=carried,
        tensors_sha256=file_digest(folder / "avatar.safetensors"),
    )
    write_json(folder / "avatar.json", _AVATAR, _VERSION, asdict(content))


def load_avatar(folder: Path) -> Avatar:
    """Load the avatar of a run folder, or of an avatar folder itself."""
    return read_beside_writers(lambda: _load_avatar(folder), [folder, folder / "avatar"], [folder, folder.parent])


def _load_avatar(folder: Path) -> Avatar:
    folder = folder / "avatar" if (folder / "avatar").is_dir() else folder
    check_subtrees(folder.parent, *([folder.name] if folder.name == "avatar" else []))
    check_tree(folder)
    if not (folder / "avatar.json").is_file():
        if (folder / "config.json").is_file():
            raise UserError(
                f"{folder}: holds no trained avatar, because its training was not finished; run the same `mien train` "
                "or `mien create` again, which goes on from its last checkpoint"
            )
        raise UserError(
            f"{folder}: holds no trained avatar (no avatar.json); train one with `mien train` or `mien create`"
        )
    where = str(folder / "avatar.json")
    stored = read_json(folder / "avatar.json", _AVATAR, _VERSION, remedy=_REMEDY)
    named = {name: value for name, value in stored.items() if name not in ("format", "version")}
    content: _Content = decode(_Content, named, where, _REMEDY)
    try:
        method = method_named(content.kind)
    except UserError as error:
        raise UserError(f"{where}: {error}") from None
    tensors = read_tensors(folder / "avatar.safetensors", remedy=_REMEDY)
    if file_digest(folder / "avatar.safetensors") != content.tensors_sha256:
        raise UserError(f"{folder / 'avatar.safetensors'}: was changed or damaged after it was written; {_REMEDY}")
    face_model = _face_model_of(folder, content)
    config = decode(method.config, content.config, where, _REMEDY)
    with expect_whole(folder, _REMEDY):
        face = FaceParams(**_with_prefix(tensors, "subject."))
    check_face_params(face_model, face, str(folder), _REMEDY)
    if len(face) != 1:
        raise UserError(f"{folder}: its subject has {len(face)} timesteps instead of one; {_REMEDY}")
    with torch.random.fork_rng(devices=[]):
        avatar = method.avatar(for_loading(config), face_model, face)
    avatar.config, avatar.subject = config, face
    overwrite(avatar, _with_prefix(tensors, "avatar."), content.gaussians, folder)
    avatar.filmed = _filmed(_with_prefix(tensors, "filmed."), avatar, folder)
    return avatar.eval()


def _filmed(tensors: dict[str, Tensor], avatar: Avatar, folder: Path) -> Filmed | None:
    """What training saw of the face, or None if the file does not say."""
    if not tensors:
        return None
    with expect_whole(folder, _REMEDY):
        filmed = Filmed(**{field.name: tensors[field.name].numpy() for field in fields(Filmed)})
        fault = filmed_fault(filmed, len(avatar.face_model.expression_names) + avatar.subject.joints[0].numel())
        if fault is not None:
            raise ValueError(fault)
    return filmed


@torch.no_grad()
def overwrite(avatar: Avatar, state: dict[str, Tensor], gaussians: int, source: Path) -> None:
    """Replace every tensor of an avatar. The number of Gaussians may change. A record of it must be possible."""
    with expect_whole(source, "train it again"):
        _check_fits(avatar.state_dict(), state, gaussians)
        avatar.store.resize(gaussians)
        avatar.load_state_dict(state)
        # A few avatars have no record, and only drawing them can tell.
        fault = baked_fault(avatar.bake()) if avatar.extras.unbaked is None else None
    if fault is not None:
        raise UserError(f"{source}: cannot be posed ({fault}); train it again")


def _check_fits(own: dict[str, Tensor], state: dict[str, Tensor], gaussians: int) -> None:
    """Check that `state` can replace `own`, before memory for the Gaussians is allocated."""
    for name, tensor in own.items():
        found = state[name]
        if found.dtype != tensor.dtype or found.shape[1:] != tensor.shape[1:] or found.ndim != tensor.ndim:
            raise ValueError(f"{name!r} is of type {found.dtype} and shape {list(found.shape)}")
        if found.is_floating_point() and not (found.numel() == 0 or bool(found.abs().max() <= MAX_NUMBER)):
            raise ValueError(f"{name!r} holds NaN or numbers beyond {MAX_NUMBER:g}")
        # Baking narrows indices to 32 bits: what is larger would come round to one that exists.
        if found.dtype == torch.int64 and found.numel() > 0 and not (found.min() >= 0 and found.max() < 2**31):
            raise ValueError(f"{name!r} holds numbers that are not indices")
    known = {len(tensor) for tensor in state.values() if tensor.ndim > 0 and tensor[:1].numel() > 0}
    if gaussians and gaussians not in known:
        raise ValueError(f"no tensor has {gaussians} Gaussians")


def _face_model_of(folder: Path, content: _Content) -> FaceModel:
    name = content.face_model
    if content.face_model_carried:
        bare = read_face_model(folder / "face_model", _REMEDY)
        face_model = replace(bare, landmarks=read_landmarks(name, bare))
    else:
        face_model = load_face_model(name)
    if face_model.content_hash != content.face_model_hash:
        raise UserError(
            f"{folder}: was trained with face model {name!r} {content.face_model_hash}, but the one here is "
            f"{face_model.content_hash}; install that version of the face model, or train it again"
        )
    return face_model


def _with_prefix(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}
