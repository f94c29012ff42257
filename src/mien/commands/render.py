"""`mien render`: pictures of an avatar."""

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from mien.disk.config import Range
from mien.disk.workspace import Workspace, open_workspace
from mien.errors import UserError
from mien.machine.devices import DeviceName, check_device, choose_device, like_on
from mien.machine.progress import say, track_progress
from mien.pipeline.names import check_avatar
from mien.pipeline.picture_options import PictureOptions

if TYPE_CHECKING:
    import numpy

    import mien.avatar
    import mien.camera
    import mien.face

_PATHS = ("turntable", "orbit", "sway", "still", "captured")


@dataclass(frozen=True, kw_only=True)
class _Look:
    """Options that `render` and `render sheet` share: the avatar, its face, and the view."""

    workspace: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """Workspace folder."""
    run_name: Annotated[str | None, tyro.conf.arg(name="run")] = None
    """Name of the run (default: the only one)."""
    set: tuple[str, ...] = ()
    """Expressions and whole faces by name, and joint angles in radians, for example --set smile=0.6 jawOpen=0.3
    eyeLookUpLeft=0.5 left_eye_y=0.2 (default: the person's neutral). An unknown name lists all of them."""
    timestep: int | None = None
    """Show the face at this timestep (from 0) of what the run was trained on."""
    span: Annotated[float, Range(-3600, 3600)] = 40.0
    """Angle from end to end, in degrees. 360 goes all the way round. 40 is about what one camera films; sides that were
    not filmed are completed, or look broken if they were trained."""
    yaw: Annotated[float, Range(-180, 180)] = 0.0
    """Angle by which the camera moves around the head before anything else, in degrees: to the person's left, or to the
    right if negative."""
    pitch: Annotated[float, Range(-89, 89)] = 0.0
    """The same upwards, or downwards if negative."""
    zoom: Annotated[float | None, Range(0.01, 100)] = None
    """Magnification. 1 shows what the camera saw in training (default: as much as the head fits)."""
    device: DeviceName = "cpu"
    """Device that poses and draws: cpu, cuda (an NVIDIA GPU, through gsplat), or auto (a GPU if there is one)."""
    picture: Annotated[PictureOptions, tyro.conf.arg(name="")] = field(default_factory=PictureOptions)

    def turned(self, camera: "mien.camera.Camera", subject: "mien.face.FaceParams") -> "mien.camera.Camera":
        """A camera moved by --yaw and --pitch."""
        from mien.render.camera_paths import turned_camera

        return turned_camera(camera, subject.head_translation[0], math.radians(self.yaw), math.radians(self.pitch))


