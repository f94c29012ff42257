"""Take out of a matte what is not the followed person: other people's heads, and things that stand apart from them."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

_MATTE_APART_DISTANCE = 0.02
"""Distance from the person, as a fraction of the longer side, from which a region of the matte is not theirs. Set by
eye on d14 and s18, with the next two."""
_MATTE_APART_MOST_AREA = 0.25
"""Area of such a region, in areas of the person's, up to which it goes: shoulders below a covered neck stay."""
_MATTE_BRIDGE = 0.008
"""Half of the width of what does not join two regions, in longer sides: ends of hair reach to d14's bottle."""

_HALF = 128
"""Opacity from which a pixel belongs to a region. Softer pixels belong to the nearest region."""


def without_others(
    matte: UInt8[np.ndarray, "h w"], face: Float[np.ndarray, " 4"], others: Float[np.ndarray, "f 4"]
) -> UInt8[np.ndarray, "h w"]:
    """Return the matte of the person whose face has this box.

    A region that is apart from the person's goes if it has another face, or is small and far from the person. Where
    people touch, each pixel belongs to the face that is nearer, in units of the faces' sides.

    Args:
        matte: opacity of all people, 255 = person.
        face: box of the person's face in pixels: left, top, right, bottom.
        others: boxes of other faces. Rows of NaN are none.
    """
    radius = round(_MATTE_BRIDGE * max(matte.shape))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    # Without what is thinner than a bridge: ends of hair reach to things behind them.
    solid = cv2.erode((matte >= _HALF).astype(np.uint8), kernel)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(solid)
    regions, areas = labels.astype(np.intp), np.asarray(stats)[:, cv2.CC_STAT_AREA]
    own, touching, gone = _region_in(regions, face), [], np.zeros(count, bool)
    if own == 0:
        return matte
    for box in others[np.isfinite(others[:, 0])]:
        region = _region_in(regions, box)
        if region == own:
            touching.append(box)
        gone[region] = True
    if count > 2:
        distances = cv2.distanceTransform((regions != own).astype(np.uint8), cv2.DIST_L2, 3)
        nearest = np.full(count, np.inf)
        np.minimum.at(nearest, regions.ravel(), np.asarray(distances).ravel())
        is_small = areas < _MATTE_APART_MOST_AREA * areas[own]
        gone |= is_small & (nearest > _MATTE_APART_DISTANCE * max(matte.shape))
    gone[[0, own]] = False
    taken = gone[regions]
    if touching:
        taken |= (regions == own) & (_distance(matte.shape, touching) < _distance(matte.shape, [face]))
    if not taken.any():
        return matte
    keeps = (regions > 0) & ~taken
    to_kept, to_taken = (cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 3) for mask in (keeps, taken))
    return np.where(np.asarray(to_kept) <= np.asarray(to_taken), matte, 0).astype(np.uint8)


def held(others: Float[np.ndarray, "t f 4"], frames: int) -> Float[np.ndarray, "t g 4"]:
    """Return other faces' boxes where each also counts in so many frames before and after, in which it was missed."""
    seen = np.flatnonzero(np.isfinite(others[..., 0]).any(axis=1))
    result = others.copy()
    if len(seen):
        nearest = seen[np.abs(np.arange(len(others))[:, None] - seen).argmin(axis=1)]
        is_near = np.abs(nearest - np.arange(len(others))) <= frames
        result[is_near] = others[nearest[is_near]]
    return result


def _region_in(regions: Int[np.ndarray, "h w"], box: Float[np.ndarray, " 4"]) -> int:
    """Return the region that fills at least half of a box, or 0."""
    left, top, right, bottom = np.clip(np.rint(box), 0, [*regions.shape[::-1], *regions.shape[::-1]]).astype(int)
    inside = np.bincount(regions[top:bottom, left:right].ravel(), minlength=1)
    return int(inside.argmax()) if inside.max() * 2 >= max(inside.sum(), 1) else 0


def _distance(shape: tuple[int, ...], boxes: Sequence[Float[np.ndarray, " 4"]]) -> Float[np.ndarray, "h w"]:
    """Return the distance of each pixel from the nearest face's middle, in sides of that face."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    sides = [max(float(np.sqrt((box[2] - box[0]) * (box[3] - box[1]))), 1.0) for box in boxes]
    return np.min(
        [
            np.hypot(x - (box[0] + box[2]) / 2, y - (box[1] + box[3]) / 2) / side
            for box, side in zip(boxes, sides, strict=True)
        ],
        axis=0,
    )
