"""Find where a video cuts to another shot, from its thumbnails."""

import numpy as np
from jaxtyping import Float, UInt8

_CUT_REACH = 3
"""Frames on either side of a cut that must all differ. After a flash, the picture from before it comes back."""
_CUT_NEIGHBOURS = 4
"""Frames on either side of a cut in which the picture may change only a little: motion lasts longer than a cut."""
_MIN_CHANGE = 0.05
"""Smallest change at a cut, as a fraction of the mean brightness."""
_MIN_CONTRAST = 3.0
"""Factor by which the change at a cut exceeds the changes beside it."""
_BLOCKS = (3, 4)
"""Rows and columns of blocks. The change is that of the quarter that changes most, as the head may be small."""


def find_cuts(thumbnails: UInt8[np.ndarray, "t h w 3"]) -> list[int]:
    """Return the numbers of the frames that begin a new shot; 0 is not among them.

    A cut is a change that is much larger than the changes beside it, and that the next frames do not undo. Thumbnails
    are divided by their mean before they are compared, so that switching on a light is no cut.
    """
    pictures = thumbnails.astype(np.float32)
    pictures /= np.maximum(pictures.mean(axis=(1, 2, 3), keepdims=True), 1.0)
    changes = np.array([_difference(*pair) for pair in zip(pictures[:-1], pictures[1:], strict=True)])
    cuts = []
    for index in np.flatnonzero(changes > _MIN_CHANGE).tolist():
        beside = np.concatenate(
            [changes[max(index - _CUT_NEIGHBOURS, 0) : index], changes[index + 1 :][:_CUT_NEIGHBOURS]]
        )
        # The largest neighbour may be the other half of a cut that passes through a blended frame.
        loudest = np.sort(beside)[-2] if len(beside) > 1 else 0.0
        if changes[index] > _MIN_CONTRAST * loudest and _parted(pictures, index + 1) > 0.5 * changes[index]:
            cuts.append(index + 1)
    return cuts


def _parted(pictures: Float[np.ndarray, "t h w 3"], start: int) -> float:
    """Return the smallest difference between a frame shortly before `start` and one shortly after it."""
    before, after = pictures[max(start - _CUT_REACH, 0) : start], pictures[start : start + _CUT_REACH]
    return min(_difference(one, other) for one in before for other in after)


def _difference(one: Float[np.ndarray, "h w 3"], other: Float[np.ndarray, "h w 3"]) -> float:
    rows, columns = _BLOCKS
    height, width = one.shape[0] // rows, one.shape[1] // columns
    difference = np.abs(one - other).mean(axis=-1)[: rows * height, : columns * width]
    blocks = np.sort(difference.reshape(rows, height, columns, width).mean(axis=(1, 3)).ravel())
    return float(blocks[-(rows * columns // 4) :].mean())
