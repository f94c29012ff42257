"""Mattes of datasets that have none: the network of `mien capture`, with or without a picture of the empty scene."""

from functools import partial

import numpy as np
from jaxtyping import UInt8

from mien.capture.person.matte import Segmenter, refine_matte
from mien.capture.person.plate import plate_matte
from mien.machine.progress import progress_bar


def fill_mattes(
    images: UInt8[np.ndarray, "t c h w 3"],
    mattes: UInt8[np.ndarray, "t c h w"],
    plate: UInt8[np.ndarray, "h w 3"] | None = None,
) -> None:
    """Write the opacity of the person in each picture into `mattes`; 255 is the person.

    Args:
        images: Decoded sRGB pixels.
        mattes: The array to write into.
        plate: A picture of the scene without the person, from the same place. None if there is none.
    """
    refine = refine_matte if plate is None else partial(plate_matte, plate=plate)
    for camera in range(images.shape[1]):
        with Segmenter() as segmenter, progress_bar("matting", len(images)) as advance:
            for timestep in range(len(images)):
                picture = np.ascontiguousarray(images[timestep, camera])
                mattes[timestep, camera] = refine(picture, segmenter.segment(picture))
                advance()
