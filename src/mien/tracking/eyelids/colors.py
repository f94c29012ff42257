"""Colours of a person's eyeballs and of the skin around them, and how well positions of the lids explain a picture.

Two palettes are learned from the clip itself, from frames in which the lids are tracked open: one of the eyeball, one
of its surroundings, with lashes and folds. A position of the lids makes each pixel eyeball, edge of a lid, or plain
skin. Lashes are as dark as irises but occur only near the edge of a lid, so an open eye is not mistaken for a closed
one full of lashes.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mien.tracking.eyelids.crops import EyeCrop

_EYE_COLORS = 6  # number of colours in the palette of the eyeball
_EDGE_COLORS = 8  # number of colours in the palette of the edge of the lids
_PALETTE_ROUNDS = 20  # rounds in which a palette's colours move to the middle of their pixels
_PALETTE_SAMPLES = 20_000  # largest number of pixels, about, that a palette is learned from
_LEAST_PALETTE_SAMPLES = 100  # fewest pixels of each kind that a palette is learned from
_COLOR_SIGMA = 0.15  # standard deviation of logarithms of colours about each colour of a palette
_SKIN_SIGMA = 0.15
"""The same of plain skin on the lids, in addition to the spread of the skin around the eye. Wider, lids are 0.2 too
open, because lashes are as dark as pupils (log)."""
_EDGE_SHARE = 0.1  # share of plain skin that may have any colour of the edge palette: moles, folds, make-up
_EYE_SHARE = 0.2
"""Share of the edge of a lid that may have any colour of the eyeball palette: lashes are as dark as pupils."""
_OTHER_DENSITY = 0.05  # density of all other colours, such as reflections and frames of glasses


@dataclass(frozen=True, eq=False)
class Palette:
    """A mixture of k isotropic normal distributions of colours."""

    means: Float[np.ndarray, "k 3"]
    shares: Float[np.ndarray, " k"]

    def density(self, colors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Density of each colour, up to a factor that is the same for all densities in this module."""
        squared = ((colors[:, None] - self.means) ** 2).sum(-1)
        return (self.shares * _normal(squared, _COLOR_SIGMA)).sum(1)


@dataclass(frozen=True, eq=False)
class EyeColors:
    """Colours of one eye of one person, as differences of logarithms from the skin around the eye."""

    eyeball: Palette
    edge: Palette
    skin_sigma: float

    def costs(self, crop: EyeCrop, band: int) -> Float[np.ndarray, " k"]:
        """Negative log-likelihood of the pixels at each of the k positions of the lids, up to a constant.

        At each position, pixels that were eyeball up to `band` positions earlier are the edge of the upper lid.
        """
        edge = self.edge.density(crop.colors)
        plain = _normal((crop.colors**2).sum(1), self.skin_sigma)
        skin = np.log((1 - _EDGE_SHARE) * plain + _EDGE_SHARE * edge + _OTHER_DENSITY)
        eyeball = self.eyeball.density(crop.colors)
        for_eyeball = np.log(eyeball + _OTHER_DENSITY) - skin
        for_edge = np.log((1 - _EYE_SHARE) * edge + _EYE_SHARE * eyeball + _OTHER_DENSITY) - skin
        open_now = crop.uncovered
        before = open_now[np.maximum(np.arange(len(open_now)) - band, 0)]
        return -(open_now @ for_eyeball + (before - open_now).clip(0, 1) @ for_edge)


def learn_colors(crops: Sequence[EyeCrop]) -> EyeColors | None:
    """Learn the colours of an eye from pictures, most of which are tracked with about the right position of the lids.

    Returns None if there are too few pixels.
    """
    inside, beside = (
        np.concatenate([crop.colors[getattr(crop, name)] for crop in crops] or [np.zeros((0, 3), np.float32)])
        for name in ("inside", "beside")
    )
    if min(len(inside), len(beside)) < _LEAST_PALETTE_SAMPLES:
        return None
    spread = float(np.median([crop.spread for crop in crops]))
    return EyeColors(
        _palette(inside, _EYE_COLORS),
        _palette(beside, _EDGE_COLORS),
        (spread**2 + _SKIN_SIGMA**2) ** 0.5,
    )


def _normal(squared: Float[np.ndarray, "..."], sigma: float) -> Float[np.ndarray, "..."]:
    return np.exp(-squared / (2 * sigma**2)) / sigma**3


def _palette(colors: Float[np.ndarray, "n 3"], count: int) -> Palette:
    """A palette found by k-means, which starts from equal parts of the colours in the order of brightness."""
    colors = colors[:: max(len(colors) // _PALETTE_SAMPLES, 1)].astype(np.float64)
    order = np.array_split(colors[colors.sum(1).argsort(kind="stable")], count)
    means = np.stack([part.mean(0) for part in order])
    nearest = np.zeros(len(colors), int)
    for _ in range(_PALETTE_ROUNDS):
        nearest = ((colors[:, None] - means) ** 2).sum(-1).argmin(1)
        means = np.stack([
            colors[nearest == index].mean(0) if (nearest == index).any() else means[index] for index in range(count)
        ])  # fmt: skip
    return Palette(means, np.bincount(nearest, minlength=count) / len(colors))
