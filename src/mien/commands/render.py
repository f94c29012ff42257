"""`mien render`."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mien.errors import UserError
from mien.workspace import open_workspace


@dataclass(frozen=True)
class Command:
    """Render an avatar: a turntable as .mp4, or a still as .png, with any expression."""

    workspace: Annotated[Path, tyro.conf.Positional]
    """Workspace folder."""
    out: Path
    """An .mp4 (turntable) or a .png (still) to write."""
    run_name: Annotated[str | None, tyro.conf.arg(name="run")] = None
    """Which run (default: the only one)."""
    set: tuple[str, ...] = ()
    """Expressions by name, e.g. --set jawOpen=0.6 mouthSmileLeft=0.4 (default: the person's neutral)."""
    size: int = 512
    """Width and height of the picture, pixels."""
    frames: int = 120
    """Of the turntable."""
    fps: float = 25.0
    """Of the turntable."""
    span: float = 40.0
    """Degrees that the camera swings through, 360 for all the way round; sides that were not filmed look broken."""

    def run(self) -> None:
        """Pose once, render from every camera."""
        import cv2
        import torch

        from mien.avatar import load_avatar
        from mien.capture.video import write_video
        from mien.commands.expression import with_expression
        from mien.evaluation.cameras import turntable
        from mien.evaluation.pictures import to_uint8
        from mien.progress import say, track_progress
        from mien.render import rasterize
        from mien.storage import write_atomically
        from mien.training.run import run_camera

        if self.out.suffix not in (".mp4", ".png"):
            raise UserError(f"{self.out}: cannot write {self.out.suffix or 'a file without ending'}; use .mp4 or .png")
        if not 16 <= self.size <= 8192 or self.frames < 1 or self.fps <= 0:
            raise UserError(
                f"--size {self.size} --frames {self.frames} --fps {self.fps:g}: use 16..8192, 1 or more, above 0"
            )
        workspace = open_workspace(self.workspace)
        run_dir = workspace.run_dir(workspace.pick_run(self.run_name))
        avatar = load_avatar(run_dir)
        face = with_expression(avatar.subject, avatar.face_model, self.set)
        white = torch.ones(3)
        camera = run_camera(run_dir).resized(self.size, self.size)
        with torch.no_grad():
            gaussians = avatar.pose(face).gaussians.timestep(0)
            if self.out.suffix == ".png":
                image = to_uint8(rasterize(gaussians, camera, white).image)
                encoded = cv2.imencode(".png", image[:, :, ::-1])[1].tobytes()
                write_atomically(self.out, lambda path: path.write_bytes(encoded))
            else:
                cameras = turntable(camera, face.head_translation[0], self.frames, math.radians(self.span))
                pictures = (to_uint8(rasterize(gaussians, view, white).image) for view in cameras)
                write_video(self.out, track_progress(pictures, "Rendering", self.frames), self.fps)
        say(f"{self.out}: {len(gaussians):,} Gaussians at {self.size}x{self.size}")
