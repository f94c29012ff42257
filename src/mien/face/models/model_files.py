"""Which schema a user's file of a face model has, and the face model in it."""

import zipfile
from pathlib import Path

from mien.disk.reading import open_archive, open_ordinary
from mien.errors import UserError
from mien.face.model import FaceModel
from mien.face.models.flame import flame_face_model, read_flame
from mien.face.models.gnm import gnm_face_model, is_gnm, read_gnm
from mien.face.models.ict import PACKED_KEYS, ict_face_model, is_ict_folder, read_ict
from mien.face.models.teeth import with_teeth

SUFFIXES = (".npz", ".pkl", ".pickle")


def default_name(path: Path) -> str:
    """Return the name of a face model from its file or folder."""
    if is_ict_folder(path) or _is_packed_ict(_members(path)):
        return "ict"
    return path.stem.lower().replace(" ", "_")


def licence_of(path: Path) -> str | None:
    """Return the licence of a model that is known by its schema; None for FLAME's schema, which many models have."""
    members = _members(path)
    if is_gnm(members):
        return "Apache-2.0 (GNM Head)"
    return "MIT (ICT-FaceKit)" if is_ict_folder(path) or _is_packed_ict(members) else None


def read_model_file(path: Path, name: str, shareable: bool = False, teeth: bool = False) -> FaceModel:
    """Read a face model of any schema, without landmarks: FLAME's, GNM's, or ICT-FaceKit.

    `shareable` says whether the licence of a model in FLAME's schema lets avatars carry a copy (those of GNM and ICT
    do), and `teeth` whether FLAME gets the teeth of GaussianAvatars.
    """
    members = _members(path)
    others = is_gnm(members) or is_ict_folder(path) or _is_packed_ict(members)
    if teeth and others:
        raise UserError(f"{path}: has teeth of its own; add it without --teeth")
    if is_gnm(members):
        return gnm_face_model(read_gnm(path), name)
    if others:
        return ict_face_model(read_ict(path), name, path)
    flame = read_flame(path)
    return flame_face_model(with_teeth(flame, str(path)) if teeth else flame, name, shareable)


def _is_packed_ict(members: list[str]) -> bool:
    return set(PACKED_KEYS) <= set(members)


def _members(path: Path) -> list[str]:
    """Return the names of an archive's members; none if it is no archive."""
    if path.suffix.lower() != ".npz":
        return []
    try:
        with open_ordinary(path) as file, open_archive(file) as archive:
            return [name.removesuffix(".npy") for name in archive.namelist()]
    except (OSError, ValueError, zipfile.BadZipFile, NotImplementedError, UserError):
        return []
