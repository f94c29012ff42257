"""GaussianAvatars' folder: Gaussians bound to triangles, and all timesteps (docs/gaussian_avatars_folder.md)."""

from pathlib import Path

from mien import export
from mien.formats.format import Content, Format, Options

_EVERY = "GaussianAvatars' folder holds every timestep; leave --set, --series and --every out"
_OWN_MODEL = (
    "\nnote: the folder has the face model {name!r} in it; `mien import` reads it, but GaussianAvatars' viewer opens "
    "only avatars on FLAME with teeth"
)


def _write(path: Path, content: Content, options: Options) -> str:
    avatar, face = content.trained()
    export.write_gaussian_avatars_folder(path, avatar, face)
    note = "" if avatar.face_model.flame_origin is not None else _OWN_MODEL.format(name=avatar.face_model.name)
    return f"{content.count:,} Gaussians, {len(face)} timesteps{note}"


GAUSSIAN_AVATARS = Format(
    "gaussian-avatars", "folder", _write, refusals={"set": _EVERY, "series": _EVERY, "every": _EVERY}, from_files=False
)
