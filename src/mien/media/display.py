"""Step 1: convert decoded video frames to what an sRGB screen shows (colours, HDR, pixel aspect, rotation)."""

from typing import Any

import av
import numpy as np
from av.sidedata.sidedata import Type as SideDataType
from av.video.reformatter import Interpolation, VideoReformatter
from jaxtyping import UInt8

from mien.errors import UserError
from mien.media.colors import UNSPECIFIED, Colors, ToneMapper, colors_of, is_wide, narrowed
from mien.media.video_file import MAX_FRAME_PIXELS, TOO_MANY_PIXELS

ACCURATE = Interpolation.BICUBIC | Interpolation.FULL_CHR_H_INT | Interpolation.ACCURATE_RND
"""Without accurate rounding swscale is five times faster, but it darkens pictures by a whole level."""
_ASPECT_TOLERANCE = 0.01
_SHRINKING = Interpolation.AREA | Interpolation.ACCURATE_RND


class Display:
    """Converts the frames of one clip. Each frame keeps its own size and shape, as recordings of calls change both."""

    def __init__(
        self, name: str, pixel_aspect: float = 1.0, longest_side: int = 0, container: Colors = UNSPECIFIED
    ) -> None:
        """Prepare. Frames are stretched to square pixels by `pixel_aspect`, the width of a pixel over its height.

        Larger ones are shrunk by areas to a `longest_side` in pixels; 0 keeps the size. The container's colours count.
        """
        self._name = name
        self._pixel_aspect = pixel_aspect
        self._longest_side = longest_side
        self._container = container
        self._reformatter = VideoReformatter()
        self._tone_mappers: dict[int, ToneMapper] = {}
        self._matrix: list[int] | None = None

    def size_of(self, frame: av.VideoFrame) -> tuple[int, int]:
        """Return the width and height in pixels in which the frame is shown if it is not shrunk."""
        width, height = self._shown_size(frame, 0)
        return (height, width) if _swaps_sides(self._display_matrix(frame)) else (width, height)

    def show(self, frame: av.VideoFrame) -> UInt8[np.ndarray, "h w 3"]:
        """Return the frame as an sRGB picture."""
        shown_size = self._shown_size(frame, self._longest_side)
        if not _has_alpha(frame):
            return self._turned(frame, self._converted(frame, *shown_size))
        size = self._shown_size(frame, 0)
        shown = over_ground(self._converted(frame, *size), self._alpha(frame, *size))
        return self._turned(frame, brought_to(shown, shown_size))

    def alpha(self, frame: av.VideoFrame) -> UInt8[np.ndarray, "h w"] | None:
        """Return the alpha of a frame in its size as shown, or None if it has none or is opaque."""
        if not _has_alpha(frame):
            return None
        return as_matte(self._turned(frame, self._alpha(frame, *self._shown_size(frame, 0))))

    def _alpha(self, frame: av.VideoFrame, width: int, height: int) -> UInt8[np.ndarray, "h w"]:
        with_alpha = self._reformatter.reformat(
            frame, width=width, height=height, format="rgba", interpolation=ACCURATE
        )
        return with_alpha.to_ndarray()[..., 3]

    def _converted(self, frame: av.VideoFrame, width: int, height: int) -> UInt8[np.ndarray, "h w 3"]:
        colors = colors_of(frame, self._container)
        same_size = (width, height) == (frame.width, frame.height)
        shrinks = width < frame.width or height < frame.height
        converted = self._reformatter.reformat(
            frame,
            width=width,
            height=height,
            format="rgb48le" if colors.hdr else "rgb24",
            src_colorspace=colors.matrix,
            src_color_range=colors.range,
            interpolation=_SHRINKING if shrinks and not same_size else ACCURATE,
        ).to_ndarray()
        if colors.hdr:
            mapper = self._tone_mappers.setdefault(colors.transfer, ToneMapper(colors.transfer))
            return mapper.to_srgb(converted)
        return narrowed(converted, colors.primaries) if is_wide(colors.primaries) else converted

    def _turned(self, frame: av.VideoFrame, converted: np.ndarray) -> np.ndarray:
        matrix = self._display_matrix(frame)
        return _turn(converted, matrix) if matrix else converted

    def _shown_size(self, frame: av.VideoFrame, longest_side: int) -> tuple[int, int]:
        """Return the size before the frame is turned."""
        square = (frame.width * max(1.0, self._pixel_aspect), frame.height / min(1.0, self._pixel_aspect))
        scale = min(1.0, longest_side / max(square)) if longest_side else 1.0
        width, height = (max(1, round(side * scale)) for side in square)
        if width * height > MAX_FRAME_PIXELS:
            raise UserError(f"{self._name}: is shown with {width}x{height} pixels, {TOO_MANY_PIXELS}; make it smaller")
        return width, height

    def _display_matrix(self, frame: av.VideoFrame) -> list[int]:
        if self._matrix is None:
            self._matrix = _display_matrix(frame)
        return self._matrix


