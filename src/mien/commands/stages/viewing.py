"""From a workspace or a .mien file to a viewer, as the command line runs it."""

import contextlib
import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from mien import runtime
from mien.avatar import as_array, bake_rig, load_avatar, make_portable
from mien.capture.camera_names import CameraName, camera_named, devices
from mien.capture.live_camera import LiveCamera
from mien.commands.stages.driving import open_driver
from mien.commands.stages.live_view import PARENT
from mien.driving import drive, facing, keep_to_filmed, rest_of
from mien.driving.live import Follower, FollowOptions
from mien.errors import UserError
from mien.export import Motion
from mien.face import FaceModel, FaceParams, load_face_model
from mien.progress import say
from mien.runtime import MeshBound, PortableAvatar, read_portable
from mien.stops import Terminated
from mien.system import end_this_process
from mien.training import read_coverage, run_camera
from mien.training.run import filmed_range
from mien.viewer import CameraSwitch, Clip, Door, Mesh, Session, is_loopback, serve
from mien.workspace import open_workspace

_FOLLOW_SECONDS = 0.5


@dataclass(frozen=True, eq=False)
class Viewed:
    """An avatar to view."""

    portable: PortableAvatar
    mesh: Mesh | None
    sequences: dict[str, Path]
    """Names of the workspace's tracked sequences, and the workspace."""
    person: Callable[[], tuple[FaceModel, FaceParams]]
    """Returns the face model and the person at rest, which motions need."""


@dataclass(frozen=True)
class Place:
    """Where a viewer listens."""

    host: str
    port: int
    """0 means a free one."""
    token: bool = True
    """Whether browsers need a token."""


@dataclass(frozen=True)
class Motions:
    """Which motions a viewer offers besides the workspace's own."""

    play: str | None = None
    """What `mien drive --by` takes."""
    neutral: str | None = None
    """The face at rest of all motions, as `--neutral` names it."""


def run_viewing_stage(avatar: Path, run: str | None, motions: Motions, place: Place, follow: bool = False) -> None:
    """Show an avatar in browsers until Ctrl-C. With `follow`, show its file anew each time it changes."""
    door = Door.of(place.host, place.token)
    viewed = open_viewed(avatar, run)
    clips = {name: _clip_of(viewed, folder, name, motions.neutral) for name, folder in viewed.sequences.items()}
    if motions.play is not None:
        clips[Path(motions.play).name] = _clip_of(viewed, Path(motions.play), None, motions.neutral)
    session = Session(runtime.Avatar(viewed.portable), viewed.mesh, clips)

    def ready(address: str) -> None:
        say(f"Open {address} in a browser; Ctrl-C ends the viewer")

    if follow:
        threading.Thread(target=_follow, args=(session, avatar), daemon=True).start()
    try:
        serve(session, door, place.port, viewed.portable.about.name, ready, _camera_switch(session, viewed, place))
    except KeyboardInterrupt:
        say("The viewer is closed")
    except Terminated as stop:
        # Nothing continues later. A training ends its viewer in this way, and says so itself.
        raise SystemExit(stop.code) from None


def _camera_switch(session: Session, viewed: Viewed, place: Place) -> CameraSwitch | None:
    """The switch of this machine's first camera, if it has one.

    Other machines must not turn it on, nor other users of this one.
    """
    if not devices() or not is_loopback(place.host) or not place.token or os.environ.get(PARENT) is not None:
        return None
    return switch_of(session, viewed, camera_named("camera", None), FollowOptions())


def switch_of(
    session: Session, viewed: Viewed, name: CameraName, follow: FollowOptions, again: bool = True
) -> CameraSwitch:
    """What lets the avatar of a session follow a camera.

    Args:
        session: The session.
        viewed: Its avatar.
        name: The camera.
        follow: How the avatar follows.
        again: Whether a file starts again at its end.
    """

    def make() -> Follower:
        model, person = viewed.person()
        eye = as_array(position(viewed.portable.camera))
        return Follower(model, person, viewed.portable.filmed, eye, follow)

    return CameraSwitch(session, lambda: LiveCamera(name, again, say), make)


