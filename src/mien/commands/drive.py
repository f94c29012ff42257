"""`mien drive`: an avatar that follows a driver."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from mien.capture.settings import CaptureSettings
from mien.commands.parsing.options import check_avatar, check_port, check_viewer, has_viewer
from mien.disk.workspace import open_workspace
from mien.errors import UserError
from mien.media.camera_names import CameraFormat, camera_named, is_camera
from mien.pipeline.driver import name_driver, name_neutral
from mien.pipeline.picture_options import PictureOptions


@dataclass(frozen=True)
class Command:
    """Make an avatar follow somebody else: a video, a camera, a sequence, or a recording."""

    workspace: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """Workspace folder of the avatar. For a camera, also a .mien file."""
    by: str
    """The driver: a workspace (also the avatar's own), a video, a picture or a folder of pictures (tracked first, and
    kept in the cache), a .csv of Live Link Face or of ARKit's names, a .json of blend shapes, a voice (.wav, .mp3,
    ...), or camera, which opens a viewer (docs/using.md).
    camera:/dev/video0 names the device; camera:clip.mp4 plays a file as a camera."""
    out: Path | None = None
    """Output: an .mp4, a .webm, a folder or NAME_%06d.png. If the driver has pictures, they are on the left. Without
    it, a viewer in the browser plays the motion. A camera is recorded as .mp4."""
    run_name: Annotated[str | None, tyro.conf.arg(name="run")] = None
    """Name of the avatar's run (default: the only one)."""
    sequence: str | None = None
    """Name of the driver's sequence (default: the only one)."""
    head_pose: bool = True
    """By default, the head follows the driver's head. With --no-head-pose it stays still, and only the face moves."""
    unlimited: bool = False
    """Follow the driver however far. By default, expressions and turns of the head that go beyond what the avatar was
    filmed in are softened, because it has never seen them."""
    alone: bool = False
    """Show only the avatar, without the driver's pictures beside it."""
    fps: float | None = None
    """Frame rate of the timecode in a .csv, in frames per second (default: the smallest usual rate above its frame
    numbers). Where its frame field never changes, or there is no timecode: rows per second."""
    neutral: str | None = None
    """The driver's face at rest, from which its motion is measured: first (its first half second), calm (its calmest
    tenth), model (the face model's own neutral), or a video, recording, workspace or sequence folder of the driver at
    rest. By default, it is the calmest tenth, without what is far from the face model's neutral, such as a grin."""
    camera_format: CameraFormat | None = None
    """What reads the camera: v4l2 (Linux), avfoundation (macOS) or dshow (Windows). The default is the platform's."""
    port: int = 0
    """Port of the viewer, from 1 to 65535. 0 means a free one."""
    picture: Annotated[PictureOptions, tyro.conf.arg(name="")] = field(default_factory=PictureOptions)
    capture: CaptureSettings = field(default_factory=CaptureSettings)

    def check(self) -> None:
        """Check options and paths without heavy libraries."""
        if is_camera(self.by):
            self._check_camera()
            return
        if self.camera_format is not None:
            raise UserError(f"--camera-format: is for --by camera, and --by is {self.by}; leave it out")
        open_workspace(self.workspace).pick_run(self.run_name)
        if self.out is None:
            self._check_viewer()
        elif self.port:
            raise UserError(f"--port {self.port}: is for the viewer, and --out writes a file; leave one of them out")
        else:
            # The number of frames is known only after tracking, but a video or numbered pictures take any number.
            self.picture.plan(self.out, 2)
        name_driver(Path(self.by), self.sequence, self.fps, self.capture)
        name_neutral(self.neutral)

    def _check_viewer(self) -> None:
        """Check that the viewer can show it, which has no options of pictures."""
        check_port(self.port)
        check_viewer()
        films = {"--sequence": self.sequence, "--fps": self.fps, "--no-head-pose": not self.head_pose}
        films |= {"--unlimited": self.unlimited, "--alone": self.alone}
        films["the options of pictures"] = self.picture != PictureOptions()
        given = [name for name, value in films.items() if value not in (None, False)]
        if given:
            raise UserError(f"{', '.join(given)}: needs --out FILE.mp4, because the viewer does without; add it")

    def _check_camera(self) -> None:
        check_avatar(self.workspace, self.run_name)
        for name, given in (("--sequence", self.sequence), ("--fps", self.fps), ("--neutral", self.neutral)):
            if given is not None:
                raise UserError(f"{name} {given}: is for recordings, and --by is a camera; leave it out")
        if self.capture != CaptureSettings():
            raise UserError("--capture: is for a video or pictures, and --by is a camera; leave its options out")
        camera_named(self.by, self.camera_format)
        check_port(self.port)
        if self.out is None:
            check_viewer()
        elif self.picture.plan(self.out, 2).kind != "mp4":
            raise UserError(f"--out {self.out}: a camera is recorded as .mp4; choose such a name")

    def run(self) -> None:
        """Track the driver if necessary, then pose and render every timestep. A viewer shows it until Ctrl-C."""
        if is_camera(self.by):
            self._follow()
            return
        from mien.pipeline.drive import DriveOptions, run_driving_stage

        if self.out is None:
            self._show()
            return
        workspace = open_workspace(self.workspace)
        run_dir = workspace.run_dir(workspace.pick_run(self.run_name))
        how = self.head_pose, self.alone, self.fps, self.unlimited, self.neutral, self.capture
        options = DriveOptions(self.sequence, *how)
        run_driving_stage(run_dir, Path(self.by), self.out, options, self.picture)

    def _show(self) -> None:
        from mien.pipeline.view import Motions, Place, run_viewing_stage

        motions = Motions(self.by, self.neutral, at_once=True, capture=self.capture)
        run_viewing_stage(self.workspace, self.run_name, motions, Place("127.0.0.1", self.port))

    def _follow(self) -> None:
        from mien.driving.follower import FollowOptions
        from mien.pipeline.follow import CameraOptions, run_following_stage
        from mien.pipeline.view import Place

        place = Place("127.0.0.1", self.port) if has_viewer() else None
        follow = FollowOptions(self.head_pose, self.unlimited)
        options = CameraOptions(follow, self.picture, self.out, self.alone, place)
        run_following_stage(self.workspace, self.run_name, camera_named(self.by, self.camera_format), options)
