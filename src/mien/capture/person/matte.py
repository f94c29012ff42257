"""Step 4, mattes: made by segmentation, with a clean plate or a screen, or read from files that were made elsewhere.

The segmentation is MediaPipe's network at 256x256, stabilised over time and refined at the picture's full size.
"""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from mien.capture.person.backend import DetectorChoice, Networks, load_solution, quiet_mediapipe
from mien.capture.person.crop import Crop
from mien.capture.person.given import GivenMattes
from mien.capture.person.plate import plate_matte, screen_matte, screen_of

_MATTE_STEADINESS = 0.7  # weight of the previous mask where the picture has not changed at all
_MATTE_CHANGE = 0.03  # colour difference (0..1) at which that weight has dropped to 1 / e
_MATTE_RADIUS = 1 / 48  # radius of the guided filter's window, as a fraction of the picture's longer side
_MATTE_EPSILON = 1e-4
"""Variance of colour (0..1) below which the guided filter smooths instead of following edges. Measured: at 1e-6 the
filter is 10 % off on an exactly linear picture, as float32 does not suffice (log)."""
_MATTE_MASK_LEVELS = (0.2, 0.8)
"""Mask values that are background and person for certain. The filter smooths; a soft mask would leave a halo. Chosen by
eye with the next: together they remove the halo and keep curls (log)."""
_MATTE_ALPHA_LEVELS = (0.08, 0.92)
"""Filtered values that become 0 and 1. Without this the filter's overshoot would leave a veil and holes."""

_MODEL_SIZE = 256  # side in pixels of the network's input


class Segmenter(Networks):
    """Computes soft person masks of consecutive pictures of one clip."""

    def _open(self, by_mediapipe: bool) -> None:
        if by_mediapipe:
            self._find = _mediapipe_person(self._stack)
        else:
            from mien.capture.person.litert import Network, find_person

            self._find = partial(find_person, Network("person"))
        self._last: tuple[np.ndarray, np.ndarray] | None = None

    def segment(self, image: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "256 256"]:
        """Return the probability of a person in each part of the picture, 0..1, stabilised by the previous one."""
        small = cv2.resize(image, (_MODEL_SIZE, _MODEL_SIZE), interpolation=cv2.INTER_AREA)
        mask = self._find(small)
        colors = cv2.blur(small, (5, 5)).astype(np.float32) / 255
        if self._last is not None:
            last_mask, last_colors = self._last
            # Blend only where nothing moved: elsewhere the previous mask would leave a ghost.
            change = np.abs(colors - last_colors).max(axis=-1)
            weight = _MATTE_STEADINESS * np.exp(-np.square(change / _MATTE_CHANGE))
            mask = mask + weight * (last_mask - mask)
        self._last = (mask, colors)
        return mask


def _mediapipe_person(stack: ExitStack) -> Callable[[np.ndarray], np.ndarray]:
    module = load_solution("selfie_segmentation")
    with quiet_mediapipe():
        model = stack.enter_context(module.SelfieSegmentation(model_selection=0))
        model.process(np.zeros((_MODEL_SIZE, _MODEL_SIZE, 3), np.uint8))
    return lambda image: model.process(image).segmentation_mask.copy()


def refine_matte(image: UInt8[np.ndarray, "h w 3"], mask: Float[np.ndarray, "256 256"]) -> UInt8[np.ndarray, "h w"]:
    """Return the mask at the picture's size, its border moved onto the picture's edges; 255 = person."""
    height, width = image.shape[:2]
    coarse = cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    ramp = _stretch(coarse, _MATTE_MASK_LEVELS)
    radius = max(2, round(_MATTE_RADIUS * max(width, height)))
    # A smooth step does not shift the border.
    alpha = guided_filter(image.astype(np.float32) / 255, ramp * ramp * (3 - 2 * ramp), radius, _MATTE_EPSILON)
    return np.rint(_stretch(alpha, _MATTE_ALPHA_LEVELS) * 255).astype(np.uint8)


def _stretch(values: Float[np.ndarray, "h w"], levels: tuple[float, float]) -> Float[np.ndarray, "h w"]:
    return np.clip((values - levels[0]) / (levels[1] - levels[0]), 0, 1)


