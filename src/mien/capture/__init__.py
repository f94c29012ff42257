"""Capture: a video of a head becomes frames, mattes and landmarks."""

from mien.capture.capture import Capture
from mien.capture.from_video import capture_video, capture_video_parts
from mien.capture.quality import FrameQuality
from mien.capture.settings import CaptureSettings
from mien.capture.store import read_capture, read_capture_hash, write_capture

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
