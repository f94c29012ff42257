"""Corrections of colours by the formula of Cheung 2004, and what a camera films that needs one, without mien."""

import numpy as np

_FIRST, _SECOND, _MIXED = "100 010 001", "110 101 011", "200 020 002"
_TEN = f"{_FIRST} {_SECOND} {_MIXED} 111"
_NINETEEN = f"{_TEN} 210 021 102 201 120 012 300 030 003"
ORDERS = {
    3: _FIRST, 4: f"{_FIRST} 000", 5: f"{_FIRST} 111 000", 7: f"{_FIRST} {_SECOND} 000",
    8: f"{_FIRST} {_SECOND} 111 000", 10: f"{_FIRST} {_SECOND} {_MIXED} 000", 11: f"{_TEN} 000",
    14: f"{_TEN} 300 030 003 000", 16: f"{_TEN} 210 021 102 300 030 003",
    17: f"{_TEN} 210 021 102 300 030 003 000", 19: _NINETEEN, 20: f"{_NINETEEN} 000",
    22: f"{_NINETEEN} 211 121 112",
    35: f"{_NINETEEN} 310 301 130 031 103 013 211 121 112 220 202 022 400 040 004 000",
}  # fmt: skip
"""The terms of each polynomial in order: the powers of red, green and blue."""


def to_light(srgb: np.ndarray) -> np.ndarray:
    """Return linear light of sRGB values, both 0..1."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def to_srgb(light: np.ndarray) -> np.ndarray:
    light = np.clip(light, 0, 1)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def polynomial(light: np.ndarray, matrix: np.ndarray, order: str | None = None) -> np.ndarray:
    """Return the polynomial of light [p, 3], in float64."""
    powers = np.array([[int(digit) for digit in term] for term in (order or ORDERS[matrix.shape[1]]).split()])
    return np.prod(light[:, None, :] ** powers, axis=2) @ matrix.T


def filmed(picture: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Return the sRGB picture whose correction is the given one. Colours beyond what a camera can film are cut off."""
    packed = picture.astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], np.uint32)
    colors, places = np.unique(packed, return_inverse=True)
    aims = to_light((colors[:, None] >> np.array([16, 8, 0], np.uint32) & 255) / 255)
    back, light = np.linalg.inv(matrix[:, :3]).T, aims.copy()
    for _ in range(15):
        light += (aims - polynomial(light, matrix)) @ back
    return np.rint(255 * to_srgb(light)).astype(np.uint8)[places.reshape(picture.shape[:2])]


def correction(seed: int, terms: int = 20) -> np.ndarray:
    """Return a correction [3, n] that brightens, with all terms. Neighbours differ in their sign."""
    random = np.random.default_rng(seed)
    matrix = random.uniform(0.02, 0.06, (3, terms)) * (-1.0) ** np.arange(terms)
    matrix[:, :3] += np.diag(random.uniform(1.2, 1.5, 3))
    if ORDERS[terms].endswith("000"):
        matrix[:, -1] = random.uniform(0, 0.003, 3)
    return matrix