def guided_filter(
    guide: Float[np.ndarray, "h w 3"], values: Float[np.ndarray, "h w"], radius: int, epsilon: float
) -> Float[np.ndarray, "h w"]:
    """Return `values` as a locally affine function of the guide's colour.

    This is eq. 19 of He, Sun, Tang: Guided Image Filtering. It is solved on every second pixel and interpolated (He,
    Sun: Fast Guided Filter, arXiv:1505.00996).
    """
    height, width = values.shape
    half = (max(1, width // 2), max(1, height // 2))
    slope, offset = _affine_fit(
        cv2.resize(guide, half, interpolation=cv2.INTER_AREA), cv2.resize(values, half, interpolation=cv2.INTER_AREA),
        max(1, radius // 2), epsilon,
    )  # fmt: skip
    slope = cv2.resize(slope, (width, height), interpolation=cv2.INTER_LINEAR)
    offset = cv2.resize(offset, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.einsum("hwc,hwc->hw", slope, guide) + offset


def _affine_fit(
    guide: np.ndarray, values: np.ndarray, radius: int, epsilon: float
) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]:
    def mean(image: np.ndarray) -> np.ndarray:
        return cv2.blur(image, (2 * radius + 1, 2 * radius + 1), borderType=cv2.BORDER_REFLECT)

    red, green, blue = guide[..., 0], guide[..., 1], guide[..., 2]
    mean_guide, mean_values = mean(guide), mean(values)
    covariance = mean(guide * values[..., None]) - mean_guide * mean_values[..., None]
    squares = mean(guide * guide) - mean_guide * mean_guide + epsilon
    mixed = mean(np.stack([green * blue, red * blue, red * green], axis=-1))
    mixed -= mean_guide[..., [1, 0, 0]] * mean_guide[..., [2, 2, 1]]
    rr, gg, bb = squares[..., 0], squares[..., 1], squares[..., 2]
    gb, rb, rg = mixed[..., 0], mixed[..., 1], mixed[..., 2]
    # Inverse of the symmetric 3x3 matrix by its cofactors.
    c_rr, c_rg, c_rb = gg * bb - gb * gb, rb * gb - rg * bb, rg * gb - rb * gg
    c_gg, c_gb, c_bb = rr * bb - rb * rb, rg * rb - rr * gb, rr * gg - rg * rg
    determinant = rr * c_rr + rg * c_rg + rb * c_rb
    vr, vg, vb = covariance[..., 0], covariance[..., 1], covariance[..., 2]
    slope = np.stack(
        [c_rr * vr + c_rg * vg + c_rb * vb, c_rg * vr + c_gg * vg + c_gb * vb, c_rb * vr + c_gb * vg + c_bb * vb],
        axis=-1,
    )
    slope /= determinant[..., None]
    offset = mean_values - np.einsum("hwc,hwc->hw", slope, mean_guide)
    return mean(slope), mean(offset)


MakeMatte = Callable[[], UInt8[np.ndarray, "h w"]]
"""Computes a matte; the caller chooses when and on which thread."""


PrepareMatte = Callable[[int, UInt8[np.ndarray, "h w 3"]], MakeMatte]
"""Returns what makes the matte of the next cropped picture, which is the source's frame of that number."""


def choose_matting(
    stack: ExitStack, crop: Crop, plate: UInt8[np.ndarray, "h w 3"] | None, mattes: GivenMattes | None,
    detector: DetectorChoice = "auto",
) -> PrepareMatte:  # fmt: skip
    """Return the matting that the user's inputs allow. `stack` closes whatever is opened."""
    if mattes is not None:

        def read(number: int, image: np.ndarray) -> MakeMatte:
            matte = mattes.matte(number, crop)
            return lambda: matte

        return read
    segmenter = stack.enter_context(Segmenter(detector))
    scene = None if plate is None else crop.apply(plate)

    def refine(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
        if scene is not None:
            return plate_matte(image, mask, scene)
        screen = screen_of(image)
        return refine_matte(image, mask) if screen is None else screen_matte(image, mask, screen)

    return lambda number, image: partial(refine, image, segmenter.segment(image))


_MATTE_APART_DISTANCE = 0.02
"""Distance from the person, as a fraction of the longer side, from which a region of the matte is not theirs. Set by
eye on d14 and s18, with the next two."""
_MATTE_APART_MOST_AREA = 0.25
"""Area of such a region, in areas of the person's, up to which it goes: shoulders below a covered neck stay."""
_MATTE_BRIDGE = 0.008
"""Half of the width of what does not join two regions, in longer sides: ends of hair reach to d14's bottle."""


def without_others(
    matte: UInt8[np.ndarray, "h w"], face: Float[np.ndarray, " 4"], others: Float[np.ndarray, "f 4"]
) -> UInt8[np.ndarray, "h w"]:
    """Return the matte of the person whose face has this box.

    A region that is apart from the person's goes if it has another face, or is small and far from the person. Where
    people touch, each pixel belongs to the face that is nearer, in units of the faces' sides. Boxes are left, top,
    right, bottom in pixels; rows of NaN in `others` are none.
    """
    radius = round(_MATTE_BRIDGE * max(matte.shape))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    # Regions are of pixels that are half opaque, without what is narrower than a bridge: ends of hair reach to things
    # behind them. Softer pixels belong to the nearest region.
    solid = cv2.erode((matte >= 128).astype(np.uint8), kernel)
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
