"""GaussianAvatars' folder: point_cloud.ply with Gaussians in the frames of triangles, and flame_param.npz beside it.

The .ply has the layout of 3D Gaussians with raw values and one property more, the index of a Gaussian's triangle.
Positions, scales and rotations are in the frame of that triangle (paper, section 3.2). The mesh itself is not in the
folder: FLAME, with the parameters in flame_param.npz, is assumed. Avatars on other face models have the face model
beside them (face_model.json and face_model.safetensors), unless its licence forbids copies.
"""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, Int
from torch import Tensor

from mien.avatar.avatar import Avatar
from mien.avatar.files import overwrite
from mien.avatar.gaussian_avatars.settings import as_published
from mien.avatar.methods import METHODS
from mien.disk.files import cannot_write
from mien.disk.limits import MAX_NUMBER, is_moderate
from mien.disk.reading import open_to_read
from mien.errors import UserError
from mien.face.loading import read_face_model, read_landmarks, write_face_model
from mien.face.model import FaceModel
from mien.face.models.flame_params import read_flame_params, write_flame_params
from mien.face.params import FaceParams
from mien.formats.format import Content, NoOptions
from mien.formats.ply import BINDING, property_names, read_columns, stacked, stacked_sh, write_rows
from mien.runtime.baked import MeshBound
from mien.runtime.still import follows_mesh

POINTS, PARAMETERS, MODEL = "point_cloud.ply", "flame_param.npz", "face_model"
"""Names of the files. The face model's are MODEL.json and MODEL.safetensors."""
_MODEL_FILES = (f"{MODEL}.json", f"{MODEL}.safetensors")
_HEAD_COMMENT = "mien sh_frame: head"
"""Comment if spherical harmonics are evaluated in the head frame. GaussianAvatars evaluates them in the world."""


@dataclass(frozen=True, eq=False)
class GaussianAvatarsFolder:
    """Content of a folder."""

    avatar: Avatar
    face: FaceParams
    """The person at all t timesteps of flame_param.npz."""


def write_gaussian_avatars_folder(folder: Path, avatar: Avatar, face: FaceParams) -> None:
    """Write an avatar of Gaussians bound to triangles, and the subject at any timesteps, as GaussianAvatars' folder.

    The folder is made if it is missing, and files of the same names are replaced.
    """
    baked = avatar.bake()
    if not follows_mesh(baked):
        raise UserError(
            f"{folder}: GaussianAvatars' folder holds Gaussians that are bound to triangles, and those of this run's "
            "method are not; export a .mien or a .ply instead"
        )
    if baked.changes is not None:
        raise UserError(
            f"{folder}: GaussianAvatars' folder cannot hold Gaussians that change with the expression "
            "beside the mesh; export a .mien instead, or train a run with `--method.appearance static "
            "--method.expression-rank 0`"
        )
    with _replaced_together(folder) as aside:
        write_flame_params(aside / PARAMETERS, avatar.face_model, face)
        if avatar.face_model.shareable:
            write_face_model(aside / MODEL, avatar.face_model)
        in_head = baked.sh_frame == "head" and baked.attributes.sh.shape[1] > 1
        frame = f"frame: that of the triangle {BINDING}, in units of its size"
        write_rows(aside / POINTS, _rows(baked), *([_HEAD_COMMENT] if in_head else []), frame)


def read_gaussian_avatars_folder(folder: Path, face_model: FaceModel | None = None) -> GaussianAvatarsFolder:
    """Read a folder that GaussianAvatars or `write_gaussian_avatars_folder` wrote.

    `face_model` is the one that the avatar was made with, if it is not in the folder.
    """
    path = folder / POINTS
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder; give one with {POINTS} and {PARAMETERS}")
    if not path.is_file():
        raise UserError(f"{folder}: has no {POINTS}; give the folder in which it lies with {PARAMETERS}")
    face_model = _face_model_of(folder) if face_model is None else face_model
    if face_model is None:
        raise UserError(
            f"{folder}: has no face model in it, so its mesh is FLAME's; name your FLAME model with --face-model NAME "
            "or FILE (`mien face-models --add FILE` adds it)"
        )
    for name in (POINTS, PARAMETERS):
        _refuse_links(folder / name)
    columns, lines = read_columns(path)
    binding = _binding(columns, path, len(face_model.faces))
    sh = stacked_sh(columns, path)
    face = read_flame_params(folder / PARAMETERS, face_model)
    method = METHODS["gaussian_avatars"]
    frame = "head" if f"comment {_HEAD_COMMENT}" in lines else "world"
    config = replace(as_published(), sh_degree=int(sh.shape[1] ** 0.5) - 1, sh_frame=frame)
    with torch.random.fork_rng(devices=[]):
        avatar = method.avatar(config, face_model, face)
    state = {
        "means": stacked(columns, ["x", "y", "z"], path),
        "quats": stacked(columns, [f"rot_{i}" for i in range(4)], path),
        "log_scales": stacked(columns, [f"scale_{i}" for i in range(3)], path),
        "opacity_logits": stacked(columns, ["opacity"], path)[:, 0], "sh_constant": sh[:, :1], "sh_rest": sh[:, 1:],
    }  # fmt: skip
    for name, array in state.items():
        if not is_moderate(array):
            raise UserError(f"{path}: {name} holds NaN or numbers beyond {MAX_NUMBER:g}; export it again")
    trained = {name: torch.from_numpy(state[name]) for name in avatar.store.trained}
    own = {key: trained.get(key.rpartition(".")[2], binding) for key in avatar.state_dict()}
    overwrite(avatar, own, len(binding), path)
    return GaussianAvatarsFolder(avatar, face)


