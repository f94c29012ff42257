"""An avatar that follows a camera: one thread tracks the newest frame, and the session shows the face."""

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from mien.viewer.session import Seen, Session

if TYPE_CHECKING:
    from mien.capture.person.faces import LandmarkDetector
    from mien.driving.follower import Follower
    from mien.media.live_camera import LiveCamera, LiveFrame

STAGES = ("camera", "tracking", "drawing")
_WORDS = {
    "waiting": "Nobody is seen. Look into the camera.",
    "learning": "Look ahead for a second, with a relaxed face.",
    "following": "Following.",
    "resting": "The face is away, so the avatar rests.",
}


class Meters:
    """Frames a second of each stage, and the time from a frame to its picture. Any thread may use it."""

    def __init__(self) -> None:
        """Count from zero."""
        self._lock = threading.Lock()
        self._recent: dict[str, deque[float]] = {stage: deque(maxlen=1000) for stage in STAGES}
        self._whole: dict[str, tuple[int, float, float]] = {stage: (0, 0.0, 0.0) for stage in STAGES}
        """Number of frames, and the times of the first and of the last."""
        self._delays = deque[float](maxlen=100_000)

    def count(self, stage: str, now: float) -> None:
        """Count a frame of a stage at a time in seconds."""
        with self._lock:
            count, first, _ = self._whole[stage]
            self._whole[stage] = count + 1, first if count else now, now
            self._recent[stage].append(now)

    def delay(self, seconds: float) -> None:
        """Note the time from a frame that came in to its picture that went out."""
        with self._lock:
            self._delays.append(seconds)

    def rates(self, now: float | None = None) -> dict[str, float]:
        """Frames a second of each stage: of the last five seconds before `now`, or (None) of the whole time."""
        with self._lock:
            if now is None:
                whole = self._whole.items()
                return {name: (n - 1) / (last - first) if n > 1 else 0.0 for name, (n, first, last) in whole}
            return {name: sum(now - 5.0 < at for at in recent) / 5.0 for name, recent in self._recent.items()}

    def delays(self) -> tuple[float, float, int]:
        """Median and 95th percentile of the delays in seconds, and their number. They are NaN without any."""
        with self._lock:
            delays = np.array(self._delays)
        median, late = np.percentile(delays, (50, 95)) if len(delays) else (np.nan, np.nan)
        return float(median), float(late), len(delays)

    def words(self, now: float | None = None) -> list[str]:
        """Lines for people with the rates and the delays."""
        rates = ", ".join(f"{stage} {rate:.1f}" for stage, rate in self.rates(now).items())
        median, late, count = self.delays()
        lines = [f"Frames a second: {rates}"]
        if count:
            lines.append(f"From frame in to picture out: median {1e3 * median:.0f} ms, 95 percent {1e3 * late:.0f} ms")
        return lines


class CameraSwitch:
    """Follows a camera while it is on. Methods may be called from any thread."""

    def __init__(
        self, session: Session, open_camera: Callable[[], "LiveCamera"], make: Callable[[], "Follower"],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:  # fmt: skip
        """Prepare to follow; nothing is opened before `start`. `clock` is the camera's, in seconds."""
        self._session, self._open, self._make, self._clock = session, open_camera, make, clock
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._stopping = threading.Event()
        self._camera: LiveCamera | None = None
        self._follower: Follower | None = None
        self.meters = Meters()
        self.watch: Callable[[Seen], None] | None = None
        """Is called after each frame that was followed."""
        self.error: BaseException | None = None
        """What ended the thread, if anything did."""
        self.ended = False
        """Whether the camera's file has ended, or the thread has failed."""

    @property
    def is_on(self) -> bool:
        """Whether the camera is followed."""
        return self._thread is not None

    def start(self) -> None:
        """Open the camera and follow it. If it is on already, nothing changes."""
        with self._lock:
            if self._thread is not None:
                return
            follower = self._make()
            camera = self._open()
            camera.__enter__()
            self._stopping.clear()
            self._camera, self._follower = camera, follower
            self._thread = threading.Thread(
                target=self._run, args=(camera, follower), name="mien-tracking", daemon=True
            )
            self._thread.start()

    def stop(self) -> None:
        """Close the camera, and show the person at rest. If it is off already, nothing changes."""
        with self._lock:
            thread, camera = self._thread, self._camera
            self._thread = self._camera = None
            if thread is None or camera is None:
                return
            self._stopping.set()
            camera.__exit__(None, None, None)
            thread.join()
            self._session.stop_following()

    def learn_rest(self) -> None:
        """Learn the person's face at rest anew."""
        if self._follower is not None:
            self._follower.recalibrate()

    def shown(self, seen: Seen) -> None:
        """Take account of a picture that went out."""
        now = self._clock()
        self.meters.count("drawing", now)
        self.meters.delay(now - seen.seconds)

    def report(self) -> list[str]:
        """Lines for people: what happens, rates, and delays."""
        camera, follower = self._camera, self._follower
        if camera is None or follower is None:
            return ["The camera is off."]
        if camera.is_lost:
            return ["The camera is away. mien waits for it."]
        return [_WORDS[follower.state], *self.meters.words(self._clock())]

    def _run(self, camera: "LiveCamera", follower: "Follower") -> None:
        from mien.capture.person.faces import LandmarkDetector

        try:
            with LandmarkDetector(several_faces=False) as detector:
                camera.start()  # Only now, because the detector takes seconds to load.
                self._follow(camera, follower, detector)
            self.error = camera.error
        except BaseException as error:  # noqa: BLE001
            self.error = error
        self.ended = self.error is not None or camera.ended

    def _follow(self, camera: "LiveCamera", follower: "Follower", detector: "LandmarkDetector") -> None:
        number, frames, last = -1, 0, None
        while not self._stopping.is_set():
            frame = camera.newest(number, 0.04)  # then the avatar goes on to rest
            if frame is None:
                if camera.ended:
                    return
                if last is not None and camera.is_lost:
                    self._show(follower, None, last, self._clock())
                continue
            number, last = frame.number, frame
            for _ in range(camera.frames - frames if frames else 1):
                self.meters.count("camera", frame.seconds)
            frames = camera.frames
            faces = detector.detect(frame.picture)
            self._show(follower, faces[0] if len(faces) else None, frame, frame.seconds)
            self.meters.count("tracking", self._clock())

    def _show(
        self, follower: "Follower", landmarks: Float[np.ndarray, "l 2"] | None, frame: "LiveFrame", seconds: float
    ) -> None:
        height, width = frame.picture.shape[:2]
        face = follower(landmarks, width, height, seconds)
        seen = Seen(frame.picture, seconds)
        self._session.follow(face, seen)
        if self.watch is not None:
            self.watch(seen)
