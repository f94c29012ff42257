"""Names of cameras on the command line: `camera`, `camera:/dev/video0`, `camera:clip.mp4`, `camera:rtsp://host/live`."""

import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from mien.errors import UserError

CameraFormat = Literal["v4l2", "avfoundation", "dshow"]
"""FFmpeg's names of what reads cameras, on Linux, macOS and Windows."""
_FORMATS: dict[str, CameraFormat] = {"linux": "v4l2", "darwin": "avfoundation", "win32": "dshow"}
_FIRST: dict[CameraFormat, str] = {"v4l2": "/dev/video0", "avfoundation": "0", "dshow": "video=0"}
"""The device that `camera` alone means."""
DEVICES = Path("/dev")
"""The folder of the devices of Linux."""
_STREAM = re.compile(r"(rtsp|rtsps|rtmp|http|https|udp|rtp|srt|tcp)://", re.IGNORECASE)


@dataclass(frozen=True)
class CameraName:
    """A camera that FFmpeg can open."""

    device: str
    """The device, the file or the address."""
    format: CameraFormat

    @property
    def is_stream(self) -> bool:
        """Whether it is an address."""
        return _STREAM.match(self.device) is not None

    @property
    def is_file(self) -> bool:
        """Whether it is a file, which plays in real time."""
        return not self.is_stream and Path(self.device).is_file()

    def __str__(self) -> str:
        return f"camera:{self.device}"


def is_camera(by: str) -> bool:
    """Whether the driver of `--by` is a camera."""
    return by == "camera" or by.startswith("camera:")


def camera_named(by: str, camera_format: CameraFormat | None) -> CameraName:
    """The camera of `--by`: `camera`, or `camera:` with a device, a file or an address."""
    chosen = camera_format or _FORMATS.get(sys.platform, "v4l2")
    cameras = _listed() if chosen == "v4l2" else []
    device = by.removeprefix("camera:") if ":" in by else str([*cameras, _FIRST[chosen]][0])
    if not device:
        raise UserError(f"--by {by}: names no camera; give camera alone, camera:/dev/video0, or camera:clip.mp4")
    name = CameraName(device, chosen)
    path = Path(device)
    if path.is_dir():
        raise UserError(f"--by {by}: {device} is a folder; give a device, a video file or an address")
    if not name.is_stream and chosen == "v4l2" and not path.exists():
        raise UserError(f"--by {by}: there is no {device}; {remedy()}")
    return name


def devices() -> list[str]:
    """The video devices of this machine with their names, as far as the system lists them as files (Linux)."""
    return [f"{path}{_title(path.name)}" for path in _listed()]


def _listed() -> list[Path]:
    return sorted(DEVICES.glob("video[0-9]*"), key=lambda path: (len(path.name), path.name))


def remedy() -> str:
    """What a message advises if a camera cannot be opened."""
    found = devices()
    if found:
        return f"give camera: and one of these: {', '.join(found)}"
    return (
        "no camera was found on this machine; connect one, check that you may read it (on Linux, be in the group "
        "video), or let a video file play as a camera: --by camera:clip.mp4"
    )


def _title(device: str) -> str:
    try:
        return f" ({(Path('/sys/class/video4linux') / device / 'name').read_text().strip()})"
    except OSError:
        return ""
