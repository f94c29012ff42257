"""Choose how mattes are made: by segmentation, with a clean plate, or read from files that were made elsewhere."""

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
"""Computes a matte; the caller chooses when and on which thread."""


class Matting(ABC):
    """Makes the mattes of consecutive cropped pictures."""

    @abstractmethod
    def look(self, image: UInt8[np.ndarray, "h w 3"]) -> None:
        """Process a picture that only prepares the state for the next ones."""

    @abstractmethod
    def prepare(self, number: int, image: UInt8[np.ndarray, "h w 3"]) -> MakeMatte:
        """Return a function that makes the matte of the next picture, which is the source's frame `number`."""


class SegmentedMattes(Matting):
    """The network's mask, refined to the picture's size by `refine(picture, mask)`."""

    def __init__(self, segmenter: Segmenter, refine: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> None:
        self._segmenter = segmenter
        self._refine = refine

    def look(self, image: UInt8[np.ndarray, "h w 3"]) -> None:
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

    def look(self, image: UInt8[np.ndarray, "h w 3"]) -> None:
        """Do nothing: there is no state."""

    def prepare(self, number: int, image: UInt8[np.ndarray, "h w 3"]) -> MakeMatte:
        """Read the matte now."""
        matte = self._mattes.matte(number, self._crop)
        return lambda: matte


def choose_matting(
    stack: ExitStack, crop: Crop, plate: UInt8[np.ndarray, "h w 3"] | None, mattes: GivenMattes | None
) -> Matting:
    """Return the matting that the user's inputs allow. `stack` closes whatever is opened."""
    if mattes is not None:
        return ReadMattes(mattes, crop)
    segmenter = stack.enter_context(Segmenter())
    refine = refine_matte if plate is None else partial(plate_matte, plate=crop.apply(plate))
    return SegmentedMattes(segmenter, refine)
