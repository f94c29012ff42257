"""Step 4, mattes: made by segmentation, with a clean plate or a screen, or read from files that were made elsewhere.

The segmentation is MediaPipe's network at 256x256, stabilised over time and refined at the picture's full size.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from types import TracebackType

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from mien.capture.person.backend import DetectorChoice, choose_detector
from mien.capture.person.crop import Crop
from mien.capture.person.given import GivenMattes
from mien.capture.person.plate import plate_matte
from mien.capture.person.quiet_mediapipe import load_solution, quiet_mediapipe
from mien.capture.person.screen import screen_matte, screen_of

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

_MODEL_SIZE = 256


class Segmenter:
    """Computes soft person masks of consecutive pictures of one clip. Use as a context manager."""

    def __init__(self, detector: DetectorChoice = "auto") -> None:
        self._detector: DetectorChoice = detector

    def __enter__(self) -> "Segmenter":
        self._stack = ExitStack()
        if choose_detector(self._detector) == "litert":
            from mien.capture.person.litert.person import PersonNetwork

            self._find = PersonNetwork().find
        else:
            self._find = _mediapipe_person(self._stack)
        self._last: tuple[np.ndarray, np.ndarray] | None = None
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._stack.close()

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
    """Map the two levels to 0 and 1, and clip."""
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
        cv2.resize(guide, half, interpolation=cv2.INTER_AREA),
        cv2.resize(values, half, interpolation=cv2.INTER_AREA),
        max(1, radius // 2),
        epsilon,
    )
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


def _screen_or_edges(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    screen = screen_of(image)
    return refine_matte(image, mask) if screen is None else screen_matte(image, mask, screen)


MakeMatte = Callable[[], UInt8[np.ndarray, "h w"]]
"""Computes a matte; the caller chooses when and on which thread."""


class Matting(ABC):
    """Makes the mattes of consecutive cropped pictures."""

    @abstractmethod
    def warm_up(self, image: UInt8[np.ndarray, "h w 3"]) -> None:
        """Process a picture that only prepares the state for the next ones."""

    @abstractmethod
    def prepare(self, number: int, image: UInt8[np.ndarray, "h w 3"]) -> MakeMatte:
        """Return a function that makes the matte of the next picture, which is the source's frame `number`."""


class SegmentedMattes(Matting):
    """The network's mask, refined to the picture's size by `refine(picture, mask)`."""

    def __init__(self, segmenter: Segmenter, refine: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> None:
        self._segmenter = segmenter
        self._refine = refine

    def warm_up(self, image: UInt8[np.ndarray, "h w 3"]) -> None:
        """Update the state that stabilises the next masks."""
        self._segmenter.segment(image)

    def prepare(self, number: int, image: UInt8[np.ndarray, "h w 3"]) -> MakeMatte:
        """Segment now and refine later."""
        return partial(self._refine, image, self._segmenter.segment(image))


class ReadMattes(Matting):
    """Mattes that are read from files."""

    def __init__(self, mattes: GivenMattes, crop: Crop) -> None:
        self._mattes = mattes
        self._crop = crop

    def warm_up(self, image: UInt8[np.ndarray, "h w 3"]) -> None:
        """Do nothing: there is no state."""

    def prepare(self, number: int, image: UInt8[np.ndarray, "h w 3"]) -> MakeMatte:
        """Read the matte now."""
        matte = self._mattes.matte(number, self._crop)
        return lambda: matte


def choose_matting(
    stack: ExitStack,
    crop: Crop,
    plate: UInt8[np.ndarray, "h w 3"] | None,
    mattes: GivenMattes | None,
    detector: DetectorChoice = "auto",
) -> Matting:
    """Return the matting that the user's inputs allow. `stack` closes whatever is opened."""
    if mattes is not None:
        return ReadMattes(mattes, crop)
    segmenter = stack.enter_context(Segmenter(detector))
    refine = _screen_or_edges if plate is None else partial(plate_matte, plate=crop.apply(plate))
    return SegmentedMattes(segmenter, refine)
