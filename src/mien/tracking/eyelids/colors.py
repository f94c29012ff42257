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

_EYE_COLORS, _EDGE_COLORS = 6, 8
"""Number of colours in each palette."""
_ROUNDS = 20
_SAMPLES = 20_000
_MIN_SAMPLES = 100
_COLOR_SIGMA, _SKIN_SIGMA = 0.15, 0.15
"""Standard deviations of logarithms of colours. The first is about each colour of a palette. The second is that of
plain skin on the lids, in addition to the spread of the skin around the eye."""
_EDGE_SHARE = 0.1
"""Share of plain skin that may have any colour of the edge palette: moles, folds, make-up."""
_EYE_SHARE = 0.2
"""Share of the edge of a lid that may have any colour of the eyeball palette: lashes are as dark as pupils."""
_ANYTHING = 0.05
"""Density of all other colours, such as reflections and frames of glasses."""


@dataclass(frozen=True, eq=False)
class Palette:
    """A mixture of k isotropic normal distributions of colours."""

    means: Float[np.ndarray, "k 3"]
    shares: Float[np.ndarray, " k"]

    def density(self, colors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Density of each colour, up to a factor that is the same for all densities in this module."""
        return (self.shares * _normal(((colors[:, None] - self.means) ** 2).sum(-1), _COLOR_SIGMA)).sum(1)


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
        skin = np.log((1 - _EDGE_SHARE) * plain + _EDGE_SHARE * edge + _ANYTHING)
        eyeball = self.eyeball.density(crop.colors)
        for_eyeball = np.log(eyeball + _ANYTHING) - skin
        for_edge = np.log((1 - _EYE_SHARE) * edge + _EYE_SHARE * eyeball + _ANYTHING) - skin
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
    if min(len(inside), len(beside)) < _MIN_SAMPLES:
        return None
    spread = float(np.median([crop.spread for crop in crops]))
    return EyeColors(_palette(inside, _EYE_COLORS), _palette(beside, _EDGE_COLORS), (spread**2 + _SKIN_SIGMA**2) ** 0.5)


def _normal(squared: Float[np.ndarray, "..."], sigma: float) -> Float[np.ndarray, "..."]:
    return np.exp(-squared / (2 * sigma**2)) / sigma**3


def _palette(colors: Float[np.ndarray, "n 3"], count: int) -> Palette:
    """A palette found by k-means, which starts from equal parts of the colours in the order of brightness."""
    colors = colors[:: max(len(colors) // _SAMPLES, 1)].astype(np.float64)
    order = np.array_split(colors[colors.sum(1).argsort(kind="stable")], count)
    means = np.stack([part.mean(0) for part in order])
    nearest = np.zeros(len(colors), int)
    for _ in range(_ROUNDS):
        nearest = ((colors[:, None] - means) ** 2).sum(-1).argmin(1)
        means = np.stack([
            colors[nearest == index].mean(0) if (nearest == index).any() else means[index] for index in range(count)
        ])  # fmt: skip
    return Palette(means, np.bincount(nearest, minlength=count) / len(colors))
