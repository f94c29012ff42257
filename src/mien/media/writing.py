"""Pictures as files, by the ending of a path: one .png, numbered .png files, .mp4, or .webm.

Transparent pictures have four channels with straight (not premultiplied) colours, because PNG requires that and players
expect it for the alpha of a VP9 .webm. An .mp4 has no transparency. Of the packages of the extras, an .mp4 needs PyAV
alone.
"""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from mien.disk.files import cannot_write
from mien.media.output import Output
from mien.media.video import encode, write_video

_FRINGE = 8
"""Distance in pixels over which colours are spread beyond the opaque part: video halves the resolution of colour."""
_WEBM_QUALITY = 24  # VP9's constant quality, from 0 (lossless) to 63 (worst)


def write_pictures(
    output: Output,
    pictures: Iterable[UInt8[np.ndarray, "h w _"]],
    fps: int | float,
    sound: tuple[Path, float] | None = None,
) -> None:
    """Write pictures of one size, each file atomically. An .mp4 may have a file's sound, for a length in seconds."""
    try:
        if output.kind == "mp4":
            write_video(output.path, pictures, fps, sound=sound)
        elif output.kind == "webm":
            options = {"crf": str(_WEBM_QUALITY), "b": "0", "deadline": "good", "cpu-used": "4", "row-mt": "1"}
            if output.transparent:
                # libvpx does not support alternate reference frames together with alpha.
                options["auto-alt-ref"] = "0"
                pictures = map(_spread_colors, pictures)
            encode(output.path, pictures, fps, "libvpx-vp9", options)
        else:
            from mien.media.picture_files import write_png

            for index, picture in enumerate(pictures):
                write_png(output.path if output.kind == "still" else output.numbered(index), picture)
    except OSError as error:
        raise cannot_write(output.path, error) from None


def _spread_colors(picture: UInt8[np.ndarray, "h w 4"]) -> UInt8[np.ndarray, "h w 4"]:
    """The picture with the colours at its outline continued outwards, where alpha is low and hides them.

    Video keeps colour at half the resolution and blurs it. Without this, black would bleed into outlines.
    """
    import cv2

    alpha = picture[..., 3:].astype(np.float32)
    size = (2 * _FRINGE + 1, 2 * _FRINGE + 1)
    weights = cv2.blur(alpha, size)[..., None]
    around = cv2.blur(picture[..., :3] * alpha, size) / np.maximum(weights, 1e-6)
    seen = alpha > 127
    return np.concatenate([np.where(seen, picture[..., :3], around + 0.5).astype(np.uint8), picture[..., 3:]], axis=2)
