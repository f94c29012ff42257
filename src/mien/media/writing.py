"""Pictures as files, by the ending of a path: one .png, numbered .png files, .mp4, or .webm.

Transparent pictures have four channels with straight (not premultiplied) colours, because PNG requires that and players
expect it for the alpha of a VP9 .webm. An .mp4 has no transparency. Of the packages of the extras, an .mp4 needs PyAV
alone.
"""

import itertools
from collections.abc import Iterable, Iterator
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.video.reformatter import ColorRange, Colorspace, VideoReformatter
from jaxtyping import UInt8

from mien.disk.files import cannot_write, write_atomically
from mien.errors import UserError
from mien.media.output import Output
from mien.media.video import write_video
from mien.media.video_file import create_video

_FRINGE = 8
"""Distance in pixels over which colours are spread beyond the opaque part: video halves the resolution of colour."""
_WEBM_QUALITY = 24
"""VP9's constant quality, from 0 (lossless) to 63 (worst)."""


def write_pictures(
    output: Output,
    pictures: Iterable[UInt8[np.ndarray, "h w _"]],
    fps: int | float,
    sound: tuple[Path, float] | None = None,
) -> None:
    """Write pictures (RGB, or RGBA if `output.transparent`), all of one size. Each file is written atomically.

    An .mp4 may have the sound of a file, for a length in seconds.
    """
    try:
        if output.kind == "mp4":
            write_video(output.path, pictures, fps, sound=sound)
        elif output.kind == "webm":
            _write_webm(output, pictures, fps)
        else:
            from mien.media.picture_files import write_png

            for index, picture in enumerate(pictures):
                write_png(output.path if output.kind == "still" else output.numbered(index), picture)
    except OSError as error:
        raise cannot_write(output.path, error) from None


def _write_webm(output: Output, pictures: Iterable[np.ndarray], fps: int | float) -> None:
    iterator = iter(pictures)
    first = next(iterator, None)
    if first is None:
        raise UserError(f"{output.path}: there are no frames to write; check the selection of frames")
    everything = itertools.chain([first], iterator)
    write_atomically(output.path, lambda aside: _encode_webm(aside, everything, first.shape, fps))


def _encode_webm(path: Path, pictures: Iterator[np.ndarray], shape: tuple[int, ...], fps: int | float) -> None:
    """Encode VP9 in BT.709, yuva420p if there is alpha. Odd sizes get a repeated last row or column."""
    height, width, channels = shape
    options = {"crf": str(_WEBM_QUALITY), "b": "0", "deadline": "good", "cpu-used": "4", "row-mt": "1"}
    if channels == 4:
        # libvpx does not support alternate reference frames together with alpha.
        options["auto-alt-ref"] = "0"
    with create_video(path) as container:
        stream = container.add_stream("libvpx-vp9", rate=Fraction(fps).limit_denominator(1001), options=options)
        stream.width, stream.height = width + width % 2, height + height % 2
        stream.pix_fmt = "yuva420p" if channels == 4 else "yuv420p"
        context = stream.codec_context
        context.colorspace = context.color_primaries = context.color_trc = 1
        context.color_range = ColorRange.MPEG
        reformatter = VideoReformatter()
        for picture in pictures:
            assert picture.shape == shape, f"frames of {shape}, then one of {picture.shape}"
            full = _spread_colors(picture) if channels == 4 else picture
            even = np.pad(full, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
            frame = reformatter.reformat(
                av.VideoFrame.from_ndarray(np.ascontiguousarray(even), format="rgba" if channels == 4 else "rgb24"),
                format=stream.pix_fmt,
                dst_colorspace=Colorspace.ITU709,
                dst_color_range=ColorRange.MPEG,
            )
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


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
