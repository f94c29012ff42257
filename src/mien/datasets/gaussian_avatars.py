"""GaussianAvatars' folder: a trained avatar, and all timesteps (docs/gaussian_avatars_folder.md)."""

from pathlib import Path
from typing import TYPE_CHECKING

from mien.datasets.dataset import Dataset, TrainedAvatar

if TYPE_CHECKING:
    from mien.face.model import FaceModel

_FILES = ("point_cloud.ply", "flame_param.npz")


def _recognises(path: Path) -> str | None:
    # One of the files is enough: the reader names the other one, if it is missing.
    found = [name for name in _FILES if (path / name).exists()]
    return f"an avatar of GaussianAvatars ({', '.join(found)})" if found else None


def _read(path: Path, face_model: "FaceModel | None") -> TrainedAvatar:
    from mien.formats.gaussian_avatars import read_gaussian_avatars_folder

    content = read_gaussian_avatars_folder(path, face_model)
    return TrainedAvatar(content.avatar, content.face)


GAUSSIAN_AVATARS = Dataset(
    "gaussian-avatars", "the folder of a trained avatar with point_cloud.ply and flame_param.npz", "avatar",
    _recognises, _read,
)  # fmt: skip
