"""From a workspace or a .mien file to a viewer.

A .mien file is shown without torch. What needs it, workspaces and motions, is in `view_motions` beside this.
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
from mien.runtime.baked import PortableAvatar
from mien.runtime.file import read_portable
from mien.runtime.still import follows_mesh
from mien.viewer.access import Door, address_of, is_loopback, listen
from mien.viewer.camera import CameraSwitch
from mien.viewer.drawing import Mesh
from mien.viewer.server import serve
from mien.viewer.session import Session

if TYPE_CHECKING:
    import mien.face

_FOLLOW_SECONDS = 0.5


@dataclass(frozen=True, eq=False)
class Viewed:
    """An avatar to view."""

    portable: PortableAvatar
    mesh: Mesh | None
    sequences: list[str]
    """Names of the workspace's tracked sequences."""
    person: Callable[[], "tuple[mien.face.FaceModel, mien.face.FaceParams]"]
    """Returns the face model and the person at rest, which motions need."""


def run_viewing_stage(
    avatar: Path,
    run: str | None,
    *,
    play: str | None = None,
    neutral: str | None = None,
    capture: CaptureSettings | None = None,
    at_once: bool = False,
    host: str = "127.0.0.1",
    port: int = 0,
    token: bool = True,
    follow: bool = False,
) -> None:
    """Show an avatar in browsers until Ctrl-C. With `follow`, show its file anew each time it changes.

    `play` is a motion besides those of the workspace, as `mien drive --by` takes it; `at_once` plays it as soon as the
    viewer opens. `neutral` is the face at rest of all motions. The address is told at once: browsers that open it wait.
    """
    door = Door.of(host, token)
    with contextlib.closing(listen(host, port)) as listener:
        viewed = viewed_file(avatar) if avatar.is_file() else None  # takes no time, unlike the run of a workspace
        say(f"Open {address_of(door, listener)} in a browser; Ctrl-C ends the viewer")
        try:
            viewed, clips = viewed or open_viewed(avatar, run), {}
            if viewed.sequences or play is not None:
                from mien.pipeline.view_motions import clip_of

                clips = {name: clip_of(viewed, avatar, name, neutral) for name in viewed.sequences}
                if play is not None:
                    clips[Path(play).name] = clip_of(viewed, Path(play), None, neutral, capture)
            session = Session(runtime.Avatar(viewed.portable), viewed.mesh, clips)
            if play is not None and at_once:
                session.choose(Path(play).name)
                session.play(True, time.monotonic())
            if follow:
                threading.Thread(target=follow_file, args=(session, avatar), daemon=True).start()
            serve(session, door, listener, viewed.portable.about.name, _camera_switch(session, viewed, door))
        except KeyboardInterrupt:
            say("The viewer is closed")
        except Terminated as stop:
            # Nothing continues later. A training ends its viewer in this way, and says so itself.
            raise SystemExit(stop.code) from None


def open_viewed(avatar: Path, run: str | None) -> Viewed:
    """Open a .mien file, or a run of a workspace."""
    if avatar.is_file():
        return viewed_file(avatar)
    from mien.pipeline.view_motions import of_workspace

    return of_workspace(avatar, run)


def mesh_of(portable: PortableAvatar) -> Mesh | None:
    """The mesh that an avatar's Gaussians are bound to, if they are."""
    baked = portable.baked
    return Mesh(baked.rig, baked.faces, portable.confidence) if follows_mesh(baked) else None


def viewed_file(path: Path) -> Viewed:
    """Return what the viewer shows of a .mien file."""
    portable = read_portable(path)

    def person() -> "tuple[mien.face.FaceModel, mien.face.FaceParams]":
        from mien.pipeline.view_motions import person_of

        return person_of(path, portable)

    return Viewed(portable, mesh_of(portable), [], person)


def _camera_switch(session: Session, viewed: Viewed, door: Door) -> CameraSwitch | None:
    """The switch of this machine's first camera, if it has one and if what follows a face is installed.

    Other machines must not turn it on, nor other users of this one.
    """
    if not devices() or not is_loopback(door.host) or door.token is None or os.environ.get(PARENT_VARIABLE) is not None:
        return None
    try:
        from mien.pipeline.view_motions import switch_of
    except ModuleNotFoundError:
        return None
    return switch_of(session, viewed)


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
