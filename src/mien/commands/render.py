"""`mien render`: pictures of an avatar."""

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from mien.disk.workspace import Workspace, open_workspace
from mien.errors import UserError
from mien.machine.devices import DeviceName, check_device, choose_device, like_on
from mien.pipeline.names import check_avatar
from mien.pipeline.picture_options import PictureOptions

if TYPE_CHECKING:
    import numpy
    import torch

    import mien.avatar
    import mien.camera
    import mien.face
    import mien.media.output
    import mien.runtime


_MAX_STRENGTH = 3.0


@dataclass(frozen=True)
class Command:
    """Render an avatar: a still, or a video along a camera path, at any expression or with a sequence's motion."""

    workspace: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """Workspace folder, or a .mien file, which is drawn without torch."""
    out: Path | None = None
    """Output: .png for a still, a folder or NAME_%06d.png for numbered pictures, .mp4 or .webm for a video (only for
    sheets, default: sheet_NAME.png in the run's folder)."""
    run_name: Annotated[str | None, tyro.conf.arg(name="run")] = None
    """Name of the run (default: the only one)."""
    set: tuple[str, ...] = ()
    """Expressions and whole faces by name, and joint angles in radians, for example --set smile=0.6 jawOpen=0.3
    eyeLookUpLeft=0.5 left_eye_y=0.2 (default: the person's neutral). An unknown name lists all of them."""
    path: Literal["turntable", "orbit", "sway", "still", "captured"] = "turntable"
    """Path of the camera: to both sides (turntable), an oval (orbit), a figure eight (sway), no motion (still), or from
    camera to camera of the capture (captured). A .png is always a still."""
    sheet: Literal["none", "expressions", "filmed", "turntable"] = "none"
    """Many pictures in one .png, each with its name: every expression at --strength (expressions), every expression at
    --strength times the most that was filmed (filmed), or sides of the head, --span degrees from end to end
    (turntable). --size is that of one of them (default: 288, and 512 for sides)."""
    strength: float = 1.0
    """Strength of the expressions on a sheet, from 0 to 3."""
    cameras: Path | None = None
    """A json file of cameras, one per frame (format: docs/using.md), instead of --path. The cameras keep their own
    sizes."""
    frames: int = 120
    """Number of frames of the video."""
    fps: float = 25.0
    """Frames per second of the video."""
    span: float = 40.0
    """Angle that the camera swings through, in degrees, up to 360, which goes all the way round. 40 is about what one
    camera films; sides that were not filmed are made up, or look broken if they were trained."""
    tilt: float = 15.0
    """Angle that orbit and sway go up and down, in degrees."""
    yaw: float = 0.0
    """Angle by which the camera moves around the head before anything else, in degrees: to the person's left, or to the
    right if negative."""
    pitch: float = 0.0
    """The same upwards, or downwards if negative."""
    zoom: float | None = None
    """Magnification. 1 shows what the camera saw in training (default: 1, or less if that cuts off the head; on a sheet
    as much as the head fits)."""
    sequence: str | None = None
    """Name of a sequence whose motion the avatar plays, one frame per timestep (`mien drive` can do more)."""
    own_motion: bool = False
    """Play the motion that the run was trained on or imported with: its sequences one after the other, one frame per
    timestep."""
    timestep: int | None = None
    """Show the face at this timestep of that motion (from 0) instead of the person's neutral."""
    device: DeviceName = "cpu"
    """Device that poses and draws: cpu, cuda (an NVIDIA GPU, through gsplat), or auto (a GPU if there is one)."""
    picture: Annotated[PictureOptions, tyro.conf.arg(name="")] = field(default_factory=PictureOptions)

    def check(self) -> None:
        """Check options and paths without heavy libraries."""
        check_device(self.device)
        self.picture.color()
        if self._is_file():
            self._check_file()
            return
        workspace = open_workspace(self.workspace)
        workspace.pick_run(self.run_name)
        if self.sequence is not None or (self.path == "captured" and self.cameras is None):
            workspace.pick_sequence(self.sequence)
        self._check_numbers()
        if self.sheet != "none":
            self._check_sheet()
        if sum((self.sequence is not None, self.own_motion, self.timestep is not None)) > 1:
            raise UserError("--sequence, --own-motion and --timestep: give only one of them")
        if self.sequence is None and not self.own_motion and self.cameras is None and self.path != "captured":
            self.picture.plan(self._output, self._frames(None))

    def run(self) -> None:
        """Pose and render frame by frame, after a check of everything that depends on files."""
        if self._is_file():
            self._draw_file()
            return
        from mien.avatar.avatar import move_avatar
        from mien.avatar.files import load_avatar
        from mien.face.checks import check_face_params
        from mien.machine.progress import say, track_progress
        from mien.media.writing import write_pictures
        from mien.pipeline.draw import draw, posed_softly, warn_of_white, whole
        from mien.pipeline.expression import tell_of_unfilmed, with_expression
        from mien.training.footage.filmed import filmed_words, read_coverage
        from mien.training.run import filmed_range

        workspace = open_workspace(self.workspace)
        run_dir = workspace.run_dir(workspace.pick_run(self.run_name))
        avatar = load_avatar(run_dir)
        covered = read_coverage(run_dir, avatar.face_model)
        neutral = avatar.face_model.head_vertices(avatar.subject)[0].detach()
        motion = self._motion(workspace, run_dir, avatar.face_model)
        timesteps = None if motion is None else len(motion)
        cameras = self._given_cameras(workspace, timesteps)
        output = self.picture.plan(self._output, self._frames(timesteps) if cameras is None else len(cameras))
        warn_of_white(self.picture, run_dir, avatar)
        subject = avatar.subject
        face = motion or self._chosen_timestep(run_dir, avatar.face_model) or subject
        face = replace(face, identity=subject.identity, vertex_offsets=subject.vertex_offsets)
        told = "choose a sequence that was tracked with the avatar's face model"
        check_face_params(avatar.face_model, face, f"--sequence {self.sequence}", told)
        face = with_expression(face, avatar.face_model, self.set)
        if self.set:
            tell_of_unfilmed(self.set, face, avatar.face_model, filmed_range(run_dir, avatar))
        if self.sheet != "none":
            self._draw_sheet(run_dir, avatar, face, output)
            if self.sheet == "turntable" and covered is not None:
                say(filmed_words(avatar.face_model.to(neutral), neutral, covered))
            return
        if cameras is None:
            first = whole(self._camera(run_dir, subject), posed_softly(avatar)(face[0])) if self.zoom is None else None
            first = first or self._camera(run_dir, subject)
            cameras = self._path(first, subject.head_translation[0], self._frames(timesteps))
        like = like_on(choose_device(self.device))
        move_avatar(avatar, like)
        face = face.to(like)
        pose = posed_softly(avatar)
        still = None if motion is not None else pose(face)

        def picture(index: int) -> "numpy.ndarray":
            return draw(self.picture, still or pose(face[index]), cameras[index], avatar.extras.closing)

        pictures = (picture(index) for index in range(len(cameras)))
        shown = pictures if output.kind == "still" else track_progress(pictures, "Rendering", len(cameras))
        write_pictures(output, shown, self.fps)
        count, first = len(avatar.gaussian_store()), cameras[0]
        say(f"{self._output}: {count:,} Gaussians at {first.width}x{first.height}, frames: {len(cameras)}")
        if covered is not None:
            say(filmed_words(avatar.face_model.to(neutral), neutral, covered))

    def _motion(
        self, workspace: Workspace, run_dir: Path, model: "mien.face.FaceModel"
    ) -> "mien.face.FaceParams | None":
        """The motion of --sequence or --own-motion."""
        from mien.training.footage.sequence import read_sequence
        from mien.training.run import read_face_track

        if self.sequence is not None:
            return read_sequence(workspace.sequence_dir(workspace.pick_sequence(self.sequence))).tracking.face
        return read_face_track(run_dir, model) if self.own_motion else None

    @property
    def _output(self) -> Path:
        """Return the path to write: --out, or that of a sheet in the run's folder."""
        if self.out is not None:
            return self.out
        if self.sheet == "none" or self._is_file():
            raise UserError("--out: is missing; give a name, such as turntable.mp4 or still.png")
        workspace = open_workspace(self.workspace)
        return workspace.run_dir(workspace.pick_run(self.run_name)) / f"sheet_{self.sheet}.png"

    @property
    def _magnification(self) -> float:
        return 1.0 if self.zoom is None else self.zoom

    def _is_file(self) -> bool:
        """Whether the avatar comes from a file."""
        return self.workspace.suffix.lower() == ".mien" and not self.workspace.is_dir()

    def _check_file(self) -> None:
        """Refuse what only a run has."""
        check_avatar(self.workspace, self.run_name)
        runs_own = {
            "--sequence": self.sequence is not None,
            "--own-motion": self.own_motion,
            "--timestep": self.timestep is not None,
            "--sheet": self.sheet != "none",
            "--cameras": self.cameras is not None,
            "--path captured": self.path == "captured",
            "--device": self.device != "cpu",
        }
        for option, given in runs_own.items():
            if given:
                raise UserError(
                    f"{option}: is for runs, and {self.workspace} is a file; leave it out, or give a workspace"
                )
        self._check_numbers()
        self.picture.plan(self._output, self._frames(None))

    def _draw_file(self) -> None:
        """Draw the avatar of a file, without torch."""
        from mien.pipeline.draw_file import View, render_file

        frames = self._frames(None)
        view = View(self.yaw, self.pitch, self.zoom, lambda camera, center: self._file_path(camera, center, frames))
        render_file(self.workspace, self.picture.plan(self._output, frames), self.picture, self.set, view, self.fps)

    def _file_path(
        self, camera: "mien.runtime.Camera", center: "numpy.ndarray", frames: int
    ) -> "list[mien.runtime.Camera]":
        from mien.runtime import camera_paths

        return self._moved(camera_paths, camera, center, frames)

    def _moved(self, paths: Any, camera: Any, center: Any, frames: int) -> list[Any]:
        """The cameras of --path, by the module that moves cameras of this type."""
        span, tilt = math.radians(self.span), math.radians(self.tilt)
        if self.path == "still" or self._is_still():
            return [camera] * frames
        if self.path == "turntable":
            return paths.turntable(camera, center, frames, span)
        return paths.sway(camera, center, frames, span, tilt, crossing=self.path == "sway")

    def _camera(self, run_dir: Path, subject: "mien.face.FaceParams") -> "mien.camera.Camera":
        """The run's first camera, moved by --yaw, --pitch and --zoom."""
        from mien.pipeline.draw import view
        from mien.pipeline.sheets import SMALL_TILE
        from mien.render.camera_paths import turned_camera
        from mien.training.run import run_camera

        options = self.picture
        if self.sheet in ("expressions", "filmed") and options.size is None:
            options = replace(options, size=SMALL_TILE)
        camera, center = view(options, run_camera(run_dir), self._magnification), subject.head_translation[0]
        return turned_camera(camera, center, math.radians(self.yaw), math.radians(self.pitch))

    def _draw_sheet(
        self,
        run_dir: Path,
        avatar: "mien.avatar.Avatar",
        face: "mien.face.FaceParams",
        output: "mien.media.output.Output",
    ) -> None:
        from mien.avatar.avatar import move_avatar
        from mien.machine.progress import say
        from mien.media.writing import write_pictures
        from mien.pipeline.draw import draw, posed_softly
        from mien.pipeline.sheets import draw_sheet, expression_tiles, filmed_tiles, nearer_tiles, turntable_tiles
        from mien.training.run import filmed_range

        camera, model = self._camera(run_dir, avatar.subject), avatar.face_model
        if self.sheet == "turntable":
            tiles = turntable_tiles(face, camera, avatar.subject.head_translation[0], self.span)
        elif self.sheet == "filmed":
            tiles = filmed_tiles(model, face, camera, filmed_range(run_dir, avatar), self.strength)
        else:
            tiles = expression_tiles(model, face, camera, self.strength)
        like = like_on(choose_device(self.device))
        move_avatar(avatar, like)
        pose = posed_softly(avatar)

        def picture(face: "mien.face.FaceParams", camera: "mien.camera.Camera") -> "numpy.ndarray":
            return draw(self.picture, pose(face.to(like)), camera, avatar.extras.closing)

        red, green, blue = (round(255 * value) for value in self.picture.color())
        if self.zoom is None:
            tiles = nearer_tiles(tiles, picture, (red, green, blue))
        write_pictures(output, [draw_sheet(tiles, picture, (red, green, blue))], self.fps)
        say(f"{self._output}: {len(tiles)} pictures of {len(avatar.gaussian_store()):,} Gaussians")

    def _chosen_timestep(self, run_dir: Path, face_model: "mien.face.FaceModel") -> "mien.face.FaceParams | None":
        """The face at --timestep, or None without that option."""
        from mien.training.run import read_face_track

        if self.timestep is None:
            return None
        face = read_face_track(run_dir, face_model)
        if not 0 <= self.timestep < len(face):
            raise UserError(f"--timestep {self.timestep}: {run_dir} has the timesteps 0 to {len(face) - 1}; give one")
        return face[self.timestep]

    def _check_numbers(self) -> None:
        if self.frames < 1:
            raise UserError(f"--frames {self.frames}: give 1 or more")
        if not 0 < self.fps <= 1000:
            raise UserError(f"--fps {self.fps:g}: give a number above 0, at most 1000")
        if not 0.01 <= self._magnification <= 100:
            raise UserError(f"--zoom {self._magnification:g}: give a number from 0.01 to 100")
        if not math.isfinite(self.span):
            raise UserError(f"--span {self.span:g}: give a number of degrees")
        for name, angle, limit in (("yaw", self.yaw, 180), ("pitch", self.pitch, 89)):
            if not abs(angle) <= limit:
                raise UserError(f"--{name} {angle:g}: give degrees between -{limit} and {limit}")
            fixed = "--cameras" if self.cameras is not None else "--path captured" if self.path == "captured" else ""
            if angle and fixed:
                raise UserError(f"--{name} {angle:g}: moves a camera of mien's own; leave it out, or leave out {fixed}")
        if not abs(self.tilt) < 180:
            raise UserError(f"--tilt {self.tilt:g}: give degrees between -180 and 180")

    def _check_sheet(self) -> None:
        """Refuse what does not go with a sheet."""
        if self._output.suffix.lower() != ".png" or not self._is_still():
            raise UserError(f"{self._output}: a sheet is one picture; give --out NAME.png")
        if not 0 <= self.strength <= _MAX_STRENGTH:
            raise UserError(f"--strength {self.strength:g}: give a number from 0 to {_MAX_STRENGTH:g}")
        if self.picture.background == "transparent":
            raise UserError("--background transparent: a sheet has no transparency; choose a colour")
        moving = {"--sequence": self.sequence is not None, "--own-motion": self.own_motion}
        moving |= {"--cameras": self.cameras is not None, "--path captured": self.path == "captured"}
        for name, given in moving.items():
            if given:
                raise UserError(f"--sheet {self.sheet}: shows one face from a camera of mien's own; leave out {name}")

    def _is_still(self) -> bool:
        return self._output.suffix.lower() == ".png" and "%" not in self._output.name

    def _frames(self, timesteps: int | None) -> int:
        return timesteps or (1 if self._is_still() else self.frames)

    def _given_cameras(self, workspace: Workspace, timesteps: int | None) -> "list[mien.camera.Camera] | None":
        """Cameras that do not depend on the avatar, one per frame, or None for a path around its head."""
        from mien.pipeline.draw import view
        from mien.render.camera_paths import read_cameras
        from mien.tracking.files import read_tracking

        if self.cameras is not None:
            cameras = read_cameras(self.cameras)
            if timesteps is not None and len(cameras) < timesteps:
                raise UserError(
                    f"{self.cameras}: has {len(cameras)} cameras for {timesteps} timesteps; give one for each"
                )
            if any((c.width, c.height) != (cameras[0].width, cameras[0].height) for c in cameras):
                raise UserError(f"{self.cameras}: has cameras of different sizes; give all the same size")
            return cameras[:timesteps]
        if self.path != "captured":
            return None
        name = workspace.pick_sequence(self.sequence)
        stored = read_tracking(workspace.sequence_dir(name) / "tracking").cameras
        cameras = [view(self.picture, camera, self._magnification) for camera in stored]
        if self._is_still():
            return cameras[:1]
        return cameras if timesteps is None else [cameras[i * len(cameras) // timesteps] for i in range(timesteps)]

    def _path(self, camera: "mien.camera.Camera", center: "torch.Tensor", frames: int) -> "list[mien.camera.Camera]":
        from mien.render import camera_paths

        return self._moved(camera_paths, camera, center, frames)
