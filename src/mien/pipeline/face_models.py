"""Face models by name or by file, as the command line takes them."""

from dataclasses import replace
from pathlib import Path

from mien.disk.files import file_digest
from mien.disk.locks import hold
from mien.errors import UserError
from mien.face.cache import cache_folder
from mien.face.listing import read_added_source
from mien.face.loading import add_face_model, is_built_in, load_face_model
from mien.face.model import FaceModel
from mien.face.models.ict import NEUTRAL, is_ict_folder
from mien.face.models.model_files import SUFFIXES, default_name, licence_of, read_model_file
from mien.face.models.teeth import TOOTH_VERTICES, VERTICES
from mien.machine.progress import say
from mien.pipeline.names import no_model_file
from mien.tracking.landmarks.embedding import EmbeddingSettings, embed_landmarks
from mien.tracking.landmarks.regions import with_regions_by_landmarks

FIRST_PICTURES = 80  # of the first round, when lips and brows are not known; the second round paints these


def face_model_of(choice: str) -> FaceModel:
    """The face model of a name or a file. A file is added at its first use."""
    path = Path(choice).expanduser()
    if path.suffix.lower() in SUFFIXES or is_ict_folder(path):
        return add_face_model_file(path)
    if path.is_file() or "/" in choice:
        raise UserError(
            f"--face-model {choice}: is neither the name of a face model (see `mien face-models`) nor a .npz or .pkl "
            "in FLAME's schema"
        )
    return load_face_model(choice)


def add_face_model_file(path: Path, name: str | None = None, shareable: bool = False, teeth: bool = False) -> FaceModel:
    """Add a face model's file (FLAME's schema, GNM Head, ICT-FaceKit) to this user's, unless it is already there.

    The default name is the file's; ICT-FaceKit is `ict`. Landmarks are placed by running the landmark detector on
    pictures of the model (some minutes, once). With `teeth`, FLAME gets those of GaussianAvatars.
    """
    name = name or default_name(path)
    if not name.replace("-", "").replace("_", "").isalnum():
        raise UserError(f"{name!r}: give the face model a name of letters, digits, '-' and '_' with --name")
    if not path.is_file() and not is_ict_folder(path):
        raise UserError(no_model_file(path))
    with hold(cache_folder() / "face_models" / "added" / name):
        return _add(path, name, shareable, teeth)


def _add(path: Path, name: str, shareable: bool, teeth: bool) -> FaceModel:
    digest = file_digest(path / NEUTRAL if path.is_dir() else path)
    known = read_added_source(name)
    other = f"add this one under another name: mien face-models --add {path} --name NAME"
    if is_built_in(name):
        raise UserError(f"{path}: {name!r} is the name of one of mien's own face models; {other}")
    if known is not None and known["sha256"] != digest:
        raise UserError(f"{path}: another file has the name {name!r}, {known['path']}; {other}")
    if known is None:
        model = _calibrated(read_model_file(path, name, shareable, teeth))
    else:
        model = load_face_model(name)
        if teeth and len(model.template) != VERTICES + TOOTH_VERTICES:
            raise UserError(f"{path}: {name!r} was added without teeth; {other}")
        if model.shareable or not shareable:
            return model
        model = replace(model, shareable=True)
    add_face_model(model, path, digest, licence_of(path))
    return load_face_model(name)


def _calibrated(model: FaceModel) -> FaceModel:
    say(
        f"{model.name}: {len(model.template):,} vertices, {len(model.identity_basis)} identity and "
        f"{len(model.expression_basis)} expression directions; placing its landmarks, once"
    )
    settings = EmbeddingSettings()
    model = replace(model, landmarks=embed_landmarks(model, replace(settings, pictures=FIRST_PICTURES))[0])
    model = with_regions_by_landmarks(model)
    landmarks, errors = embed_landmarks(model, settings)
    say(f"{model.name}: landmarks placed with a median error of {float(errors.median()):.2f} pixels")
    return replace(model, landmarks=landmarks)
