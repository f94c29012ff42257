"""Step 1: open a source of frames, a video file or a folder of images, and select frames from it."""

import hashlib
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from mien.disk.reading import listed
from mien.errors import UserError
from mien.media.color_correction import ColorCorrection
from mien.media.decoding import check_file_size, decode_picture, may_have_alpha
from mien.media.display import as_matte, over_ground
from mien.media.fields import Deinterlace
from mien.media.lens import Lens
from mien.media.video import LazyFrame, VideoInfo, count_frames, probe_video, read_lazily
from mien.media.video_file import VIDEO_SUFFIXES

IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".webp", ".tif", ".tiff"})


@dataclass(frozen=True)
class FrameSelection:
    """Selection of frames from a source."""

    start: float = 0.0
    """Seconds to skip at the beginning."""
    end: float = 0.0
    """Time at which to stop, in seconds. 0 takes all."""
    stride: int = 1
    """Take every n-th frame."""
    max_frames: int = 0
    """Stop after this many frames. 0 takes all."""
    offset: int = 0
    """Frames at the beginning of the source that do not exist, for a camera that started before the others."""


@dataclass(frozen=True)
class FrameSource:
    """A video file or a folder of images that can be read any number of times, a frame at a time."""

    path: Path
    selection: FrameSelection
    fps: float
    """Frame rate of the frames taken, so after `stride`."""
    expected_frames: int
    """For progress bars. Only reading the source gives the true number."""
    content_hash: str
    """Hash of the file, or of the names and contents of all images."""
    video: VideoInfo
    """What a video states about itself, which is nothing for a folder."""
    quarter_turns: int = 0
    """Number of quarter turns clockwise, besides the file's own rotation flag."""
    deinterlace: Deinterlace = "auto"
    """Which frames of a video are deinterlaced."""
    stream: int | None = None
    """Index of the video's stream that is read. None for a folder."""
    lens: Lens | None = None
    """Lens whose distortion is taken out of the turned pictures."""
    colors: ColorCorrection | None = None
    """Correction of the pictures' colours."""

    def frames(self, longest_side: int = 0) -> Iterator[LazyFrame]:
        """Yield the frames taken. Pictures are shrunk to `longest_side` pixels unless that is 0."""
        if self.path.is_dir():
            everything = _read_images(self.path, self.fps * self.selection.stride, longest_side)
        else:
            everything = read_lazily(self.path, longest_side, self.deinterlace, self.stream)
        taken, candidates, first, origin = 0, 0, 0.0, 0.0
        for frame in everything:
            if frame.number < self.selection.offset:
                continue
            origin = frame.seconds if frame.number == self.selection.offset and frame.number else origin
            seconds = frame.seconds - origin
            if seconds < self.selection.start - 1e-6:
                continue
            if self.selection.end and seconds >= self.selection.end - 1e-6:
                break
            candidates += 1
            if (candidates - 1) % self.selection.stride:
                continue
            first = seconds if taken == 0 else first
            yield self._as_filmed(frame._replace(seconds=seconds - first))
            taken += 1
            if taken == self.selection.max_frames:
                break
        if taken == 0:
            raise UserError(
                f"{self.path}: has no frame after {self.selection.start:g} s; choose an earlier --capture.start"
            )

    def calibrated(self, picture: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
        """Return a turned picture of this camera with corrected colours, as an ideal lens shows it."""
        picture = picture if self.colors is None else self.colors.apply(picture)
        return picture if self.lens is None else self.lens.straighten(picture)

    def _as_filmed(self, frame: LazyFrame) -> LazyFrame:
        """Return the frame with its pictures turned and calibrated."""
        if self.quarter_turns:
            picture, alpha = (partial(_turned, make, self.quarter_turns) for make in (frame.picture, frame.alpha))
            given, step = frame.size, -1 if self.quarter_turns % 2 else 1
            frame = frame._replace(picture=picture, size=lambda: given()[::step], alpha=alpha)
        if self.lens or self.colors:
            make = frame.picture
            frame = frame._replace(picture=lambda: self.calibrated(make()))
        return frame

    def count(self) -> int:
        """Count the frames in the source, with those that the selection leaves out."""
        return len(list_images(self.path)) if self.path.is_dir() else count_frames(self.path, self.stream)


def open_source(
    path: Path,
    selection: FrameSelection,
    fps: float,
    quarter_turns: int = 0,
    deinterlace: Deinterlace = "auto",
    stream: int | None = None,
) -> FrameSource:
    """Open a video, or a folder of images in the natural order of their names, without reading its frames.

    `fps` is for a folder: a video has its own. `stream` is by default that of `mien.media.video_file.find_streams`.
    """
    if path.is_dir():
        images = list_images(path)
        for image in images:
            check_file_size(image)
        info, content_hash = VideoInfo(fps, len(images)), _hash_files(images, with_names=True)
    else:
        info, content_hash = probe_video(path, stream), _hash_files([path], with_names=False)
    fps, total = info.fps, info.frames
    last = min(total, round(selection.end * fps)) if selection.end else total
    last = min(last, max(0, total - selection.offset))
    remaining = max(0, last - round(selection.start * fps))
    expected = -(-remaining // selection.stride)
    if selection.max_frames:
        expected = min(expected, selection.max_frames) if total else selection.max_frames
    fps /= selection.stride
    return FrameSource(path, selection, fps, expected, content_hash, info, quarter_turns, deinterlace, info.stream)


def _turned(picture: Callable[[], np.ndarray | None], quarter_turns: int) -> Any:
    made = picture()
    return made if made is None else np.ascontiguousarray(np.rot90(made, -quarter_turns))


def list_images(folder: Path) -> list[Path]:
    """List the images in a folder, `2.png` before `10.png`."""
    entries = listed(folder)
    images = [path for path in entries if path.suffix.lower() in IMAGE_SUFFIXES and path.is_file()]
    if not images:
        videos = [path for path in entries if path.suffix.lower() in VIDEO_SUFFIXES]
        rig = len(videos) > 1 or any(path.is_dir() for path in entries)
        cameras = "; if it holds those of calibrated cameras, add --calibration FILE" if rig else ""
        remedy = f"give {videos[0]} itself" if videos else "give a video or a folder of .png or .jpg files"
        raise UserError(f"{folder}: holds no images; {remedy}{cameras}")
    # Digits are always at odd positions, so that numbers are only compared with numbers.
    parts = {path: re.split(r"([0-9]+)", path.name) for path in images}
    return sorted(images, key=lambda path: [int(part) if part.isdigit() else part for part in parts[path]])


def read_image(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """Read an 8-bit sRGB picture, turned by its EXIF orientation."""
    image = decode_picture(path, cv2.IMREAD_COLOR_RGB)
    if image is None:
        raise UserError(f"{path}: cannot be read as an image; remove or replace it")
    return image.astype(np.uint8, copy=False)


def _read_with_alpha(path: Path) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]] | None:
    """Read the colours and the alpha of a picture as they are stored; None if it has no alpha or is opaque."""
    if not may_have_alpha(path):
        return None
    image = decode_picture(path, cv2.IMREAD_UNCHANGED)
    if image is None or image.ndim != 3 or image.shape[2] != 4 or image.dtype not in (np.uint8, np.uint16):
        return None
    levels = image if image.dtype == np.uint8 else (image // 257).astype(np.uint8)
    alpha = as_matte(levels[..., 3])
    return None if alpha is None else (levels[..., 2::-1], alpha)


def _read_images(folder: Path, fps: float, longest_side: int) -> Iterator[LazyFrame]:
    shape: tuple[int, ...] | None = None

    def size() -> tuple[int, int]:
        height, width = shape[:2] if shape else read_image(images[0]).shape[:2]
        return width, height

    def read(path: Path) -> np.ndarray:
        nonlocal shape
        with_alpha = _read_with_alpha(path)
        image = read_image(path) if with_alpha is None else over_ground(*with_alpha)
        shape = shape or image.shape
        if image.shape != shape:
            raise UserError(
                f"{path}: is {image.shape[1]}x{image.shape[0]}, but the images before it are {shape[1]}x{shape[0]}; "
                "give images of one size"
            )
        size = shrunk_size(image.shape[1], image.shape[0], longest_side or max(image.shape))
        if size == (image.shape[1], image.shape[0]):
            return image
        return cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)

    def alpha(path: Path) -> np.ndarray | None:
        with_alpha = _read_with_alpha(path)
        return None if with_alpha is None else with_alpha[1]

    images = list_images(folder)
    for index, path in enumerate(images):
        yield LazyFrame(index, index / fps, partial(read, path), size, alpha=partial(alpha, path))


def shrunk_size(width: int, height: int, longest_side: int) -> tuple[int, int]:
    """Return width and height after shrinking to `longest_side` with the same aspect ratio. They never grow."""
    scale = min(1.0, longest_side / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


def _hash_files(paths: list[Path], with_names: bool) -> str:
    digest = hashlib.sha256()
    for path in paths:
        if with_names:
            digest.update(os.fsencode(path.name) + b"\0")
        with path.open("rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()
