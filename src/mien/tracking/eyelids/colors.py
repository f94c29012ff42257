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

from mien.tracking.constants import TRACKING
from mien.tracking.eyelids.crops import EyeCrop


@dataclass(frozen=True, eq=False)
class Palette:
    """A mixture of k isotropic normal distributions of colours."""

    means: Float[np.ndarray, "k 3"]
    shares: Float[np.ndarray, " k"]

    def density(self, colors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Density of each colour, up to a factor that is the same for all densities in this module."""
        squared = ((colors[:, None] - self.means) ** 2).sum(-1)
        return (self.shares * _normal(squared, TRACKING.eyelids.color_sigma)).sum(1)


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
        known = TRACKING.eyelids
        edge = self.edge.density(crop.colors)
        plain = _normal((crop.colors**2).sum(1), self.skin_sigma)
        skin = np.log((1 - known.edge_share) * plain + known.edge_share * edge + known.other_density)
        eyeball = self.eyeball.density(crop.colors)
        for_eyeball = np.log(eyeball + known.other_density) - skin
        for_edge = np.log((1 - known.eye_share) * edge + known.eye_share * eyeball + known.other_density) - skin
        open_now = crop.uncovered
        before = open_now[np.maximum(np.arange(len(open_now)) - band, 0)]
        return -(open_now @ for_eyeball + (before - open_now).clip(0, 1) @ for_edge)


def learn_colors(crops: Sequence[EyeCrop]) -> EyeColors | None:
    """Learn the colours of an eye from pictures, most of which are tracked with about the right position of the lids.

    Returns None if there are too few pixels.
    """
    known = TRACKING.eyelids
    inside, beside = (
        np.concatenate([crop.colors[getattr(crop, name)] for crop in crops] or [np.zeros((0, 3), np.float32)])
        for name in ("inside", "beside")
    )
    if min(len(inside), len(beside)) < known.least_palette_samples:
        return None
    spread = float(np.median([crop.spread for crop in crops]))
    return EyeColors(
        _palette(inside, known.eye_colors),
        _palette(beside, known.edge_colors),
        (spread**2 + known.skin_sigma**2) ** 0.5,
    )


def _normal(squared: Float[np.ndarray, "..."], sigma: float) -> Float[np.ndarray, "..."]:
    return np.exp(-squared / (2 * sigma**2)) / sigma**3


def _palette(colors: Float[np.ndarray, "n 3"], count: int) -> Palette:
    """A palette found by k-means, which starts from equal parts of the colours in the order of brightness."""
    colors = colors[:: max(len(colors) // TRACKING.eyelids.palette_samples, 1)].astype(np.float64)
    order = np.array_split(colors[colors.sum(1).argsort(kind="stable")], count)
    means = np.stack([part.mean(0) for part in order])
    nearest = np.zeros(len(colors), int)
    for _ in range(TRACKING.eyelids.palette_rounds):
        nearest = ((colors[:, None] - means) ** 2).sum(-1).argmin(1)
        means = np.stack([
            colors[nearest == index].mean(0) if (nearest == index).any() else means[index] for index in range(count)
        ])  # fmt: skip
    return Palette(means, np.bincount(nearest, minlength=count) / len(colors))
