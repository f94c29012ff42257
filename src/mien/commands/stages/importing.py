"""From another program's avatar to a run of a workspace."""

import math
from pathlib import Path

import torch

from mien.avatar import Avatar
from mien.camera import Camera, camera_from_fov, look_at
from mien.commands.stages.face_models import face_model_of
from mien.commands.stages.names import check_new_run
from mien.export import GaussianAvatarsFolder, read_gaussian_avatars_folder
from mien.inside import remove_tree
from mien.locks import check_free, hold
from mien.training import write_imported_run
from mien.training.run import BUSY_REMEDY

_DISTANCE = 1.2
"""Distance of the camera from the middle of the head, in metres."""
_SIDE = 512
_MARGIN = 1.15
"""Size of the picture relative to the largest extent of the head's mesh."""


def import_gaussian_avatars(folder: Path, run_dir: Path, face_model: str | None) -> GaussianAvatarsFolder:
    """Read GaussianAvatars' folder and write it as a run.

    Args:
        folder: The folder.
        run_dir: The run's folder, which must be missing.
        face_model: Name or file of its FLAME model, unless the folder has a face model in it.

    Raises:
        UserError: the folder or the face model cannot be read, or the run cannot be written.
        BeingWrittenError: another process is writing the run.
    """
    check_free(run_dir, BUSY_REMEDY)
    content = read_gaussian_avatars_folder(folder, None if face_model is None else face_model_of(face_model))
    with hold(run_dir, remedy=BUSY_REMEDY):
        check_new_run(run_dir)  # another process may have written it meanwhile
        try:
            write_imported_run(run_dir, content.avatar, content.face, front_camera(content.avatar), folder)
        except BaseException:
            remove_tree(run_dir)
            raise
    return content


@torch.no_grad()
def front_camera(avatar: Avatar) -> Camera:
    """A camera in front of the person at rest that shows the whole mesh."""
    subject = avatar.subject
    vertices = avatar.face_model.head_vertices(subject)[0]
    middle, pose = (vertices.amin(0) + vertices.amax(0)) / 2, subject.T_world_head[0]
    in_front = middle + torch.tensor([0.0, 0.0, _DISTANCE])
    position, target = (pose[:3, :3] @ point + pose[:3, 3] for point in (in_front, middle))
    extent = float((vertices.amax(0) - vertices.amin(0)).max())
    return camera_from_fov(
        2 * math.atan(0.5 * _MARGIN * extent / _DISTANCE), _SIDE, _SIDE, look_at(position, target, pose[:3, 1])
    )
