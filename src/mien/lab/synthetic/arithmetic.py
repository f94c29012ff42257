"""Arithmetic of the drawing: directions, ramps, and solid noise, which is a random function of a point in space."""

import numpy as np
from jaxtyping import Float

from mien.machine.exact import dot

_PERIOD = 32  # lattice cells after which the noise repeats; a power of two


class SolidNoise:
    """Smooth random functions of space with a mean near zero and values in -1..1. The seed decides them."""

    def __init__(self, seed: int) -> None:
        self._lattice = np.random.default_rng(seed).uniform(-1, 1, (_PERIOD,) * 3).astype(np.float32)

    def __call__(self, points: Float[np.ndarray, "n 3"], wavelength: float) -> Float[np.ndarray, " n"]:
        """Return value noise with this lattice spacing, in the points' unit."""
        scaled = points.astype(np.float64) / wavelength
        cell = np.floor(scaled)
        fraction = (scaled - cell).astype(np.float32)
        fraction *= fraction * (3 - 2 * fraction)
        index = cell.astype(np.int64) & (_PERIOD - 1)
        above = (index + 1) & (_PERIOD - 1)
        flat = self._lattice.reshape(-1)
        corners = [
            (index[:, axis] * _PERIOD ** (2 - axis), above[:, axis] * _PERIOD ** (2 - axis)) for axis in range(3)
        ]
        fx, fy, fz = fraction.T
        planes = []
        for x in corners[0]:
            lines = []
            for y in corners[1]:
                start, end = flat[x + y + corners[2][0]], flat[x + y + corners[2][1]]
                lines.append(start + fz * (end - start))
            planes.append(lines[0] + fy * (lines[1] - lines[0]))
        return planes[0] + fx * (planes[1] - planes[0])

    def octaves(self, points: Float[np.ndarray, "n 3"], wavelength: float, count: int) -> Float[np.ndarray, " n"]:
        """Return the sum of `count` noises, each with half the wavelength and half the strength of the previous one."""
        total = np.zeros(len(points), np.float32)
        for octave in range(count):
            shifted = points + 17.31 * wavelength * octave  # so that the lattices of two octaves do not coincide
            total += 0.5**octave * self(shifted, wavelength / 2**octave)
        return total


def smoothstep(low: float | np.floating, high: float | np.floating, value: np.ndarray) -> np.ndarray:
    """Return 0 below `low`, 1 above `high`, and a smooth ramp between. It falls if `low` > `high`."""
    t = np.clip((value - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Return the vectors scaled to length 1."""
    return vectors * (1 / np.sqrt(dot(vectors, vectors) + 1e-20))[..., None]


def along(vectors: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return scalar products with one direction, in the dtype of `vectors`."""
    x, y, z = direction.tolist()
    return vectors[..., 0] * x + vectors[..., 1] * y + vectors[..., 2] * z
