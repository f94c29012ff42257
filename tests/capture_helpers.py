"""Tiny captures and clips made on the fly for the tests of mien.capture."""

from pathlib import Path

import cv2
import numpy as np

from mien.capture import Capture
from mien.capture.video import write_video


def random_capture(timesteps: int = 3, cameras: int = 2, height: int = 20, width: int = 31, seed: int = 0) -> Capture:
    """Noise: what a PNG must keep exactly."""
    random = np.random.default_rng(seed)
    landmarks = random.uniform(0, 20, (timesteps, cameras, 478, 2)).astype(np.float32)
    valid = np.ones((timesteps, cameras), bool)
    valid[1, 0] = False
    landmarks[1, 0] = np.nan
    return Capture(
        name="noise",
        camera_ids=tuple(f"camera{index}" for index in range(cameras)),
        fps=29.97,
        timestamps=np.arange(timesteps) / 29.97,
        images=random.integers(0, 256, (timesteps, cameras, height, width, 3), dtype=np.uint8),
        mattes=random.integers(0, 256, (timesteps, cameras, height, width), dtype=np.uint8),
        landmarks=landmarks,
        valid=valid,
        principal_point=np.full((cameras, 2), 10.5),
        source={"recipe": "noise", "seed": seed},
    )


def assert_same_capture(one: Capture, other: Capture) -> None:
    assert (one.name, one.camera_ids, one.fps, one.source) == (other.name, other.camera_ids, other.fps, other.source)
    for field in ("timestamps", "images", "mattes", "landmarks", "valid", "principal_point"):
        np.testing.assert_array_equal(getattr(one, field), getattr(other, field), err_msg=field)


def tree_bytes(folder: Path) -> dict[str, bytes]:
    """Every file's content but the cache's stamp, which holds times of change."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file() and path.name != "stamp.json")
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def scan_texture(test_data: Path) -> np.ndarray:
    """The Lee Perry-Smith scan's photo texture: a flat, frontal face that the detectors find."""
    path = test_data / "leeperrysmith" / "Map-COL.jpg"
    return cv2.imread(str(path), cv2.IMREAD_COLOR_RGB)


def write_gradient_video(
    path: Path, frames: int = 5, width: int = 64, height: int = 48, fps: float = 25.0
) -> np.ndarray:
    """A clip in which nobody is seen; returns its frames."""
    y, x = np.mgrid[:height, :width]
    pictures = np.stack(
        [np.stack([x * 255 // width, y * 255 // height, (x * 0 + 8 * t) % 256], axis=-1) for t in range(frames)]
    ).astype(np.uint8)
    write_video(path, iter(pictures), fps, crf=1)
    return pictures


def write_face_clip(path: Path, test_data: Path, frames: int = 12, size: tuple[int, int] = (640, 360)) -> np.ndarray:
    """The scan's texture, wandering over a plain picture; returns the texture's centre in each frame, pixels."""
    width, height = size
    face = cv2.resize(scan_texture(test_data), (240, 240), interpolation=cv2.INTER_AREA)
    lefts = 60 + 4 * np.arange(frames)
    pictures = np.full((frames, height, width, 3), 190, np.uint8)
    for picture, left in zip(pictures, lefts, strict=True):
        picture[40:280, left : left + 240] = face
    write_video(path, iter(pictures), 25.0, crf=12)
    return np.stack([lefts + 120, np.full(frames, 160)], axis=-1)
