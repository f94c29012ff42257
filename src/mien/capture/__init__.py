"""Capture: a video of a head becomes frames, mattes and landmarks."""

from mien.capture.capture import Capture
from mien.capture.from_video import CaptureSettings, capture_video
from mien.capture.store import read_capture, read_capture_hash, write_capture

__all__ = ["Capture", "CaptureSettings", "capture_video", "read_capture", "read_capture_hash", "write_capture"]