def _follow(session: Session, path: Path) -> None:
    """Show the file whenever it changes. If a training started this viewer and is gone, end it."""
    parent, seen = os.environ.get(PARENT), _changed_at(path)
    while True:
        time.sleep(_FOLLOW_SECONDS)
        if parent is not None and str(os.getppid()) != parent:
            end_this_process()
            return
        now = _changed_at(path)
        if now in (None, seen):
            continue
        seen = now
        with contextlib.suppress(UserError):  # The next state comes soon.
            session.replace_avatar(runtime.Avatar(read_portable(path)))


def _changed_at(path: Path) -> int | None:
    """Time of the last change, or None if there is no such file."""
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return None


def open_viewed(avatar: Path, run: str | None) -> Viewed:
    """Open a .mien file, or a run of a workspace."""
    return _of_file(avatar) if avatar.is_file() else _of_workspace(avatar, run)


def _of_file(path: Path) -> Viewed:
    portable = read_portable(path)

    def person() -> tuple[FaceModel, FaceParams]:
        about, rest = portable.about, portable.neutral
        model = load_face_model(about.face_model)
        if model.content_hash != about.face_model_hash:
            raise UserError(
                f"{path}: was made with another version of the face model {about.face_model!r}, so no motion can be "
                "played; export it again from its workspace"
            )
        fields = ("expression", "joints", "head_rotation", "head_translation")
        given = {name: torch.from_numpy(getattr(rest, name).copy())[None] for name in fields}
        return model, replace(model.neutral(), **given)

    return Viewed(portable, _mesh_of(portable), {}, person)


def _of_workspace(root: Path, run: str | None) -> Viewed:
    workspace = open_workspace(root)
    run_dir = workspace.run_dir(workspace.pick_run(run))
    avatar = load_avatar(run_dir)
    model = avatar.face_model
    portable = make_portable(avatar, run_camera(run_dir), root.resolve().name, to_share=False)
    portable = replace(portable, filmed=filmed_range(run_dir, avatar))
    mesh = _mesh_of(portable) or Mesh(bake_rig(model, avatar.subject), as_array(model.faces))
    coverage = read_coverage(run_dir, model)
    if coverage is not None and len(coverage.seen) == len(mesh.faces):
        mesh = replace(mesh, seen=as_array(coverage.seen))
    sequences = dict.fromkeys(workspace.tracked_names(), root)
    return Viewed(portable, mesh, sequences, lambda: (model, avatar.subject))


def _mesh_of(portable: PortableAvatar) -> Mesh | None:
    baked = portable.baked
    return Mesh(baked.rig, baked.faces, portable.confidence) if isinstance(baked, MeshBound) else None


def _clip_of(viewed: Viewed, by: Path, sequence: str | None, neutral: str | None = None) -> Callable[[], Clip]:
    """Return a function that loads a motion, made for the avatar and softly within what was filmed."""

    def load() -> Clip:
        model, subject = viewed.person()
        driver, portable = open_driver(by, sequence, model, neutral=neutral), viewed.portable
        person = rest_of(subject, model, facing(torch.from_numpy(portable.camera.viewmat))).face
        face = drive(driver.face, driver.at_rest, person, model.expression_bounds, True, str(by))
        if portable.filmed is not None:
            eye = position(portable.camera)
            face, _ = keep_to_filmed(face, portable.filmed, subject, model.expression_bounds, eye)
        fields = (face.expression, face.joints, face.head_rotation, face.head_translation)
        return Clip(Motion(*map(as_array, fields), fps=driver.fps), driver.pictures)

    return load


def position(camera: runtime.Camera) -> torch.Tensor:
    """The camera's centre in world space, in metres."""
    return torch.from_numpy((-camera.viewmat[:3, :3].T @ camera.viewmat[:3, 3]).astype(np.float32))
