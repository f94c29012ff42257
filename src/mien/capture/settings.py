"""Settings of a capture."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from mien.capture.person.backend import DetectorChoice
from mien.disk.reading import MAX_SIDE
from mien.errors import UserError


@dataclass(frozen=True)
class CaptureSettings:
    """Settings of the capture: how a video becomes frames, mattes and landmarks."""

    size: int = 512
    """Longest side of the captured frames in pixels. Smaller sources are not enlarged."""
    crop: Literal["auto", "none"] = "auto"
    """auto: a square around the head, the same for the whole clip. none: the whole picture."""
    start: float = 0.0
    """Seconds to skip at the beginning."""
    end: float = 0.0
    """Time in the video at which to stop, in seconds. 0 captures to the end."""
    turn: Literal[0, 90, 180, 270] = 0
    """Degrees to turn the pictures clockwise, for a video whose rotation flag was lost."""
    stream: int | None = None
    """Index of the stream to capture, in a video file that has several, as FFmpeg counts them from 0. By default, it is
    the one that the file marks as default, or else the one with most pixels."""
    stride: int = 1
    """Take every n-th frame: 2 takes half of them."""
    max_frames: int = 0
    """Stop after this many frames. 0 takes all."""
    fps: float = 25.0
    """Frame rate of a folder of pictures, in frames per second. Videos have their own."""
    cuts: bool = True
    """By default, the video is split at cuts to another shot, into NAME-1, NAME-2, ... --capture.no-cuts keeps
    it whole."""
    shortest_part: float = 1.0
    """Shortest shot to keep in a video with cuts, in seconds. Shorter shots are left out."""
    person: int = 1
    """Whom to keep of a video that cuts between people: 1 is the person in most frames, 2 the next. 0 takes all for one
    person, and does not compare them with other videos of the workspace."""
    deinterlace: Literal["auto", "always", "never"] = "auto"
    """Which frames of an interlaced video become progressive pictures, one for each frame. auto: those that are marked
    as interlaced. always: all, for a video that lost the mark. never: none, for one that was filmed progressively."""
    clean_plate: Path | None = None
    """A picture of the scene without the person, from the same camera in the same place. It gives better mattes."""
    mattes: Path | None = None
    """Mattes made elsewhere: a video or a folder of pictures, one for each frame of the source. White is the person."""
    landmarks: Path | None = None
    """Landmarks made elsewhere, a row for each frame of the source: .csv or .safetensors, all 478 or the 68 of 300-W
    (docs/conventions.md)."""

    detector: DetectorChoice = "auto"
    """Library that runs the networks for face and person. auto: mediapipe if installed, otherwise litert."""

    def check(self) -> None:
        """Raise a UserError for the first value that is not allowed."""
        later = self.end == 0 or (math.isfinite(self.end) and self.end > self.start)
        for holds, option, value, remedy in (
            (self.size >= 32, "size", self.size, "too small; give 32 or more, better 512"),
            (self.size <= MAX_SIDE, "size", self.size, f"too large; give {MAX_SIDE} or less"),
            (0 <= self.start < math.inf, "start", self.start, "give the seconds to skip, 0 or more"),
            (later, "end", self.end, f"give a time after --capture.start ({self.start:g}), or 0 for all"),
            (self.stream is None or self.stream >= 0, "stream", self.stream or 0, "give an index, 0 or more"),
            (self.stride >= 1, "stride", self.stride, "give 1 for every frame, 2 for every second one, ..."),
            (self.max_frames >= 0, "max-frames", self.max_frames, "give 0 for all frames, or a positive number"),
            (0 < self.fps < math.inf, "fps", self.fps, "give frames per second, above 0"),
            (0 <= self.shortest_part < math.inf, "shortest-part", self.shortest_part, "give seconds, 0 or more"),
            (self.person >= 0, "person", self.person, "give 1 for the person in most frames, 2, 3, ..., or 0 for all"),
        ):
            if not holds:
                raise UserError(f"--capture.{option} {value:g}: {remedy}")
        if self.mattes is not None and self.clean_plate is not None:
            raise UserError("--capture.mattes and --capture.clean-plate: give one of them; ready mattes need no plate")
        for option in ("clean_plate", "mattes", "landmarks"):
            path: Path | None = getattr(self, option)
            if path is not None and not path.exists():
                name = option.replace("_", "-")
                raise UserError(f"--capture.{name} {path}: no such file or folder; check the path")