@contextmanager
def _replaced_together(folder: Path) -> Iterator[Path]:
    """A hidden folder for new files, which replace those of an earlier export when all of them are written."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder, prefix=".partial-") as name:
            aside = Path(name)
            try:
                yield aside
            except UserError as error:
                raise UserError(str(error).replace(str(aside), str(folder))) from None
            for file in (PARAMETERS, *_MODEL_FILES, POINTS):
                if (aside / file).exists():
                    (aside / file).replace(folder / file)
                else:  # of another avatar that was exported here before
                    (folder / file).unlink(missing_ok=True)
    except OSError as error:
        raise cannot_write(folder, error) from None


def _rows(baked: MeshBound) -> np.ndarray:
    """One record per Gaussian: the raw values in the order of `property_names`, then the triangle."""
    attributes, sh = baked.attributes, baked.attributes.sh
    columns: list[Float32[np.ndarray, "n _"]] = [
        baked.means, np.zeros_like(baked.means), sh[:, 0], sh[:, 1:].transpose(0, 2, 1).reshape(len(sh), -1),
        attributes.opacity_logits[:, None], attributes.log_scales, attributes.quats,
    ]  # fmt: skip
    values, names = np.concatenate(columns, axis=1), property_names(sh.shape[1])
    rows = np.empty(len(values), [*((name, "<f4") for name in names), (BINDING, "<i4")])
    for index, name in enumerate(names):
        rows[name] = values[:, index]
    rows[BINDING] = baked.face_index
    return rows


def _binding(columns: dict[str, np.ndarray], path: Path, triangles: int) -> Int[Tensor, " n"]:
    """The index of the triangle of each Gaussian."""
    if BINDING not in columns:
        raise UserError(
            f"{path}: lacks {BINDING}, the triangle of each Gaussian; give the {POINTS} of a GaussianAvatars avatar"
        )
    values = columns[BINDING]
    wrong = ~((values == np.round(values)) & (values >= 0) & (values < triangles))
    if wrong.any():
        raise UserError(
            f"{path}: {BINDING} of Gaussian {int(wrong.argmax())} is {values[wrong.argmax()]:g}, not the index of one "
            f"of the face model's {triangles:,} triangles; import it with the face model that it was made with "
            "(--face-model)"
        )
    return torch.from_numpy(values.astype(np.int64))


def _face_model_of(folder: Path) -> FaceModel | None:
    if not (folder / _MODEL_FILES[0]).exists():
        return None
    for name in _MODEL_FILES:
        _refuse_links(folder / name)
    model = read_face_model(folder / MODEL, "copy the folder again, or export it again")
    try:
        marks = read_landmarks(model.name, model)
    except UserError:  # there are none of the model's name, or they are for another mesh
        marks = {}
    return replace(model, landmarks=marks)


def _refuse_links(path: Path) -> None:
    try:
        open_to_read(path).close()
    except FileNotFoundError:
        raise UserError(f"{path}: is missing; copy the whole folder again") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); check its permissions") from None


def write(path: Path, content: Content, options: NoOptions) -> str:
    """Write the folder, and return what is told of it."""
    avatar, face = content.trained()
    write_gaussian_avatars_folder(path, avatar, face)
    told = f"{content.count:,} Gaussians, {len(face)} timesteps"
    if avatar.face_model.flame_origin is not None:
        return told
    return (
        f"{told}\nnote: the folder has the face model {avatar.face_model.name!r} in it; `mien import` reads it, but "
        "GaussianAvatars' viewer opens only avatars on FLAME with teeth"
    )
