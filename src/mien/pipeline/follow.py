"""An avatar that follows a camera, in a viewer and as a video."""

import contextlib
import queue
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from mien import runtime
from mien.disk.files import cannot_write
from mien.driving.follower import FollowOptions
from mien.errors import UserError
from mien.machine.progress import say
from mien.media.camera_names import CameraName
from mien.media.pictures import side_by_side
from mien.media.pixels import to_rgb
from mien.media.video import write_video
from mien.pipeline.picture_options import PictureOptions
from mien.pipeline.view import open_viewed
from mien.pipeline.view_motions import switch_of
from mien.runtime.camera_paths import fitted
from mien.viewer.access import Door, address_of, listen
from mien.viewer.camera import CameraSwitch
from mien.viewer.server import serve
from mien.viewer.session import Seen, Session

FPS = 25
"""Frames a second of a recording."""
_WAIT_SECONDS = 0.2


def run_following_stage(
    avatar: Path,
    run: str | None,
    name: CameraName,
    follow: FollowOptions,
    picture: PictureOptions,
    out: Path | None = None,
    alone: bool = False,
    port: int | None = None,
) -> None:
    """Show an avatar that follows a camera, until Ctrl-C; with a recording of a file, until the file ends.

    `out` records it, without the camera's pictures beside the avatar if `alone`. Without a port, there is no viewer.
    """
    viewed = open_viewed(avatar, run)
    session = Session(runtime.Avatar(viewed.portable), viewed.mesh)
    switch = switch_of(session, viewed, name, follow, again=out is None)
    try:
        switch.start()
        with contextlib.ExitStack() as closing:
            recorder = None if out is None else _Recorder(session, switch, picture, out, alone)
            if recorder is not None:
                closing.callback(recorder.finish)
            ask = "look into the camera for a second with a relaxed face; Ctrl-C ends"
            if port is None:
                say(ask[0].upper() + ask[1:])
                while not switch.ended and (recorder is None or recorder.running):
                    time.sleep(_WAIT_SECONDS)
            else:
                door = Door.of("127.0.0.1")
                listener = closing.enter_context(contextlib.closing(listen(door.host, port)))
                say(f"Open {address_of(door, listener)} in a browser, and {ask}")
                serve(session, door, listener, viewed.portable.about.name, switch)
    except KeyboardInterrupt:
        pass
    finally:
        switch.stop()
        if switch.meters.rates()["tracking"]:
            for line in switch.meters.words():
                say(line)
    if isinstance(switch.error, Exception):
        raise switch.error


class _Recorder:
    """Draws each followed frame in a thread, or the newest if it is slow, and writes the pictures at their times."""

    def __init__(self, session: Session, switch: CameraSwitch, options: PictureOptions, out: Path, alone: bool) -> None:
        self._session, self._switch, self._options, self._out, self._alone = session, switch, options, out, alone
        self._newest: queue.Queue[tuple[runtime.Face, Seen] | None] = queue.Queue(maxsize=1)
        self._camera = fitted(session.avatar.camera, *options.shape())
        self.pictures = 0
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="mien-recording", daemon=True)
        self._thread.start()
        switch.watch = self._take

    @property
    def running(self) -> bool:
        """Whether frames are still taken."""
        return self._thread.is_alive()

    def _take(self, seen: Seen) -> None:
        """Record the face that is shown now. An older one that is not drawn yet is dropped."""
        with contextlib.suppress(queue.Empty):
            self._newest.get_nowait()
        with contextlib.suppress(queue.Full):
            self._newest.put_nowait((self._session.face, seen))

    def finish(self) -> None:
        """Write the end of the video."""
        self._switch.watch = None
        while self.running:
            with contextlib.suppress(queue.Full):
                self._newest.put(None, timeout=_WAIT_SECONDS)
                break
        self._thread.join()
        if self._error is not None:
            raise self._error
        say(f"{self._out}: {self.pictures} frames")

    def _run(self) -> None:
        try:
            write_video(self._out, self._frames(), FPS, 23, "ultrafast")
        except UserError as error:
            self._error = error
        except OSError as error:
            self._error = cannot_write(self._out, error)

    def _frames(self) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        began: float | None = None
        while (item := self._newest.get()) is not None:
            face, seen = item
            picture = self._picture(face, seen)
            self._switch.shown(seen)
            began = seen.seconds if began is None else began
            # A picture stays until the next one came. Frames that came faster than the video goes are left out.
            while self.pictures <= round((seen.seconds - began) * FPS):
                self.pictures += 1
                yield picture

    def _picture(self, face: runtime.Face, seen: Seen) -> UInt8[np.ndarray, "h w 3"]:
        gaussians = runtime.pose(self._session.avatar.portable.baked, face)
        shown = to_rgb(runtime.render(gaussians, self._camera, self._options.color())[0])
        if self._alone:
            return shown
        height, width = seen.picture.shape[:2]
        wide = max(1, round(width * len(shown) / height))
        return side_by_side([cv2.resize(seen.picture, (wide, len(shown)), interpolation=cv2.INTER_LINEAR), shown])
