"""`mien render`: pictures of an avatar."""

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from mien.disk.workspace import Workspace, open_workspace
from mien.errors import UserError
from mien.machine.devices import DeviceName, check_device, choose_device, like_on
from mien.pipeline.names import check_avatar
from mien.pipeline.picture_options import PictureOptions

if TYPE_CHECKING:
    import numpy

    import mien.avatar
    import mien.camera
    import mien.face

_PATHS = ("turntable", "orbit", "sway", "still", "captured")
_TILT = math.radians(15)
"""Angle that orbit and sway go up and down."""
_MAX_STRENGTH = 3.0


@dataclass(frozen=True, kw_only=True)
class _Look:
    """Options that `render` and `render sheet` share: the avatar, its face, and the view."""

    workspace: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """Workspace folder. Without sheets also a .mien file, which is drawn without torch."""
    run_name: Annotated[str | None, tyro.conf.arg(name="run")] = None
    """Name of the run (default: the only one)."""
    set: tuple[str, ...] = ()
    """Expressions and whole faces by name, and joint angles in radians, for example --set smile=0.6 jawOpen=0.3
    eyeLookUpLeft=0.5 left_eye_y=0.2 (default: the person's neutral). An unknown name lists all of them."""
    timestep: int | None = None
    """Show the face at this timestep (from 0) of --motion, or of what the run was trained on."""
    span: float = 40.0
    """Angle from end to end of a turntable, or that the camera swings through, in degrees. 360 goes all the way round.
    40 is about what one camera films; sides that were not filmed are made up, or look broken if they were trained."""
    yaw: float = 0.0
    """Angle by which the camera moves around the head before anything else, in degrees: to the person's left, or to the
    right if negative."""
    pitch: float = 0.0
    """The same upwards, or downwards if negative."""
    zoom: float | None = None
    """Magnification. 1 shows what the camera saw in training (default: 1, or less if that cuts off the head; on a sheet
    as much as the head fits)."""
    device: DeviceName = "cpu"
    """Device that poses and draws: cpu, cuda (an NVIDIA GPU, through gsplat), or auto (a GPU if there is one)."""
    picture: Annotated[PictureOptions, tyro.conf.arg(name="")] = field(default_factory=PictureOptions)

    def _check_look(self) -> None:
        """Check numbers and the device without heavy libraries."""
        check_device(self.device)
        self.picture.color()
        if not 0.01 <= self.magnification <= 100:
            raise UserError(f"--zoom {self.magnification:g}: give a number from 0.01 to 100")
        if not math.isfinite(self.span):
            raise UserError(f"--span {self.span:g}: give a number of degrees")
        for name, angle, limit in (("yaw", self.yaw, 180), ("pitch", self.pitch, 89)):
            if not abs(angle) <= limit:
                raise UserError(f"--{name} {angle:g}: give degrees between -{limit} and {limit}")

    @property
    def magnification(self) -> float:
        """The magnification, 1 by default."""
        return 1.0 if self.zoom is None else self.zoom

    def camera(self, run_dir: Path, subject: "mien.face.FaceParams", options: PictureOptions) -> "mien.camera.Camera":
        """The run's first camera, moved by --yaw, --pitch and --zoom."""
        from mien.pipeline.draw import view
        from mien.training.run import run_camera

        return self.turned(view(options, run_camera(run_dir), self.magnification), subject)

    def turned(self, camera: "mien.camera.Camera", subject: "mien.face.FaceParams") -> "mien.camera.Camera":
        """A camera moved by --yaw and --pitch."""
        from mien.render.camera_paths import turned_camera

        return turned_camera(camera, subject.head_translation[0], math.radians(self.yaw), math.radians(self.pitch))

    def face(
        self, run_dir: Path, avatar: "mien.avatar.Avatar", motion: "mien.face.FaceParams | None"
    ) -> "mien.face.FaceParams":
        """The face of a motion, at --timestep or at rest, changed by --set. What was never filmed is told."""
        from mien.face.checks import check_face_params
        from mien.pipeline.expression import tell_of_unfilmed, with_expression
        from mien.training.run import filmed_range, read_face_track

        model, subject = avatar.face_model, avatar.subject
        if self.timestep is not None:
            motion = read_face_track(run_dir, model) if motion is None else motion
            if not 0 <= self.timestep < len(motion):
                last = len(motion) - 1
                raise UserError(f"--timestep {self.timestep}: {run_dir} has the timesteps 0 to {last}; give one")
            motion = motion[self.timestep]
        face = subject if motion is None else motion
        face = replace(face, identity=subject.identity, vertex_offsets=subject.vertex_offsets)
        check_face_params(model, face, "--motion", "choose a sequence that was tracked with the avatar's face model")
        face = with_expression(face, model, self.set)
        if self.set:
            tell_of_unfilmed(self.set, face, model, filmed_range(run_dir, avatar))
        return face


