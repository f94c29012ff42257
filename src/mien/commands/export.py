"""`mien export`."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from mien.workspace import open_workspace


@dataclass(frozen=True)
class Command:
    """Write an avatar for other programs: .mien (all of it, for mien.runtime) or .ply (one expression, for viewers)."""

    workspace: Annotated[Path, tyro.conf.Positional]
    """Workspace folder."""
    out: Path
    """The .mien or .ply to write."""
    run_name: Annotated[str | None, tyro.conf.arg(name="run")] = None
    """Which run (default: the only one)."""
    set: tuple[str, ...] = ()
    """Expressions by name, e.g. --set jawOpen=0.6 mouthSmileLeft=0.4 (default: the person's neutral)."""

    def run(self) -> None:
        """Pose, then write."""
        import torch

        from mien.avatar import load_avatar
        from mien.commands.expression import with_expression
        from mien.export import in_world, write_ply
        from mien.progress import say

        workspace = open_workspace(self.workspace)
        avatar = load_avatar(workspace.run_dir(workspace.pick_run(self.run_name)))
        face = with_expression(avatar.subject, avatar.face_model, self.set)
        # Viewers turn around the origin, so the head goes there: +y up, +z out of the face.
        face = replace(
            face,
            head_rotation=torch.zeros_like(face.head_rotation),
            head_translation=torch.zeros_like(face.head_translation),
        )
        with torch.no_grad():
            gaussians = avatar.pose(face).gaussians.timestep(0)
        write_ply(self.out, in_world(gaussians))
        say(f"{self.out}: {len(gaussians):,} Gaussians")
