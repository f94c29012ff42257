"""`mien export`: avatars as files for other programs."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from mien.commands.options import check_driver, check_neutral
from mien.errors import UserError
from mien.export.usd_package import USD_ENDINGS, check_usd
from mien.workspace import Workspace, open_workspace

if TYPE_CHECKING:
    import mien.export
    import mien.gaussians
    import mien.runtime

_POSES = (".ply", ".spz", ".sog", *USD_ENDINGS)
_PAGES = (".html", ".packed")
_ENDINGS = (".mien", *_PAGES, ".glb", *_POSES)
_Format = Literal[
    "mien", "html", "packed", "glb", "ply", "spz", "sog", "usd", "usda", "usdc", "usdz", "gaussian-avatars"
]
_FILES = (".mien", ".glb")
"""Endings of avatars that can be read."""


@dataclass(frozen=True)
class Command:
    """Write an avatar: .mien (all of it), .html and .packed (for pages), .glb (for engines), a pose, or a folder."""

    workspace: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """Workspace folder. Also a .mien or .glb file, whose avatar becomes a .mien, a .html or .packed, or the pose at
    rest."""
    out: Path
    """The file to write: .mien, .html, .packed, .glb, or Gaussians in a pose: .ply, .spz, .sog, .usd, .usda, .usdc or
    .usdz. With --series, .ply, .spz and .sog files get numbers: NAME_000000.ply; a USD file has all frames. With
    --format gaussian-avatars, a folder."""
    format: _Format | None = None
    """Format of the output (default: by the ending of --out), or gaussian-avatars: a folder with point_cloud.ply, whose
    Gaussians are bound to triangles, and flame_param.npz with all timesteps of the run's training."""
    run_name: Annotated[str | None, tyro.conf.arg(name="run")] = None
    """Name of the run (default: the only one)."""
    set: tuple[str, ...] = ()
    """Expressions by name, and joint angles in radians, for example --set jawOpen=0.6 mouthSmileLeft=0.4 left_eye_y=0.2
    (default: the person's neutral)."""
    series: str | None = None
    """A motion: the name of a sequence of the workspace, or anything that `mien drive --by` takes. A page plays it. For
    .ply, .spz and .sog, every frame becomes a file, and for USD a time sample; the head stays at the origin."""
    neutral: str | None = None
    """With --series, the driver's face at rest, as for `mien drive`: first, calm, model, or a video, recording,
    workspace or sequence folder of the driver at rest."""
    every: int = 1
    """With --series, take only every n-th frame."""
    sh: Literal[0, 1, 2, 3] | None = None
    """For .ply: degree of the spherical harmonics in the file. Coefficients that the avatar lacks are zeros, for
    programs that expect those of degree 3: 248 bytes for each Gaussian (default: the avatar's own degree)."""
    webgpu: bool = False
    """For .html: the page draws with WebGPU where the browser has it on a GPU, and with WebGL2 elsewhere. The page
    becomes 22 kB larger."""
    webcam: bool = False
    """For .html: a button with which the viewer's own face drives the avatar. The page becomes 9 MB larger; nothing of
    the camera leaves it. Needs `make web-packages`, and MediaPipe's model."""
    webcam_model: Path | None = None
    """With --webcam, MediaPipe's face_landmarker.task (default: the file that MIEN_FACE_LANDMARKER names)."""

    def check(self) -> None:
        """Check options and paths without heavy libraries."""
        from mien.files import check_writable

        if self.webgpu and self.out.suffix.lower() != ".html":
            raise UserError(f"{self.out}: only an .html page draws with WebGPU; leave --webgpu out")
        if self.sh is not None and (self.out.suffix.lower() != ".ply" or self.format == "gaussian-avatars"):
            raise UserError(f"{self.out}: only a .ply has a degree to choose; leave --sh out")
        self._check_webcam()
        if self.workspace.suffix.lower() in _FILES and not self.workspace.is_dir():
            self._check_file()
            return
        workspace = open_workspace(self.workspace)
        workspace.pick_run(self.run_name)
        kind = self.out.suffix.lower()
        if self.format == "gaussian-avatars":
            self._check_folder()
            return
        self._check_ending(_ENDINGS, ", or --format gaussian-avatars for a folder")
        if kind == ".mien" and (self.set or self.series):
            raise UserError(f"{self.out}: a .mien file holds every expression; leave --set and --series out")
        if kind == ".glb" and (self.set or self.series):
            raise UserError(
                f"{self.out}: a .glb file has a morph target for every expression; leave --set and --series out"
            )
        if kind in _PAGES and self.set:
            raise UserError(f"{self.out}: a page sets every expression itself; leave --set out")
        if self.every < 1 or (self.every > 1 and self.series is None):
            raise UserError(f"--every {self.every}: give 1 or more, together with --series")
        if self.neutral is not None and self.series is None:
            raise UserError(f"--neutral {self.neutral}: is for motions; give it together with --series")
        check_neutral(self.neutral)
        if self.series is not None and self.series not in workspace.sequence_names():
            check_driver(Path(self.series), None)
        numbered = self.series is not None and kind in _POSES and kind not in USD_ENDINGS
        check_writable(self._numbered(0) if numbered else self.out)

    def run(self) -> None:
        """Pose the avatar and write the files."""
        from mien.avatar import load_avatar

        if self.workspace.suffix.lower() in _FILES and not self.workspace.is_dir():
            self._convert()
            return
        workspace = open_workspace(self.workspace)
        run_dir = workspace.run_dir(workspace.pick_run(self.run_name))
        avatar = load_avatar(run_dir)
        if self.format == "gaussian-avatars":
            self._write_folder(avatar, run_dir)
        elif self.out.suffix.lower() == ".mien":
            self._write_mien(avatar, run_dir)
        elif self.out.suffix.lower() in _PAGES:
            self._write_page(avatar, run_dir, workspace)
        elif self.out.suffix.lower() == ".glb":
            self._write_glb(avatar, run_dir)
        elif self.series is None:
            self._write_one(avatar)
        else:
            self._write_series(avatar, workspace, self.series)

    def _check_webcam(self) -> None:
        from mien.export.webcam import find_webcam_files

        if self.webcam_model is not None and not self.webcam:
            raise UserError(f"--webcam-model {self.webcam_model}: give it together with --webcam")
        if self.webcam and self.out.suffix.lower() != ".html":
            raise UserError(f"{self.out}: only an .html page has a webcam; leave --webcam out, or write a .html file")
        if self.webcam:
            find_webcam_files(self.webcam_model)

    def _webcam_files(self) -> "mien.export.WebcamFiles | None":
        from mien.export import find_webcam_files

        return find_webcam_files(self.webcam_model) if self.webcam else None

    def _check_ending(self, endings: tuple[str, ...], others: str) -> None:
        kind = self.out.suffix.lower()
        if kind not in endings:
            use = f"{', '.join(endings[:-1])} or {endings[-1]}"
            raise UserError(f"{self.out}: cannot write {kind or 'a file without ending'}; use {use}{others}")
        if self.format is not None and kind != f".{self.format}":
            raise UserError(f"{self.out}: does not end in .{self.format}, as --format {self.format} asks; rename it")
        if kind in USD_ENDINGS:
            check_usd(self.out)

    def _check_file(self) -> None:
        from mien.files import check_writable

        if not self.workspace.is_file():
            raise UserError(f"{self.workspace}: no such file; give a workspace, or a file that `mien export` wrote")
        if self.run_name or self.set or self.series or self.neutral or self.every != 1:
            raise UserError(
                f"{self.workspace}: a file holds one avatar at rest; leave --run, --set, --series, --neutral and "
                "--every out, or give its workspace"
            )
        self._check_ending(tuple(ending for ending in _ENDINGS if ending != ".glb"), "")
        if self.out.exists() and self.out.samefile(self.workspace):
            raise UserError(f"{self.out}: is the file that is read; choose another name")
        check_writable(self.out)

    def _convert(self) -> None:
        from mien.commands.stages.converting import convert

        convert(self.workspace, self.out, self._webcam_files(), self.webgpu, self.sh)

    def _check_folder(self) -> None:
        from mien.files import check_writable

        if self.out.suffix.lower() in _ENDINGS:
            raise UserError(f"{self.out}: --format gaussian-avatars writes a folder; give a name without an ending")
        if self.set or self.series or self.every != 1:
            raise UserError(
                f"{self.out}: GaussianAvatars' folder holds every timestep; leave --set, --series and --every out"
            )
        check_writable(self.out, folder=True)

    def _write_folder(self, avatar, run_dir: Path) -> None:
        from mien.export import write_gaussian_avatars_folder
        from mien.progress import say
        from mien.training import read_face_track

        face = read_face_track(run_dir, avatar.face_model)
        face = replace(face, identity=avatar.subject.identity, vertex_offsets=avatar.subject.vertex_offsets)
        write_gaussian_avatars_folder(self.out, avatar, face)
        say(f"{self.out}: {len(avatar.gaussian_store()):,} Gaussians, {len(face)} timesteps")
        if avatar.face_model.flame_origin is None:
            say(
                f"note: the folder has the face model {avatar.face_model.name!r} in it; `mien import` reads it, but "
                "GaussianAvatars' viewer opens only avatars on FLAME with teeth"
            )

    def _portable(self, avatar, run_dir: Path) -> "mien.runtime.PortableAvatar":
        """The avatar with everything that the run knows of it."""
        from mien.avatar import as_array, make_portable
        from mien.training import read_coverage, run_camera

        portable = make_portable(avatar, run_camera(run_dir), self.workspace.resolve().name)
        covered = read_coverage(run_dir, avatar.face_model)
        return portable if covered is None else replace(portable, confidence=as_array(covered.seen))

    def _write_mien(self, avatar, run_dir: Path) -> None:
        from mien.progress import say
        from mien.runtime import write_portable

        write_portable(self.out, self._portable(avatar, run_dir))
        say(f"{self.out}: {len(avatar.gaussian_store()):,} Gaussians, {self.out.stat().st_size / 1e6:.1f} MB")

    def _write_page(self, avatar, run_dir: Path, workspace: Workspace) -> None:
        from mien.avatar import make_portable
        from mien.export import Motion, write_packed, write_page
        from mien.progress import say
        from mien.training import run_camera

        portable = make_portable(avatar, run_camera(run_dir), self.workspace.resolve().name)
        motion = None
        if self.series is not None:
            driven, fps = self._driven(avatar, workspace, self.series, with_head_pose=True)
            fields = (driven.expression, driven.joints, driven.head_rotation, driven.head_translation)
            motion = Motion(*(tensor.detach().float().numpy() for tensor in fields), fps=fps / self.every)
        if self.out.suffix.lower() == ".html":
            page = write_page(self.out, portable, motion, self._webcam_files(), self.webgpu)
        else:
            page = write_packed(self.out, portable, motion)
        moves = "" if motion is None else f", a motion of {len(motion):,} frames"
        say(
            f"{self.out}: {len(avatar.gaussian_store()):,} Gaussians{moves}, {page.size / 1e6:.1f} MB; compression "
            f"changes the picture little ({page.psnr:.0f} dB)"
        )

    def _write_glb(self, avatar, run_dir: Path) -> None:
        from mien.avatar import as_array, bake_rig
        from mien.export import MeshModel, write_glb
        from mien.progress import say

        portable, model = self._portable(avatar, run_dir), avatar.face_model
        mesh = MeshModel(bake_rig(model, avatar.subject), *map(as_array, (model.faces, model.uv, model.uv_faces)))
        written = write_glb(self.out, portable, mesh)
        say(
            f"{self.out}: a mesh with {len(written.targets)} morph targets and {len(model.joint_names)} joints, "
            f"{len(avatar.gaussian_store()):,} Gaussians at rest, {written.size / 1e6:.1f} MB"
        )

    def _write_one(self, avatar) -> None:
        from mien.commands.expression import with_expression
        from mien.export import write_pose
        from mien.progress import say

        face = with_expression(avatar.subject, avatar.face_model, self.set)
        write_pose(self.out, _posed(avatar, face), self.sh)
        say(f"{self.out}: {len(avatar.gaussian_store()):,} Gaussians")

    def _write_series(self, avatar, workspace: Workspace, series: str) -> None:
        from mien.export import write_pose, write_usd
        from mien.progress import say, track_progress

        driven, fps = self._driven(avatar, workspace, series, with_head_pose=False)
        indices = track_progress(range(len(driven)), "Exporting", len(driven))
        if self.out.suffix.lower() in USD_ENDINGS:
            count = write_usd(self.out, (_posed(avatar, driven[index]) for index in indices), fps / self.every)
            say(f"{self.out}: {count} time samples, {self.out.stat().st_size / 1e6:.1f} MB")
            return
        for index in indices:
            write_pose(self._numbered(index), _posed(avatar, driven[index]), self.sh)
        say(f"{self._numbered(0)} ... {self._numbered(len(driven) - 1).name}: {len(driven)} files")

    def _driven(self, avatar, workspace: Workspace, series: str, with_head_pose: bool):
        """The face parameters of --series for this avatar, and the motion's frames per second before --every."""
        from mien.commands.expression import with_expression
        from mien.commands.stages.driving import open_driver
        from mien.driving import drive, facing, rest_of
        from mien.training import run_camera

        own, model = series in workspace.sequence_names(), avatar.face_model
        by = workspace.root if own else Path(series)
        driver = open_driver(by, series if own else None, model, neutral=self.neutral)
        camera = run_camera(workspace.run_dir(workspace.pick_run(self.run_name)))
        person = rest_of(avatar.subject, model, facing(camera.viewmat)).face
        driven = drive(driver.face, driver.at_rest, person, model.expression_bounds, with_head_pose, series)
        return with_expression(driven[:: self.every], avatar.face_model, self.set), driver.fps

    def _numbered(self, index: int) -> Path:
        return self.out.with_name(f"{self.out.stem}_{index:06d}{self.out.suffix.lower()}")


def _posed(avatar, face) -> "mien.gaussians.Gaussians":
    """The Gaussians of one timestep in the world. The head is at the origin, +y up, +z out of the face."""
    import torch

    from mien.export import in_world

    origin = torch.zeros_like(face.head_rotation)
    gaussians = avatar.pose(replace(face, head_rotation=origin, head_translation=origin)).gaussians.detach()
    return in_world(gaussians.timestep(0))