@dataclass(frozen=True, kw_only=True)
class Render(_Look):
    """Render an avatar: a still, or a video along a camera path, at any expression or with a sequence's motion.

    mien render sheet DIR KIND: many pictures in one, each with its name.
    """

    out: Path
    """Output: .png for a still, a folder or NAME_%06d.png for numbered pictures, .mp4 or .webm for a video."""
    path: str = "turntable"
    """Path of the camera: to both sides (turntable), an oval (orbit), a figure eight (sway), no motion (still), from
    camera to camera of the capture (captured), or a json file of cameras, one per frame (docs/using.md), which keep
    their own sizes. A .png is always a still."""
    frames: int = 120
    """Number of frames of the video."""
    fps: float = 25.0
    """Frames per second of the video."""
    motion: str | None = None
    """A sequence whose motion the avatar plays, one frame per timestep, or own: the motion that the run was trained on
    or imported with, its sequences one after the other (`mien drive` can do more)."""

    def check(self) -> None:
        """Check options and paths without heavy libraries."""
        self._check_look()
        if self.frames < 1:
            raise UserError(f"--frames {self.frames}: give 1 or more")
        if not 0 < self.fps <= 1000:
            raise UserError(f"--fps {self.fps:g}: give a number above 0, at most 1000")
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
        from mien.machine.progress import say, track_progress
        from mien.media.writing import write_pictures
        from mien.pipeline.draw import draw, posed_softly, sides_filmed, warn_of_white

        workspace = open_workspace(self.workspace)
        run_dir = workspace.run_dir(workspace.pick_run(self.run_name))
        avatar = load_avatar(run_dir)
        motion = self._motion(workspace, run_dir, avatar.face_model)
        face = self.face(run_dir, avatar, motion)
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

    def _motion(
        self, workspace: Workspace, run_dir: Path, model: "mien.face.FaceModel"
    ) -> "mien.face.FaceParams | None":
        from mien.training.footage.sequence import read_sequence
        from mien.training.run import read_face_track

        if self.motion == "own":
            return read_face_track(run_dir, model)
        return None if self.motion is None else read_sequence(workspace.sequence_dir(self.motion)).tracking.face

    def _cameras(
        self,
        workspace: Workspace,
        run_dir: Path,
        avatar: "mien.avatar.Avatar",
        face: "mien.face.FaceParams",
        timesteps: int | None,
    ) -> "list[mien.camera.Camera]":
        """The camera of each frame."""
        from mien.pipeline.draw import posed_softly, view, whole
        from mien.render.camera_paths import read_cameras, turned_camera
        from mien.tracking.files import read_tracking

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
            cameras = [view(self.picture, camera, self.magnification) for camera in stored]
            if self._is_still():
                cameras = cameras[:1]
            elif timesteps is not None:
                cameras = [cameras[index * len(cameras) // timesteps] for index in range(timesteps)]
        else:
            first = self.camera(run_dir, avatar.subject, self.picture)
            first = whole(first, posed_softly(avatar)(face[0])) if self.zoom is None else first
            center = avatar.subject.head_translation[0]
            return [turned_camera(first, center, *angles) for angles in self._angles(self._frames(timesteps))]
        return [self.turned(camera, avatar.subject) for camera in cameras] if self.yaw or self.pitch else cameras

    def _draw_file(self) -> None:
        """Draw the avatar of a file, without torch."""
        from mien.pipeline.draw_file import View, render_file
        from mien.runtime.camera_paths import turned

        frames = self._frames(None)
        angles = self._angles(frames)
        view = View(self.yaw, self.pitch, self.zoom, lambda camera, at: [turned(camera, at, *each) for each in angles])
        render_file(self.workspace, self.picture.plan(self.out, frames), self.picture, self.set, view, self.fps)

    def _angles(self, frames: int) -> list[tuple[float, float]]:
        """Yaw and pitch of the camera of --path in each frame, in radians."""
        from mien.runtime.camera_paths import sway, turntable

        span = math.radians(self.span)
        if self.path == "still" or self._is_still():
            return [(0.0, 0.0)] * frames
        if self.path == "turntable":
            return turntable(frames, span)
        return sway(frames, span, _TILT, crossing=self.path == "sway")

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
    (filmed), or sides of the head, --span degrees from end to end (turntable). --size is that of one of them (default:
    288, and 512 for sides).
    """

    kind: Annotated[Literal["expressions", "filmed", "turntable"], tyro.conf.Positional]
    """What the pictures show."""
    out: Path | None = None
    """The .png (default: sheet_KIND.png in the run's folder)."""
    strength: float = 1.0
    """Strength of the expressions, from 0 to 3."""

    def check(self) -> None:
        """Check options and paths without heavy libraries."""
        self._check_look()
        open_workspace(self.workspace).pick_run(self.run_name)
        if self._output.suffix.lower() != ".png" or "%" in self._output.name:
            raise UserError(f"{self._output}: a sheet is one picture; give --out NAME.png")
        if not 0 <= self.strength <= _MAX_STRENGTH:
            raise UserError(f"--strength {self.strength:g}: give a number from 0 to {_MAX_STRENGTH:g}")
        if self.picture.background == "transparent":
            raise UserError("--background transparent: a sheet has no transparency; choose a colour")
        self.picture.plan(self._output, 1)

    def run(self) -> None:
        """Draw the sheet."""
        from mien.avatar.avatar import move_avatar
        from mien.avatar.files import load_avatar
        from mien.machine.progress import say
        from mien.media.writing import write_pictures
        from mien.pipeline import sheets
        from mien.pipeline.draw import draw, posed_softly, sides_filmed
        from mien.training.run import filmed_range

        workspace = open_workspace(self.workspace)
        run_dir = workspace.run_dir(workspace.pick_run(self.run_name))
        avatar, options = load_avatar(run_dir), self.picture
        face, model = self.face(run_dir, avatar, None), avatar.face_model
        if self.kind != "turntable" and options.size is None:
            options = replace(options, size=sheets.SMALL_TILE)
        camera = self.camera(run_dir, avatar.subject, options)
        if self.kind == "turntable":
            tiles = sheets.turntable_tiles(face, camera, avatar.subject.head_translation[0], self.span)
        elif self.kind == "filmed":
            tiles = sheets.filmed_tiles(model, face, camera, filmed_range(run_dir, avatar), self.strength)
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
