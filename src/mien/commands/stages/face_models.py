"""Face models by name or by file, as the command line takes them."""

from dataclasses import replace
from pathlib import Path

from mien.errors import UserError
from mien.face import FaceModel, add_face_model, added_from, load_face_model
from mien.face.flame import flame_face_model, read_flame
from mien.progress import say
from mien.storage import file_digest
from mien.tracking.landmark_embedding import EmbeddingSettings, embed_landmarks
from mien.tracking.regions import with_regions_by_landmarks

_SUFFIXES = (".npz", ".pkl", ".pickle")
_FIRST_PICTURES = 80
"""Drawn of a model whose lips and brows are not known yet; then all of `EmbeddingSettings` with these painted."""


def face_model_of(choice: str) -> FaceModel:
    """The face model of that name, or of that file: one in FLAME's schema is added at its first use.

    Raises:
        UserError: there is no such model, or the file is none.
    """
    path = Path(choice).expanduser()
    if path.suffix.lower() in _SUFFIXES:
        return add_face_model_stage(path)
    if path.is_file() or "/" in choice:
        raise UserError(f"--face-model {choice}: is neither the name of a face model (see `mien face-models`) nor a .npz "
                        "or .pkl in FLAME's schema")  # fmt: skip
    return load_face_model(choice)


def add_face_model_stage(path: Path, name: str | None = None, shareable: bool = False) -> FaceModel:
    """Make a file in FLAME's schema a face model of this user's, named after the file or as told; current ones stay.

    Its landmarks are placed by drawing it and letting the landmark detector look (some minutes, once).

    Raises:
        UserError: the file is missing, damaged or in another schema; or its name is taken.
    """
    name = name or path.stem.lower().replace(" ", "_")
    if not name.replace("-", "").replace("_", "").replace(".", "").isalnum() or name.startswith("."):
        raise UserError(f"--name {name!r}: give letters, digits, '-', '_' and '.' only")
    if name == "anny":
        raise UserError(f"{path}: {name!r} is a face model of mien's own; give another with `mien face-models --add "
                        f"{path} --name NAME`")  # fmt: skip
    if not path.is_file():
        read_flame(path)  # which says so
    digest, known = file_digest(path), added_from(name)
    if known is not None and known["sha256"] != digest:
        raise UserError(f"{path}: {name!r} was added from {known['path']}, which is another file; add this one under "
                        f"another name: mien face-models --add {path} --name NAME")  # fmt: skip
    if known is not None:
        model = load_face_model(name)
        if model.shareable == shareable:
            return model
    model = flame_face_model(read_flame(path), name, shareable)
    say(f"{path}: {len(model.template)} vertices, {len(model.identity_basis)} identity and "
        f"{len(model.expression_basis)} expression directions; placing its landmarks, once")  # fmt: skip
    settings = EmbeddingSettings()
    model = replace(model, landmarks=embed_landmarks(model, replace(settings, pictures=_FIRST_PICTURES))[0])
    model = with_regions_by_landmarks(model)
    landmarks, errors = embed_landmarks(model, settings)
    model = replace(model, landmarks=landmarks)
    add_face_model(model, path, digest)
    say(f"{name}: landmarks placed with a median error of {float(errors.median()):.2f} pixels; --face-model {name} "
        "from now on")  # fmt: skip
    return load_face_model(name)
