"""The pictures of a clip: one video with the truth and every run side by side, so that all play in step.

One video has one quality, so compression treats all runs alike, and no file size tells which run is which.
"""

import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor

from mien.errors import UserError
from mien.evaluation.experiment import avatar_image, head_box, target_image
from mien.evaluation.metrics import crop_to
from mien.lab.analysis.study.clips import Clip, HeldOut
from mien.media.pictures import WHITE, Box, to_uint8
from mien.media.video import write_video

_CRFS = (16, 18, 20, 22, 24, 26, 28, 30, 33, 36)
"""x264's qualities, best first. The first one that fits is taken."""
VISIBLE_CRF = 28
"""From this quality on, the compression itself may be seen."""


@contextmanager
def drawn_clip(clip: Clip, runs: Sequence[HeldOut], side: int) -> Iterator[UInt8[np.ndarray, "t h w 3"]]:
    """The clip's frames as rows of square tiles: the truth first, then the runs in the order given.

    The frames are in a file that is removed with the context, because long clips take gigabytes.
    """
    folder = Path(tempfile.mkdtemp(prefix="mien-study-"))
    try:
        shape = (clip.timesteps, side, side * (1 + len(runs)), 3)
        frames = np.lib.format.open_memmap(folder / "frames.npy", "w+", np.uint8, shape)
        places = [[run.frames[key] for key in clip.frames()] for run in runs]
        first = places[0]
        box = square(head_box(first[0][0], [frame for _, frame in first]))
        for index in range(clip.timesteps):
            truth = tile(target_image(*first[index]), box, side)
            drawn = [tile(avatar_image(*own[index]), box, side) for own in places]
            frames[index] = np.concatenate([truth, *drawn], axis=1)
        yield frames
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def square(box: Box) -> Box:
    """The smallest square around a box, with the same centre."""
    left, top, width, height = box
    side = max(width, height)
    return left - (side - width) // 2, top - (side - height) // 2, side, side


def tile(image: Float[Tensor, "h w 3"], box: Box, side: int) -> UInt8[np.ndarray, "s s 3"]:
    """The part of a picture inside a square box, white beyond the picture, scaled to `side` pixels."""
    left, top, width, height = box
    cut = to_uint8(crop_to(image, box))
    page = np.full((height, width, 3), WHITE, np.uint8)
    y, x = max(-top, 0), max(-left, 0)
    page[y : y + cut.shape[0], x : x + cut.shape[1]] = cut
    return cv2.resize(page, (side, side), interpolation=cv2.INTER_AREA if side < width else cv2.INTER_CUBIC)


@dataclass(frozen=True)
class Encoded:
    """A clip as mp4 (H.264)."""

    data: bytes
    crf: int


def encode(frames: UInt8[np.ndarray, "t h w 3"], fps: float, most: int, what: str) -> Encoded:
    """The frames as a video of at most `most` bytes, in the best quality that fits."""
    with tempfile.TemporaryDirectory(prefix="mien-study-") as folder:
        path = Path(folder) / "clip.mp4"
        for crf in _CRFS:
            write_video(path, frames, fps, crf)
            if path.stat().st_size <= most:
                return Encoded(path.read_bytes(), crf)
    raise UserError(
        f"{what}: does not fit into the page even at the lowest quality; give more --megabytes, fewer --clips, less "
        "--seconds or a smaller --side"
    )
