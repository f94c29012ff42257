"""Pictures by name from a folder, or in order from a video. Only one is in memory at a time."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from mien.disk.inside import listed
from mien.errors import UserError
from mien.machine.progress import say
from mien.media.decoding import decode_picture
from mien.media.video import read_video_frames

ENDINGS = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")


@dataclass(frozen=True)
class PictureSource:
    """A folder of pictures, or a video."""

    path: Path
    count: int
    names: list[str] | None
    """File names without their endings, in order. None for a video."""
    files: dict[str, Path]
    """Files by name. Empty for a video."""

    def read(self, names: Sequence[str]) -> Iterator[UInt8[np.ndarray, "h w _"]]:
        """Yield the pictures of these names, with 3 or 4 channels. A video's pictures come in order."""
        if self.names is None:
            yield from itertools.islice((picture for _, picture in read_video_frames(self.path)), len(names))
            return
        in_order = len(names) == self.count and any(name not in self.files for name in names)
        for name in self.names if in_order else names:
            yield read_picture(self.files[name])


def open_pictures(path: Path) -> PictureSource:
    """Open the pictures at a path."""
    if path.is_file():
        count = sum(1 for _ in read_video_frames(path))
        say(f"warning: {path}: video compression changes pixels; png pictures give more accurate figures")
        return PictureSource(path, count, None, {})
    if not path.is_dir():
        raise UserError(f"{path}: no such folder; name a folder of pictures, or a video")
    files: dict[str, Path] = {}
    for file in listed(path):
        if file.suffix.lower() not in ENDINGS:
            continue
        if file.stem in files:
            raise UserError(
                f"{path}: contains both {files[file.stem].name} and {file.name}; keep one picture of each name"
            )
        files[file.stem] = file
    if not files:
        raise UserError(f"{path}: contains no picture; give files that end in {', '.join(ENDINGS)}")
    return PictureSource(path, len(files), list(files), files)


def read_picture(path: Path) -> UInt8[np.ndarray, "h w _"]:
    """A picture of 8 bits per channel as RGB or RGBA. Grey becomes RGB."""
    try:
        # libpng would return the upper half of a truncated file.
        cut = path.suffix.lower() == ".png" and _end_of(path) != b"IEND\xaeB`\x82"
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); check the file") from None
    picture = None if cut else decode_picture(path, cv2.IMREAD_UNCHANGED)
    if picture is None:
        raise UserError(f"{path}: is not a complete picture; write it again")
    if picture.dtype != np.uint8:
        raise UserError(f"{path}: has {picture.dtype} values; convert it to 8 bits a channel")
    if picture.ndim == 2:
        return np.repeat(picture[..., None], 3, axis=2)
    order = [2, 1, 0, 3][: picture.shape[2]]
    return np.ascontiguousarray(picture[..., order])


def _end_of(path: Path) -> bytes:
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - 8))
        return file.read(8)