def _has_alpha(frame: av.VideoFrame) -> bool:
    return any(component.is_alpha for component in frame.format.components)


def has_shape(picture: UInt8[np.ndarray, "h w *channels"], size: tuple[int, int]) -> bool:
    """Whether a picture has the aspect ratio of a width and height."""
    return same_shape((picture.shape[1], picture.shape[0]), size)


def same_shape(one: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether two sizes have the same aspect ratio, up to the rounding of their sides."""
    return abs(one[0] * other[1] / (one[1] * other[0]) - 1) <= _ASPECT_TOLERANCE


def brought_to(
    picture: UInt8[np.ndarray, "h w *channels"], size: tuple[int, int]
) -> UInt8[np.ndarray, "h2 w2 *channels"]:
    """Return a picture at a width and height: as it is, shrunk by areas, or enlarged."""
    if (picture.shape[1], picture.shape[0]) == size:
        return picture
    import cv2  # here, because films are written without OpenCV

    shrinks = picture.shape[1] > size[0]
    resized = cv2.resize(picture, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)
    return resized.astype(np.uint8, copy=False)


def _display_matrix(frame: av.VideoFrame) -> list[int]:
    """The upper two rows of the display matrix; empty if the frame has none.

    Call it once per clip: access to a frame's side data makes a reference cycle, and the whole frame then waits for the
    garbage collector.
    """
    side_data: Any = frame.side_data  # PyAV's stub types its keys as strings
    data = side_data.get(SideDataType.DISPLAYMATRIX)
    return [] if data is None else np.frombuffer(bytes(data), np.int32)[:5].tolist()


def _swaps_sides(matrix: list[int]) -> bool:
    return bool(matrix) and abs(matrix[1]) > abs(matrix[0])


def _turn(image: np.ndarray, matrix: list[int]) -> np.ndarray:
    """Rotate and mirror by the display matrix: x' = a x + c y, y' = b x + d y with entries -1, 0 and 1."""
    a, b, _, c, d = matrix
    if _swaps_sides(matrix):
        image = image.swapaxes(0, 1)
        flip_x, flip_y = c < 0, b < 0
    else:
        flip_x, flip_y = a < 0, d < 0
    return np.ascontiguousarray(image[:: -1 if flip_y else 1, :: -1 if flip_x else 1])


GROUND = 128
"""Grey level that replaces what is transparent. Faces are found before it, and soft edges are cleaned of it as of any
even background."""
_NOISE, _FEW = 8, 0.01
"""Levels by which compression lifts premultiplied colours above their alpha, and the share of pixels beyond that."""


def over_ground(colors: UInt8[np.ndarray, "h w 3"], alpha: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Return a picture with alpha over an even grey.

    Colours that are nowhere brighter than their alpha are taken for premultiplied ones: some programs write those, and
    OpenCV makes them of TIFF files.
    """
    if alpha.min() == 255:
        return colors
    soft = (alpha > 0) & (alpha < 255)
    brighter = colors[soft].max(axis=-1, initial=0) > alpha[soft].astype(np.int16) + _NOISE
    share = alpha[..., None].astype(np.float32) / 255
    front = colors * (share > 0 if soft.any() and brighter.mean() < _FEW else share)
    return np.rint(np.minimum(front + (1 - share) * GROUND, 255)).astype(np.uint8)


def as_matte(alpha: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"] | None:
    """Return the alpha, or None if it is opaque everywhere, as it is in many files that have a channel for it."""
    return np.ascontiguousarray(alpha) if alpha.min() < 128 else None
