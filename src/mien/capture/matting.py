"""Which way mattes are made: by segmentation, with a clean plate, or read because they were made elsewhere."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial

import numpy as np
from jaxtyping import UInt8

from mien.capture.crop import Crop
from mien.capture.given import GivenMattes
from mien.capture.matte import Segmenter, refine_matte
from mien.capture.plate import plate_matte

MakeMatte = Callable[[], UInt8[np.ndarray, "h w"]]
"""Computes a matte, when and on which thread the caller likes."""


class Matting(ABC):
    """Makes the mattes of consecutive cropped pictures."""

    @abstractmethod
    def look(self, image: UInt8[np.ndarray, "h w 3"]) -> None:
        """See a picture that only leads to the next ones."""

    @abstractmethod
    def prepare(self, number: int, image: UInt8[np.ndarray, "h w 3"]) -> MakeMatte:
        """The matte of the next picture, which is the source's frame `number`."""


class SegmentedMattes(Matting):
    """The network's mask, brought to the picture's size by `refine(picture, mask)`."""

    def __init__(self, segmenter: Segmenter, refine: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> None:
        self._segmenter = segmenter
        self._refine = refine

    def look(self, image: UInt8[np.ndarray, "h w 3"]) -> None:
        """Steady the next masks."""
        self._segmenter.segment(image)

    def prepare(self, number: int, image: UInt8[np.ndarray, "h w 3"]) -> MakeMatte:
        """Segment now, refine later."""
        return partial(self._refine, image, self._segmenter.segment(image))


class ReadMattes(Matting):
    """Mattes that are there."""

    def __init__(self, mattes: GivenMattes, crop: Crop) -> None:
        self._mattes = mattes
        self._crop = crop

    def look(self, image: UInt8[np.ndarray, "h w 3"]) -> None:
        """Nothing to remember."""

    def prepare(self, number: int, image: UInt8[np.ndarray, "h w 3"]) -> MakeMatte:
        """Read now."""
        matte = self._mattes.matte(number, self._crop)
        return lambda: matte


def choose_matting(
    stack: ExitStack, crop: Crop, plate: UInt8[np.ndarray, "h w 3"] | None, mattes: GivenMattes | None
) -> Matting:
    """What the user's means allow; `stack` closes what it opens."""
    if mattes is not None:
        return ReadMattes(mattes, crop)
    segmenter = stack.enter_context(Segmenter())
    refine = refine_matte if plate is None else partial(plate_matte, plate=crop.apply(plate))
    return SegmentedMattes(segmenter, refine)