@dataclass(frozen=True, kw_only=True)
class Render(_Look):
    """Render an avatar: a still, or a video along a camera path, at any expression or with a sequence's motion.

    mien render sheet DIR KIND: many pictures in one, each with its name.
    """

    workspace: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """Workspace folder, or a .mien file, which is drawn without torch."""
    timestep: int | None = None
    """Show the face at this timestep (from 0) of --motion, or of what the run was trained on."""
    zoom: Annotated[float | None, Range(0.01, 100)] = None
    """Magnification. 1 shows what the camera saw in training (default: 1, or less if that cuts off the head)."""
    out: Path
    """Output: .png for a still, a folder or NAME_%06d.png for numbered pictures, .mp4 or .webm for a video."""
    path: str = "turntable"
    """Path of the camera: to both sides (turntable), an oval (orbit), a figure eight (sway), no motion (still), from
    camera to camera of the capture (captured), or a json file of cameras, one per frame (docs/using.md), which keep
    their own sizes. A .png is always a still."""
    frames: Annotated[int, Range(1, 1_000_000)] = 120
    """Number of frames of the video."""
    fps: Annotated[float, Range(1e-9, 1000, words="a number above 0, at most 1000")] = 25.0
    """Frames per second of the video."""
    motion: str | None = None
    """A sequence whose motion the avatar plays, one frame per timestep, or own: the motion that the run was trained on
    or imported with, its sequences one after the other (`mien drive` can do more)."""

    def check(self) -> None:
        """Check options and paths without heavy libraries."""
        check_device(self.device)
        self.picture.color()
        if self.path not in _PATHS and not self._is_listed():
            raise UserError(f"--path {self.path}: give one of {', '.join(_PATHS)}, or a .json of cameras")
        check_avatar(self.workspace, self.run_name)
        if self.workspace.is_file():
            of_runs = {"--motion": self.motion is not None, "--timestep": self.timestep is not None}
            of_runs |= {f"--path {self.path}": self._is_listed() or self.path == "captured"}
            for option, given in (of_runs | {"--device": self.device != "cpu"}).items():
                if given:
                    raise UserError(f"{option}: is for runs, and {self.workspace} is a file; leave it out")
        elif self._sequence is not None or self.path == "captured":
            open_workspace(self.workspace).pick_sequence(self._sequence)
        if self._sequence is None and self.motion is None and not self._is_listed() and self.path != "captured":
            self.picture.plan(self.out, self._frames(None))

    def run(self) -> None:
        """Pose and render frame by frame, after a check of everything that depends on files."""
        if self.workspace.is_file():
            self._draw_file()
            return
        from mien.avatar.avatar import move_avatar
        from mien.avatar.files import load_avatar
        from mien.media.writing import write_pictures
        from mien.pipeline.draw import draw, posed_softly, sides_filmed, warn_of_white
        from mien.pipeline.expression import chosen_face
        from mien.training.footage.sequence import read_sequence
        from mien.training.run import read_face_track

        workspace = open_workspace(self.workspace)
        run_dir = workspace.run_dir(workspace.pick_run(self.run_name))
        avatar, motion = load_avatar(run_dir), None
        if self.motion == "own":
            motion = read_face_track(run_dir, avatar.face_model)
        elif self.motion is not None:
            motion = read_sequence(workspace.sequence_dir(self.motion)).tracking.face
        face = chosen_face(run_dir, avatar, motion, self.timestep, self.set)
        moves = motion is not None and self.timestep is None
        cameras = self._cameras(workspace, run_dir, avatar, face, len(face) if moves else None)
        output = self.picture.plan(self.out, len(cameras))
        warn_of_white(self.picture, run_dir, avatar)
        sides = sides_filmed(run_dir, avatar)
        like = like_on(choose_device(self.device))
        move_avatar(avatar, like)
        face, pose = face.to(like), posed_softly(avatar)
        still = None if moves else pose(face)

        def picture(index: int) -> "numpy.ndarray":
            return draw(self.picture, still or pose(face[index]), cameras[index], avatar.extras.closing)

        pictures = (picture(index) for index in range(len(cameras)))
        shown = pictures if output.kind == "still" else track_progress(pictures, "Rendering", len(cameras))
        write_pictures(output, shown, self.fps)
        count, first = len(avatar.store), cameras[0]
        say(f"{self.out}: {count:,} Gaussians at {first.width}x{first.height}, frames: {len(cameras)}")
        if sides is not None:
            say(sides)

    @property
    def _sequence(self) -> str | None:
        return None if self.motion == "own" else self.motion

    def _cameras(
        self,
        workspace: Workspace,
        run_dir: Path,
        avatar: "mien.avatar.Avatar",
        face: "mien.face.FaceParams",
        timesteps: int | None,
    ) -> "list[mien.camera.Camera]":
        """The camera of each frame."""
        from mien.pipeline.draw import posed_softly, whole
        from mien.render.camera_paths import read_cameras, turned_camera
        from mien.tracking.files import read_tracking
        from mien.training.run import run_camera

        if self._is_listed():
            cameras = read_cameras(Path(self.path))
            if timesteps is not None and len(cameras) < timesteps:
                raise UserError(f"{self.path}: has {len(cameras)} cameras for {timesteps} timesteps; give one for each")
            if any((c.width, c.height) != (cameras[0].width, cameras[0].height) for c in cameras):
                raise UserError(f"{self.path}: has cameras of different sizes; give all the same size")
            cameras = cameras[:timesteps]
        elif self.path == "captured":
            name = workspace.pick_sequence(self._sequence)
            stored = read_tracking(workspace.sequence_dir(name) / "tracking").cameras
            cameras = [camera.fitted(*self.picture.shape(), self.zoom or 1.0) for camera in stored]
            if self._is_still():
                cameras = cameras[:1]
            elif timesteps is not None:
                cameras = [cameras[index * len(cameras) // timesteps] for index in range(timesteps)]
        else:
            first = run_camera(run_dir).fitted(*self.picture.shape(), self.zoom or 1.0)
            first = self.turned(first, avatar.subject)
            first = whole(first, posed_softly(avatar)(face[0])) if self.zoom is None else first
            center = avatar.subject.head_translation[0]
            return [turned_camera(first, center, *angles) for angles in self._angles(self._frames(timesteps))]
        return [self.turned(camera, avatar.subject) for camera in cameras] if self.yaw or self.pitch else cameras

    def _draw_file(self) -> None:
        """Draw the avatar of a file, without torch."""
        from mien.pipeline.draw_file import render_file
        from mien.runtime.camera_paths import turned

        frames = self._frames(None)
        angles = self._angles(frames)
        render_file(
            self.workspace, self.picture.plan(self.out, frames), self.picture, self.set, self.yaw, self.pitch,
            self.zoom, lambda camera, at: [turned(camera, at, *each) for each in angles], self.fps,
        )  # fmt: skip

    def _angles(self, frames: int) -> list[tuple[float, float]]:
        """Yaw and pitch of the camera of --path in each frame, in radians."""
        from mien.runtime.camera_paths import sway, turntable

        span = math.radians(self.span)
        if self.path == "still" or self._is_still():
            return [(0.0, 0.0)] * frames
        if self.path == "turntable":
            return turntable(frames, span)
        tilt = math.radians(15)  # up and down
        return sway(frames, span, tilt, crossing=self.path == "sway")

    def _is_listed(self) -> bool:
        """Whether the cameras come from a file."""
        return Path(self.path).suffix.lower() == ".json"

    def _is_still(self) -> bool:
        return self.out.suffix.lower() == ".png" and "%" not in self.out.name

    def _frames(self, timesteps: int | None) -> int:
        return timesteps or (1 if self._is_still() else self.frames)


@dataclass(frozen=True, kw_only=True)
class Sheet(_Look):
    """Draw many pictures in one .png, each with its name.

    They are every expression at --strength (expressions), every expression at --strength times the most that was filmed
    (filmed), the preset faces of pages, also from aside (presets), or sides of the head, --span degrees from end to end
    (turntable). --size is that of one of them (default: 288, and 512 for sides).
    """

    kind: Annotated[Literal["expressions", "filmed", "presets", "turntable"], tyro.conf.Positional]
    """What the pictures show."""
    out: Path | None = None
    """The .png (default: sheet_KIND.png in the run's folder)."""
    strength: Annotated[float, Range(0, 3)] = 1.0
    """Strength of the expressions."""

    def check(self) -> None:
        """Check options and paths without heavy libraries."""
        check_device(self.device)
        open_workspace(self.workspace).pick_run(self.run_name)
        if self._output.suffix.lower() != ".png" or "%" in self._output.name:
            raise UserError(f"{self._output}: a sheet is one picture; give --out NAME.png")
        if self.picture.background == "transparent":
            raise UserError("--background transparent: a sheet has no transparency; choose a colour")
        self.picture.plan(self._output, 1)

    def run(self) -> None:
        """Draw the sheet."""
        from mien.avatar.avatar import move_avatar
        from mien.avatar.files import load_avatar
        from mien.media.writing import write_pictures
        from mien.pipeline import sheets
        from mien.pipeline.draw import draw, posed_softly, sides_filmed
        from mien.pipeline.expression import chosen_face
        from mien.training.run import filmed_range, run_camera

        workspace = open_workspace(self.workspace)
        run_dir = workspace.run_dir(workspace.pick_run(self.run_name))
        avatar, options = load_avatar(run_dir), self.picture
        face, model = chosen_face(run_dir, avatar, None, self.timestep, self.set), avatar.face_model
        if self.kind != "turntable" and options.size is None:
            options = replace(options, size=sheets.SMALL_TILE)
        camera = run_camera(run_dir).fitted(*options.shape(), self.zoom or 1.0)
        camera = self.turned(camera, avatar.subject)
        if self.kind == "turntable":
            tiles = sheets.turntable_tiles(face, camera, avatar.subject.head_translation[0], self.span)
        elif self.kind == "filmed":
            tiles = sheets.filmed_tiles(model, face, camera, filmed_range(run_dir, avatar), self.strength)
        elif self.kind == "presets":
            middle = avatar.subject.head_translation[0]
            tiles = sheets.preset_tiles(model, face, camera, middle, filmed_range(run_dir, avatar))
        else:
            tiles = sheets.expression_tiles(model, face, camera, self.strength)
        sides = sides_filmed(run_dir, avatar) if self.kind == "turntable" else None
        like = like_on(choose_device(self.device))
        move_avatar(avatar, like)
        pose = posed_softly(avatar)

        def picture(face: "mien.face.FaceParams", camera: "mien.camera.Camera") -> "numpy.ndarray":
            return draw(self.picture, pose(face.to(like)), camera, avatar.extras.closing)

        red, green, blue = (round(255 * value) for value in self.picture.color())
        if self.zoom is None:
            tiles = sheets.nearer_tiles(tiles, picture, (red, green, blue))
        output = self.picture.plan(self._output, 1)
        write_pictures(output, [sheets.draw_sheet(tiles, picture, (red, green, blue))], 25.0)
        say(f"{self._output}: {len(tiles)} pictures of {len(avatar.store):,} Gaussians")
        if sides is not None:
            say(sides)

    @property
    def _output(self) -> Path:
        """The path to write."""
        workspace = open_workspace(self.workspace)
        return self.out or workspace.run_dir(workspace.pick_run(self.run_name)) / f"sheet_{self.kind}.png"


TASKS = {"": Render, "sheet": Sheet}
