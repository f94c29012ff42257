"""`mien drive`: an avatar that follows a driver."""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import tyro

from mien.capture.settings import CaptureSettings
from mien.disk.workspace import open_workspace
from mien.errors import UserError
from mien.media.camera_names import CameraFormat, camera_named, is_camera
from mien.pipeline.names import PORT, check_avatar, check_driver, check_neutral, check_viewer, has_viewer
from mien.pipeline.picture_options import PictureOptions

if TYPE_CHECKING:
    from mien.driving.follower import FollowOptions


@dataclass(frozen=True, kw_only=True)
class _Drive:
    workspace: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """Workspace folder of the avatar. For a camera, also a .mien file."""
    by: str
    """The driver: a workspace (also the avatar's own), a video, a picture or a folder of pictures (tracked first, and
    kept in the cache), a .csv of Live Link Face or of ARKit's names, a .json of blend shapes, a voice (.wav, .mp3,
    ...), or camera, which opens a viewer (docs/using.md).
    camera:/dev/video0 names the device; camera:clip.mp4 plays a file as a camera."""
    run_name: Annotated[str | None, tyro.conf.arg(name="run")] = None
    """Name of the avatar's run (default: the only one)."""


@dataclass(frozen=True, kw_only=True)
class _Neutral:
    neutral: str | None = None
    """The driver's face at rest, from which its motion is measured: first (its first half second), calm (its calmest
    tenth), model (the face model's own neutral), or a video, recording, workspace or sequence folder of the driver at
    rest. By default, it is the calmest tenth, without what is far from the face model's neutral, such as a grin."""
    capture: CaptureSettings = field(default_factory=CaptureSettings)


@dataclass(frozen=True, kw_only=True)
class _Film:
    head_pose: bool = True
    """By default, the head follows the driver's head. With --no-head-pose it stays still, and only the face moves."""
    unlimited: bool = False
    """Follow the driver however far. By default, turns of the head and rare expressions that go beyond what the avatar
    was filmed in are softened, because it has never seen them."""
    torso: Literal["still", "driver", "head"] = "still"
    """What the torso of an avatar with shoulders does. still: it stands, and only the head moves. driver: it follows
    the driver's torso, if the driver is filmed and has one. head: it moves with the head."""
    alone: bool = False
    """Show only the avatar, without the driver's pictures beside it."""
    picture: Annotated[PictureOptions, tyro.conf.arg(name="")] = field(default_factory=PictureOptions)

    def following(self) -> "FollowOptions":
        """Return how the avatar follows."""
        from mien.driving.follower import FollowOptions

        return FollowOptions(self.head_pose, self.unlimited, self.torso)


@dataclass(frozen=True, kw_only=True)
class Film(_Neutral, _Film, _Drive):
    """Make an avatar follow somebody else: a video, a camera, a sequence, or a recording.

    These are the options of a film, which --out names. Without --out, a viewer in the browser plays the motion at once;
    --neutral, --port and --capture.* are its options.

    With --by camera, the avatar follows you in a viewer, and --out records it as .mp4; see mien drive --by camera
    --help.
    """

    out: Path
    """The film: an .mp4, a .webm, a folder or NAME_%06d.png. If the driver has pictures, they are on the left. A viewer
    opens without it."""
    sequence: str | None = None
    """Name of the driver's sequence (default: the only one)."""
    fps: float | None = None
    """Frame rate of the timecode in a .csv, in frames per second (default: the smallest usual rate above its frame
    numbers). Where its frame field never changes, or there is no timecode: rows per second."""

    def check(self) -> None:
        """Check options and paths without heavy libraries."""
        open_workspace(self.workspace).pick_run(self.run_name)
        # The number of frames is known only after tracking, but a video or numbered pictures take any number.
        self.picture.plan(self.out, 2)
        check_driver(Path(self.by), self.sequence, self.fps, self.capture)
        check_neutral(self.neutral)

    def run(self) -> None:
        """Track the driver if necessary, then pose and render every timestep."""
        from mien.pipeline.drive import run_driving_stage

        workspace = open_workspace(self.workspace)
        run_driving_stage(
            workspace.run_dir(workspace.pick_run(self.run_name)), Path(self.by), self.out, self.picture,
            self.following(), sequence=self.sequence, fps=self.fps, neutral=self.neutral, capture=self.capture,
            alone=self.alone,
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Show(_Neutral, _Drive):
    """Play the motion of somebody else in a viewer in the browser. --out FILE.mp4 writes a film, with more options."""

    remedies: ClassVar[dict[str, str]] = {"--": "options of films need --out FILE.mp4"}
    port: Annotated[int, PORT] = 0
    """Port of the viewer. 0 means a free one."""

    def check(self) -> None:
        """Check options and paths without heavy libraries."""
        open_workspace(self.workspace).pick_run(self.run_name)
        check_viewer()
        check_driver(Path(self.by), None, None, self.capture)
        check_neutral(self.neutral)

    def run(self) -> None:
        """Show the avatar until Ctrl-C."""
        from mien.pipeline.view import run_viewing_stage

        run_viewing_stage(
            self.workspace, self.run_name, play=self.by, neutral=self.neutral, capture=self.capture, at_once=True,
            port=self.port,
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Follow(_Film, _Drive):
    """Make an avatar follow a camera, in a viewer in the browser."""

    remedies: ClassVar[dict[str, str]] = {"--": "options of recordings and videos are not for a camera"}
    out: Path | None = None
    """An .mp4 that records it."""
    camera_format: CameraFormat | None = None
    """The interface that reads the camera: v4l2 (Linux), avfoundation (macOS) or dshow (Windows). The default is the
    platform's."""
    port: Annotated[int, PORT] = 0
    """Port of the viewer. 0 means a free one."""

    def check(self) -> None:
        """Check options and paths without heavy libraries."""
        check_avatar(self.workspace, self.run_name)
        camera_named(self.by, self.camera_format)
        if self.out is None:
            check_viewer()
        elif self.picture.plan(self.out, 2).kind != "mp4":
            raise UserError(f"--out {self.out}: a camera is recorded as .mp4; choose such a name")

    def run(self) -> None:
        """Follow until Ctrl-C, or until the file of a camera ends."""
        from mien.pipeline.follow import run_following_stage

        camera, follow = camera_named(self.by, self.camera_format), self.following()
        port = self.port if has_viewer() else None
        run_following_stage(self.workspace, self.run_name, camera, follow, self.picture, self.out, self.alone, port)


def task_of(arguments: Sequence[str]) -> type:
    """Return the class of options by what drives the avatar, and where that is shown."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--by", nargs="?")
    parser.add_argument("--out", nargs="?")
    typed, _ = parser.parse_known_args(list(arguments))
    if is_camera(typed.by or ""):
        return Follow
    return Film if typed.out or not typed.by else Show
