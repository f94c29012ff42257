"""`mien import`: avatars that another program trained."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mien.commands.stages.names import check_new_run, run_name
from mien.errors import UserError
from mien.workspace import Workspace, check_new_workspace


@dataclass(frozen=True)
class Command:
    """Make a run of GaussianAvatars' own folder (point_cloud.ply with binding_0, and flame_param.npz)."""

    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER")]
    """The folder with point_cloud.ply and flame_param.npz."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Workspace folder to put the run into. It is made if it is missing."""
    name: Annotated[str, tyro.conf.arg(name="run")] = "gaussian_avatars"
    """Name of the run."""
    face_model: str | None = None
    """The FLAME model of the avatar: its name among your face models, or a .npz or .pkl (added at its first use). It is
    not needed for folders that `mien export` wrote with the face model inside."""

    def check(self) -> None:
        """Check options and paths without heavy libraries."""
        if not self.folder.is_dir():
            raise UserError(f"{self.folder}: no such folder; give one with point_cloud.ply and flame_param.npz")
        check_new_workspace(self.out)
        run_dir = Workspace(self.out).run_dir(run_name(self.name))
        check_new_run(run_dir)

    def run(self) -> None:
        """Read the folder and write the run."""
        from mien.commands.stages.importing import import_gaussian_avatars
        from mien.progress import say
        from mien.terminal import counted

        run_dir = Workspace(self.out).run_dir(self.name)
        content = import_gaussian_avatars(self.folder, run_dir, self.face_model)
        count = len(content.avatar.gaussian_store())
        timesteps = counted(len(content.face), "timestep")
        say(f"{run_dir}: {counted(count, 'Gaussian')} on {content.avatar.face_model.name}, {timesteps}")
