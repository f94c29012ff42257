"""Capture: turn a video of a head into frames, mattes and landmarks."""

from typing import TYPE_CHECKING

from mien.lazy import lazy_names

if TYPE_CHECKING:
    from mien.capture.capture import Capture
    from mien.capture.from_video import capture_video, capture_video_parts
    from mien.capture.quality import FrameQuality
    from mien.capture.settings import CaptureSettings
    from mien.capture.store import read_capture, read_capture_hash, write_capture
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "capture": ["Capture"],
            "from_video": ["capture_video", "capture_video_parts"],
            "quality": ["FrameQuality"],
            "settings": ["CaptureSettings"],
            "store": ["read_capture", "read_capture_hash", "write_capture"],
        },
    )

__all__ = [
    "Capture",
    "CaptureSettings",
    "FrameQuality",
    "capture_video",
    "capture_video_parts",
    "read_capture",
    "read_capture_hash",
    "write_capture",
]
