"""From a workspace or a .mien file to a viewer, as the command line runs it.

A .mien file is shown without torch. What needs it, workspaces and motions, is in `viewing_motions` beside this.
"""

import contextlib
import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from mien import runtime
from mien.capture.settings import CaptureSettings
from mien.errors import UserError
from mien.machine.progress import say
from mien.machine.stops import Terminated
from mien.machine.system import PARENT_VARIABLE, end_this_process
from mien.media.camera_names import devices
from mien.runtime.baked import MeshBound, PortableAvatar
from mien.runtime.file import read_portable
from mien.viewer.access import Door, is_loopback
from mien.viewer.drawing import Mesh
from mien.viewer.following import CameraSwitch
from mien.viewer.server import address_of, listen, serve
from mien.viewer.session import Session

if TYPE_CHECKING:
    import mien.face

_FOLLOW_SECONDS = 0.5


@dataclass(frozen=True, eq=False)
class Viewed:
    """An avatar to view."""

    portable: PortableAvatar
    mesh: Mesh | None
    sequences: dict[str, Path]
    """Names of the workspace's tracked sequences, and the workspace."""
    person: Callable[[], "tuple[mien.face.FaceModel, mien.face.FaceParams]"]
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
    at_once: bool = False
    """Whether the motion plays as soon as the viewer opens."""
    capture: CaptureSettings | None = None
    """How `play` is captured if it is filmed."""


def run_viewing_stage(avatar: Path, run: str | None, motions: Motions, place: Place, follow: bool = False) -> None:
    """Show an avatar in browsers until Ctrl-C. With `follow`, show its file anew each time it changes.

    The address is told at once. Browsers that open it wait until the avatar is loaded.
    """
    door = Door.of(place.host, place.token)
    with contextlib.closing(listen(place.host, place.port)) as listener:
        viewed = viewed_file(avatar) if avatar.is_file() else None  # takes no time, unlike the run of a workspace
        say(f"Open {address_of(door, listener)} in a browser; Ctrl-C ends the viewer")
        try:
            viewed = viewed or open_viewed(avatar, run)
            session = _session(viewed, motions)
            if follow:
                threading.Thread(target=follow_file, args=(session, avatar), daemon=True).start()
            camera, name = _camera_switch(session, viewed, place), viewed.portable.about.name
            serve(session, door, place.port, name, lambda address: None, camera, listener)
        except KeyboardInterrupt:
            say("The viewer is closed")
        except Terminated as stop:
            # Nothing continues later. A training ends its viewer in this way, and says so itself.
            raise SystemExit(stop.code) from None


def _session(viewed: Viewed, motions: Motions) -> Session:
    """The avatar that browsers share, and the motions that it may play."""
    clips = {}
    if viewed.sequences or motions.play is not None:
        from mien.pipeline.view_motions import clip_of

        clips = {name: clip_of(viewed, folder, name, motions.neutral) for name, folder in viewed.sequences.items()}
        if motions.play is not None:
            clips[Path(motions.play).name] = clip_of(viewed, Path(motions.play), None, motions.neutral, motions.capture)
    session = Session(runtime.Avatar(viewed.portable), viewed.mesh, clips)
    if motions.play is not None and motions.at_once:
        session.choose(Path(motions.play).name)
        session.play(True, time.monotonic())
    return session


def open_viewed(avatar: Path, run: str | None) -> Viewed:
    """Open a .mien file, or a run of a workspace."""
    if avatar.is_file():
        return viewed_file(avatar)
    from mien.pipeline.view_motions import of_workspace

    return of_workspace(avatar, run)


def mesh_of(portable: PortableAvatar) -> Mesh | None:
    """The mesh that an avatar's Gaussians are bound to, if they are."""
    baked = portable.baked
    return Mesh(baked.rig, baked.faces, portable.confidence) if isinstance(baked, MeshBound) else None


def viewed_file(path: Path) -> Viewed:
    """Return what the viewer shows of a .mien file."""
    portable = read_portable(path)

    def person() -> "tuple[mien.face.FaceModel, mien.face.FaceParams]":
        from mien.pipeline.view_motions import person_of

        return person_of(path, portable)

    return Viewed(portable, mesh_of(portable), {}, person)


def _camera_switch(session: Session, viewed: Viewed, place: Place) -> CameraSwitch | None:
    """The switch of this machine's first camera, if it has one and if what follows a face is installed.

    Other machines must not turn it on, nor other users of this one.
    """
    if not devices() or not is_loopback(place.host) or not place.token or os.environ.get(PARENT_VARIABLE) is not None:
        return None
    try:
        from mien.pipeline.view_motions import switch_of_first_camera
    except ModuleNotFoundError:
        return None
    return switch_of_first_camera(session, viewed)


def follow_file(session: Session, path: Path) -> None:
    """Show the file whenever it changes. If a training started this viewer and is gone, end it."""
    parent, seen = os.environ.get(PARENT_VARIABLE), _changed_at(path)
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
