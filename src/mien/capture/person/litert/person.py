"""The person in a picture: the network that tells a person from the background."""

import numpy as np
from jaxtyping import Float, UInt8

from mien.capture.person.litert.networks import Network


class PersonNetwork:
    """Finds the person. Each picture is taken by itself."""

    def __init__(self) -> None:
        self._network = Network("person")

    def find(self, image: UInt8[np.ndarray, "256 256 3"]) -> Float[np.ndarray, "256 256"]:
        """Return the probability of a person in each pixel, 0..1."""
        return self._network.run(image.astype(np.float32) / 255)[0][..., 0]
