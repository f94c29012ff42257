"""A camera that is read while it films: a device, a stream, or a file that plays in real time.

A thread of its own reads and keeps only the newest frame, so that slow work never makes the picture older.
"""

import contextlib
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import av
import av.error
import numpy as np
from av.container import InputContainer
from jaxtyping import UInt8

from mien.errors import UserError
from mien.media.camera_names import CameraName, remedy
from mien.media.display import Display, brought_to, has_shape
from mien.media.video import read_lazily
from mien.media.video_file import open_video

_LIVE_SIDE = 640  # longest side in pixels of a camera's pictures that are kept

_ASKED = {"framerate": "30", "video_size": "640x480"}
"""What a device is asked for first. One that cannot do it gives its own default."""
_STREAM = {"flags": "low_delay", "timeout": "5000000"}
"""What a stream is asked for: no reordering, and an error after five seconds without an answer (in microseconds)."""
_RETRY_SECONDS, _PATIENCE_SECONDS = 1.0, 2.0
_Frames = Iterator[tuple[float, Callable[[], np.ndarray]]]
_Opened = tuple[contextlib.ExitStack, _Frames]
"""A stack that closes a source, and its frames: the time in seconds at which a file shows one, and what makes it."""


@dataclass(frozen=True, eq=False)
class LiveFrame:
    """A frame of a camera."""

    number: int
    """Number of frames before it."""
    seconds: float
    """Time of the camera's clock at which the frame came."""
    picture: UInt8[np.ndarray, "h w 3"]


class LiveCamera:
    """Reads a camera in a thread. Use as a context manager.

    If the camera vanishes, the thread says so, waits, and takes it up again. A file ends, or starts again.
    """

    def __init__(
        self,
        name: CameraName,
        again: bool,
        say: Callable[[str], None] = lambda text: None,
        clock: Callable[[], float] = time.monotonic,
        wait: Callable[[threading.Event, float], object] = threading.Event.wait,
    ) -> None:
        """Prepare to read a camera. A file starts `again` at its end.

        `say` gets a line when the camera vanishes and when it is back. `wait` waits for an event, at most so many
        seconds: between the frames of a file, and for a camera that has vanished.
        """
        self.name = name
        self._again, self._say, self._clock, self._wait = again, say, clock, wait
        self._changed = threading.Condition()
        self._newest: LiveFrame | None = None
        self._stopping = threading.Event()
        self.ended = False
        """Whether a file has ended, or an error has ended the thread."""
        self.is_lost = False
        """Whether the camera has vanished and is waited for."""
        self.error: BaseException | None = None
        """What ended the thread, if it is a bug."""
        self.frames = 0
        """Number of frames so far."""
        self._thread = threading.Thread(target=self._run, name="mien-camera", daemon=True)

    def __enter__(self) -> "LiveCamera":
        self._opened = self._open()
        return self

    def start(self) -> None:
        """Start to read."""
        self._thread.start()

    def __exit__(self, *error: object) -> None:
        self._stopping.set()
        with self._changed:
            self._changed.notify_all()
        if self._thread.is_alive():
            # A device may block in its driver; the thread is a daemon, and ends with the process.
            self._thread.join(_PATIENCE_SECONDS)

    def newest(self, after: int, seconds: float) -> LiveFrame | None:
        """The newest frame whose number is above `after`. Wait for it; None if none comes in time."""
        with self._changed:
            self._changed.wait_for(lambda: self._is_new(after) or self.ended or self._stopping.is_set(), seconds)
            return self._newest if self._is_new(after) else None

    def _is_new(self, after: int) -> bool:
        return self._newest is not None and self._newest.number > after

    def _open(self) -> _Opened:
        stack = contextlib.ExitStack()
        if not self.name.is_file:
            return stack, _device_frames(stack.enter_context(_open_device(self.name)), self.name)
        path = Path(self.name.device)
        with open_video(path):  # refuses what is no video before the thread starts
            frames = stack.enter_context(contextlib.closing(read_lazily(path, _LIVE_SIDE)))
        return stack, ((frame.seconds, frame.picture) for frame in frames)

    def _run(self) -> None:
        try:
            opened: _Opened | None = self._opened
            while not self._stopping.is_set():
                opened = opened or self._reopen()
                if opened is None:
                    continue
                self._read(*opened)
                opened = None
                if self.name.is_file and not self._again:
                    break
                if not self.name.is_file and not self.is_lost and not self._stopping.is_set():
                    self.is_lost = True
                    self._say(f"{self.name}: gives no more pictures; mien waits until it is back")
        except BaseException as error:  # noqa: BLE001
            self.error = error
        with self._changed:
            self.ended = True
            self._changed.notify_all()

    def _reopen(self) -> _Opened | None:
        if not self.name.is_file:
            self._wait(self._stopping, _RETRY_SECONDS)
        try:
            return None if self._stopping.is_set() else self._open()
        except UserError:
            return None

    def _read(self, source: contextlib.ExitStack, frames: _Frames) -> None:
        """Keep each frame when it comes, until the end or an error of the device."""
        began: float | None = None
        size: tuple[int, int] | None = None
        with contextlib.suppress(av.error.FFmpegError, OSError), source:
            for due, make in frames:
                now = self._clock()
                began = now - due if began is None else began
                if self.name.is_file:
                    self._wait(self._stopping, max(0.0, began + due - now))
                    now = max(now, began + due)
                if self._stopping.is_set():
                    return
                picture = make()
                size = size or (picture.shape[1], picture.shape[0])
                if not has_shape(picture, size):
                    raise UserError(
                        f"{self.name}: the picture changes from {size[0]}x{size[1]} to {picture.shape[1]}x"
                        f"{picture.shape[0]} at {now - began:.1f} s; start again with what comes after"
                    )
                self._keep(LiveFrame(self.frames, now, np.ascontiguousarray(brought_to(picture, size))))

    def _keep(self, frame: LiveFrame) -> None:
        if self.is_lost:
            self.is_lost = False
            self._say(f"{self.name}: is back")
        with self._changed:
            self._newest = frame
            self.frames += 1
            self._changed.notify_all()


def _device_frames(container: InputContainer, name: CameraName) -> _Frames:
    if not container.streams.video:
        raise UserError(f"--by {name}: has no pictures; {_remedy(name)}")
    display = Display(str(name), longest_side=_LIVE_SIDE)
    return ((0.0, partial(display.show, frame)) for frame in container.decode(container.streams.video[0]))


def _open_device(name: CameraName) -> InputContainer:
    attempts = [_STREAM] if name.is_stream else [_ASKED, {}]
    reason = ""
    for options in attempts:
        try:
            return av.open(name.device, "r", format=None if name.is_stream else name.format, options=options)
        except ValueError:
            raise UserError(
                f"--camera-format {name.format}: this PyAV does not have it; on {sys.platform}, leave it out"
            ) from None
        except (av.error.FFmpegError, OSError) as error:
            reason = error.strerror or str(error)
            if isinstance(error, FileNotFoundError):
                break
    raise UserError(f"--by {name}: cannot be opened ({reason}); {_remedy(name)}")


def _remedy(name: CameraName) -> str:
    return "check the address, and that it can be reached from here" if name.is_stream else remedy()
