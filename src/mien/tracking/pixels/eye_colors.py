"""Colours of a person's eyeballs and of the skin around them, and how well positions of the lids explain a picture.

Two palettes are learned from the clip itself, from frames in which the lids are tracked open: one of the eyeball, one
of its surroundings, with lashes and folds. A position of the lids makes each pixel eyeball, edge of a lid, or plain
skin. Lashes are as dark as irises but occur only near the edge of a lid, so an open eye is not mistaken for a closed
one full of lashes.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from mien.camera import Camera
from mien.render.mesh import rasterize_mesh
from mien.tracking.pixels.eyes import Eye
from mien.tracking.pixels.texture import LEAST_COSINE

_SUPERSAMPLING = 2
"""Multiple of the picture's size at which the mesh is drawn, so that edges of lids can lie between pixels."""
_RING_BLUR = 0.18  # standard deviation of the blur of the ring's colour, in widths of the opening
_LEAST_PIXELS = 12  # fewest pixels of the ring of skin, and of the opening of the eye. With fewer the eye is skipped
_DARKEST = 0.03  # value added to colours (0..1) before the logarithm, so that noise in dark pixels does not matter
_EYE_COLORS = 6  # number of colours in the palette of the eyeball
_EDGE_COLORS = 8  # number of colours in the palette of the edge of the lids
_PALETTE_SAMPLES = 20_000  # largest number of pixels, about, that a palette is learned from
_COLOR_SIGMA = 0.15  # standard deviation of logarithms of colours about each colour of a palette
_SKIN_SIGMA = 0.15
"""The same of plain skin on the lids, in addition to the spread of the skin around the eye. Wider, lids are 0.2 too
open, because lashes are as dark as pupils (log)."""
_EDGE_SHARE = 0.1  # share of plain skin that may have any colour of the edge palette: moles, folds, make-up
_EYE_SHARE = 0.2
"""Share of the edge of a lid that may have any colour of the eyeball palette: lashes are as dark as pupils."""
_OTHER_DENSITY = 0.05  # density of all other colours, such as reflections and frames of glasses


@dataclass(frozen=True, eq=False)
class EyeCrop:
    """The n pixels of a picture that the lids of one eye may cover or uncover."""

    colors: Float[np.ndarray, "n 3"]
    """Logarithms of colours minus those of the skin around the eye. Changes of light cancel in the difference."""
    uncovered: Float[np.ndarray, "k n"]
    """How much of each pixel is eyeball at each position of the lids, 0..1."""
    spread: float
    """Root mean square of the same differences over the skin around the eye."""
    beside: Bool[np.ndarray, " n"]
    """Whether a pixel is neither eyeball nor next to it, at the tracked position of the lids."""
    inside: Bool[np.ndarray, " n"]
    """Whether a pixel is eyeball and not at its edge, at the tracked position of the lids."""


def eye_crop(
    eye: Eye,
    picture: UInt8[np.ndarray, "h w 3"],
    camera: Camera,
    corners: Float[Tensor, "2 n 3"],
    tracked: float,
    positions: list[float],
) -> EyeCrop | None:
    """The pixels of an eye in a picture (sRGB), or None if the picture shows too little of it.

    Args:
        eye: The eye.
        picture: The picture.
        camera: Its camera.
        corners: The eye's vertices in world space with the lids at rest (position 0) and closed (position 1).
        tracked: Tracked position of the lids, on the same scale.
        positions: Possible positions of the lids, the most open first.
    """
    found = _part(picture, camera, corners[0, eye.faces[: eye.ball].flatten().unique()])
    if found is None:
        return None
    image, inside_picture, view = found

    def at(position: float) -> Float[Tensor, "n 3"]:
        return torch.lerp(corners[0], corners[1], position).contiguous()

    sharper = view.resized(view.width * _SUPERSAMPLING, view.height * _SUPERSAMPLING)
    uncovered = np.stack([_uncovered(eye, at(position), sharper) for position in [*positions, tracked]])
    skin, hidden = _around(eye, at(tracked), view)
    opening = uncovered.max(0) > 1 / 64
    difference, spread = _without_skin(np.log(image + np.float32(_DARKEST)), opening, skin & inside_picture)
    kept = opening & ~hidden & inside_picture
    if difference is None or kept.sum() < _LEAST_PIXELS:
        return None
    open_now = uncovered[-1]
    kernel = np.ones((3, 3), np.uint8)
    inside = cv2.erode((open_now > 0.95).astype(np.uint8), kernel) > 0
    beside = cv2.dilate((open_now > 1 / 64).astype(np.uint8), kernel) == 0
    return EyeCrop(difference[kept], uncovered[:-1, kept], spread, beside[kept], inside[kept])


