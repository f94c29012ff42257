"""Step 1: convert decoded video frames to what an sRGB screen shows (colours, HDR, pixel aspect, rotation)."""

from typing import Any

import av
import numpy as np
from av.sidedata.sidedata import Type as SideDataType
from av.video.reformatter import Interpolation, VideoReformatter
from jaxtyping import UInt8

from mien.capture.colors import UNSPECIFIED, Colors, colors_of
from mien.capture.tone import ToneMapper
from mien.capture.video_file import MAX_FRAME_PIXELS, TOO_MANY_PIXELS
from mien.errors import UserError

ACCURATE = Interpolation.BICUBIC | Interpolation.FULL_CHR_H_INT | Interpolation.ACCURATE_RND
"""Without accurate rounding swscale is five times faster, but it darkens pictures by a whole level."""
_SHRINKING = Interpolation.AREA | Interpolation.ACCURATE_RND
_ASPECT_TOLERANCE = 0.01


class Display:
    """Converts the frames of one clip to one size, which the first frame decides."""

    def __init__(
        self, name: str, pixel_aspect: float = 1.0, longest_side: int = 0, container: Colors = UNSPECIFIED
    ) -> None:
        """Create the converter of one clip.

        Args:
            name: name of the clip, for messages.
            pixel_aspect: width of a pixel over its height. Frames are stretched, never shrunk, to square pixels.
            longest_side: side in pixels to which larger pictures are shrunk (area-averaged). 0 keeps the size.
            container: colours that the clip's container states.
        """
        self._name = name
        self._pixel_aspect = pixel_aspect
        self._longest_side = longest_side
        self._container = container
        self._reformatter = VideoReformatter()
        self._tone_mappers: dict[int, ToneMapper] = {}
        self._matrix: list[int] = []
        self._stored_size = (0, 0)
        self._size = (0, 0)

    def show(self, frame: av.VideoFrame) -> UInt8[np.ndarray, "h w 3"]:
        """Return the frame as an sRGB picture.

        Raises:
            UserError: the aspect ratio differs from that of earlier frames, or the converted frame has too many pixels.
        """
        self._fit(frame)
        colors = colors_of(frame, self._container)
        same_size = self._size == (frame.width, frame.height)
        shrinks = self._size[0] < frame.width or self._size[1] < frame.height
        converted = self._reformatter.reformat(
            frame,
            width=self._size[0],
            height=self._size[1],
            format="rgb48le" if colors.hdr else "rgb24",
            src_colorspace=colors.matrix,
            src_color_range=colors.range,
            interpolation=_SHRINKING if shrinks and not same_size else ACCURATE,
        ).to_ndarray()
        if colors.hdr:
            mapper = self._tone_mappers.setdefault(colors.transfer, ToneMapper(colors.transfer))
            converted = mapper.to_srgb(converted)
        return _turn(converted, self._matrix) if self._matrix else converted

    def _fit(self, frame: av.VideoFrame) -> None:
        """Choose the size at the first frame. Later frames may have another resolution, but no other aspect ratio."""
        stored = (frame.width, frame.height)
        if stored == self._stored_size:
            return
        if self._stored_size == (0, 0):
            self._stored_size = stored
            self._matrix = _display_matrix(frame)
            self._size = _display_size(*stored, self._pixel_aspect, self._longest_side)
            if self._size[0] * self._size[1] > MAX_FRAME_PIXELS:
                shown = f"{self._size[0]}x{self._size[1]}"
                raise UserError(f"{self._name}: is shown with {shown} pixels, {TOO_MANY_PIXELS}; make it smaller")
        elif abs(stored[0] / stored[1] / (self._stored_size[0] / self._stored_size[1]) - 1) > _ASPECT_TOLERANCE:
            before = f"{self._stored_size[0]}x{self._stored_size[1]}"
            raise UserError(
                f"{self._name}: the picture changes from {before} to {stored[0]}x{stored[1]}; "
                "cut the video there and capture each piece"
            )


def _display_size(width: int, height: int, pixel_aspect: float, longest_side: int) -> tuple[int, int]:
    square = (width * max(1.0, pixel_aspect), height / min(1.0, pixel_aspect))
    scale = min(1.0, longest_side / max(square)) if longest_side else 1.0
    return max(1, round(square[0] * scale)), max(1, round(square[1] * scale))


def _display_matrix(frame: av.VideoFrame) -> list[int]:
    """The upper two rows of the display matrix; empty if the frame has none.

    Call it once per clip: access to a frame's side data makes a reference cycle, and the whole frame then waits for the
    garbage collector.
    """
    side_data: Any = frame.side_data  # PyAV's stub types its keys as strings
    data = side_data.get(SideDataType.DISPLAYMATRIX)
    return [] if data is None else np.frombuffer(bytes(data), np.int32)[:5].tolist()


def _turn(image: np.ndarray, matrix: list[int]) -> np.ndarray:
    """Rotate and mirror by the display matrix: x' = a x + c y, y' = b x + d y with entries -1, 0 and 1."""
    a, b, _, c, d = matrix
    if abs(b) > abs(a):
        image = image.swapaxes(0, 1)
        flip_x, flip_y = c < 0, b < 0
    else:
        flip_x, flip_y = a < 0, d < 0
    return np.ascontiguousarray(image[:: -1 if flip_y else 1, :: -1 if flip_x else 1])