def _part(
    picture: UInt8[np.ndarray, "h w 3"], camera: Camera, ball: Float[Tensor, "b 3"]
) -> tuple[Float[np.ndarray, "ph pw 3"], Bool[np.ndarray, "ph pw"], Camera] | None:
    """The crop around an eyeball, its pixels inside the picture, and its camera. None if it is too small or unseen."""
    points, depth = camera.project(ball)
    if not (depth > 0).all():
        return None
    left, top = (points.amin(0).floor().long() - 2).tolist()
    right, bottom = (points.amax(0).ceil().long() + 2).tolist()
    width, height = right - left, bottom - top
    most = 40  # a wider eyeball, in pixels, is scaled down; one narrower than 20 shows too little
    if width < 20 or left >= camera.width or top >= camera.height or right <= 0 or bottom <= 0:
        return None
    part = picture[max(top, 0) : bottom, max(left, 0) : right]
    after = max(bottom - camera.height, 0), max(right - camera.width, 0)
    pad = ((max(-top, 0), after[0]), (max(-left, 0), after[1]))
    known = np.pad(np.ones(part.shape[:2], np.uint8), pad)
    part = np.pad(part, (*pad, (0, 0)), mode="edge")
    view = camera.cropped(float(left), float(top), width, height)
    if width > most:
        width, height = most, max(round(height * most / width), 1)
        part = cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA)
        known = cv2.resize(known, (width, height), interpolation=cv2.INTER_NEAREST)
        view = view.resized(width, height)
    return part.astype(np.float32) * np.float32(1 / 255), known > 0, view


def _uncovered(eye: Eye, vertices: Float[Tensor, "n 3"], sharper: Camera) -> Float[np.ndarray, "h w"]:
    seen = rasterize_mesh(vertices, eye.moving, sharper, cull_backfaces=True).face_index.numpy()
    ball = ((seen >= 0) & (seen < eye.ball)).astype(np.float32)
    size = sharper.width // _SUPERSAMPLING, sharper.height // _SUPERSAMPLING
    return cv2.resize(ball, size, interpolation=cv2.INTER_AREA)


def _around(
    eye: Eye, vertices: Float[Tensor, "n 3"], view: Camera
) -> tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Which pixels show skin that faces the camera, and which show something that is neither eyeball nor lid."""
    seen = rasterize_mesh(vertices, eye.faces, view).face_index.long()
    triangles = vertices[eye.faces]
    normals = torch.linalg.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    towards = view.position - triangles.mean(1)
    cosine = (normals * towards).sum(1) / (normals.norm(dim=1) * towards.norm(dim=1)).clamp_min(1e-20)
    skin = (seen >= 0) & (eye.skin & (cosine > LEAST_COSINE))[seen.clamp_min(0)]
    return skin.numpy(), (seen >= eye.lids).numpy()


def _without_skin(
    colors: Float[np.ndarray, "h w 3"], opening: Bool[np.ndarray, "h w"], skin: Bool[np.ndarray, "h w"]
) -> tuple[Float[np.ndarray, "h w 3"] | None, float]:
    """Colours minus the smoothed colour of the skin around an opening (None if too little is seen), and its spread."""
    columns = np.flatnonzero(opening.any(axis=0))
    width = max(int(np.ptp(columns)) if len(columns) else 0, 6)
    reach = 2 * max(int(0.3 * width), 3) + 1  # width of the ring of skin around the eye, in widths of the opening
    near, touching = (
        cv2.dilate(opening.astype(np.uint8), np.ones((size, size), np.uint8)) > 0 for size in (reach, 3)
    )  # fmt: skip
    ring = near & ~touching & skin
    if ring.sum() < _LEAST_PIXELS:
        return None, 0.0
    middle = np.median(colors[ring], axis=0)
    away = np.abs(colors - middle).sum(-1)
    # Pixels far from the median colour, such as the frame of glasses, are not skin.
    weight = (ring / (1 + (away / (2 * (np.median(away[ring]) + 0.05))) ** 4)).astype(np.float32)
    summed = cv2.GaussianBlur(colors * weight[..., None], (0, 0), _RING_BLUR * width)
    total = cv2.GaussianBlur(weight, (0, 0), _RING_BLUR * width)[..., None]
    difference = colors - (summed + 1e-4 * middle) / (total + 1e-4)
    spread = float(np.sqrt(((difference**2).sum(-1) * weight).sum() / weight.sum()))
    return difference.astype(np.float32), spread


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
    """Learn the colours of an eye from pictures that are mostly tracked right. None if there are too few pixels."""
    inside, beside = (
        np.concatenate([crop.colors[getattr(crop, name)] for crop in crops] or [np.zeros((0, 3), np.float32)])
        for name in ("inside", "beside")
    )
    if min(len(inside), len(beside)) < 100:  # fewest pixels of each kind that a palette is learned from
        return None
    spread = float(np.median([crop.spread for crop in crops]))
    return EyeColors(_palette(inside, _EYE_COLORS), _palette(beside, _EDGE_COLORS), (spread**2 + _SKIN_SIGMA**2) ** 0.5)


def _normal(squared: Float[np.ndarray, "..."], sigma: float) -> Float[np.ndarray, "..."]:
    return np.exp(-squared / (2 * sigma**2)) / sigma**3


def _palette(colors: Float[np.ndarray, "n 3"], count: int) -> Palette:
    """A palette found by k-means, which starts from equal parts of the colours in the order of brightness."""
    colors = colors[:: max(len(colors) // _PALETTE_SAMPLES, 1)].astype(np.float64)
    order = np.array_split(colors[colors.sum(1).argsort(kind="stable")], count)
    means = np.stack([part.mean(0) for part in order])
    nearest = np.zeros(len(colors), int)
    for _ in range(20):  # rounds in which a palette's colours move to the middle of their pixels
        nearest = ((colors[:, None] - means) ** 2).sum(-1).argmin(1)
        means = np.stack([
            colors[nearest == index].mean(0) if (nearest == index).any() else means[index] for index in range(count)
        ])  # fmt: skip
    return Palette(means, np.bincount(nearest, minlength=count) / len(colors))
