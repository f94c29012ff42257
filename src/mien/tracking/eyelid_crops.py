"""What a picture shows where an eye may be open: colours, and how much of each pixel is eyeball as the lids move."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from mien.camera import Camera
from mien.render.mesh import rasterize_mesh
from mien.tracking.eyelid_eyes import Eye

_LARGEST = 40
"""Pixels: eyeballs wider than this are looked at in a smaller picture."""
_SMALLEST = 20
"""Pixels: eyeballs narrower than this show too little."""
_SHARPER = 2
"""Edges of lids are drawn at so many times the picture's size, so that they fall between pixels as well."""
_MARGIN = 2
"""Pixels around the eyeball."""
_LEAST_COSINE = 0.25
"""Between skin and the direction to the camera, for it to tell the colour of skin."""
_RING, _SMOOTH = 0.3, 0.18
"""How far skin around the eye counts, and over how much of it its colour is smoothed, in widths of the opening."""
_LEAST_RING, _LEAST_OPENING = 12, 12
"""Pixels of skin, and of what an open eye would show, below which nothing is told."""
_DARKEST = 0.03
"""Added to colours before their logarithm: noise in the dark is no colour."""


@dataclass(frozen=True, eq=False)
class EyeCrop:
    """The n pixels of a picture that the lids of one eye may cover or uncover."""

    colors: Float[np.ndarray, "n 3"]
    """Logarithms of colours, less those of the skin around the eye: what remains when the light changes."""
    uncovered: Float[np.ndarray, "k n"]
    """How much of each pixel is eyeball at each position of the lids, 0..1."""
    spread: float
    """Root mean square of the same for the skin around the eye."""
    beside: Bool[np.ndarray, " n"]
    """Neither eyeball nor right at its edge, at the position of the lids that was tracked."""
    inside: Bool[np.ndarray, " n"]
    """Eyeball, and not right at its edge, at the position of the lids that was tracked."""


def eye_crop(
    eye: Eye,
    picture: UInt8[np.ndarray, "h w 3"],
    camera: Camera,
    corners: Float[Tensor, "2 n 3"],
    tracked: float,
    positions: list[float],
) -> EyeCrop | None:
    """What a picture shows of an eye; None where that is too little.

    Args:
        eye: The eye.
        picture: sRGB.
        camera: That took it.
        corners: The eye's vertices in world space with lids at rest (0), and where they meet (1).
        tracked: Where the lids are taken to be, in the same unit.
        positions: Where they might be, the most open first; `tracked` is added as the last.
    """
    found = _part(picture, camera, corners[0, eye.faces[: eye.ball].flatten().unique()])
    if found is None:
        return None
    image, inside_picture, view = found

    def at(position: float) -> Float[Tensor, "n 3"]:
        return torch.lerp(corners[0], corners[1], position).contiguous()

    sharper = view.resized(view.width * _SHARPER, view.height * _SHARPER)
    uncovered = np.stack([_uncovered(eye, at(position), sharper) for position in [*positions, tracked]])
    skin, hidden = _around(eye, at(tracked), view)
    opening = uncovered.max(0) > 1 / 64
    difference, spread = _without_skin(_logarithms(image), opening, skin & inside_picture)
    kept = opening & ~hidden & inside_picture
    if difference is None or kept.sum() < _LEAST_OPENING:
        return None
    open_now = uncovered[-1]
    kernel = np.ones((3, 3), np.uint8)
    inside = cv2.erode((open_now > 0.95).astype(np.uint8), kernel) > 0
    beside = cv2.dilate((open_now > 1 / 64).astype(np.uint8), kernel) == 0
    return EyeCrop(difference[kept], uncovered[:-1, kept], spread, beside[kept], inside[kept])


def _part(
    picture: UInt8[np.ndarray, "h w 3"], camera: Camera, ball: Float[Tensor, "b 3"]
) -> tuple[Float[np.ndarray, "ph pw 3"], Bool[np.ndarray, "ph pw"], Camera] | None:
    """The part of the picture around an eyeball, which of its pixels the picture has, and its camera."""
    points, depth = camera.project(ball)
    if not (depth > 0).all():
        return None
    left, top = (points.amin(0).floor().long() - _MARGIN).tolist()
    right, bottom = (points.amax(0).ceil().long() + _MARGIN).tolist()
    width, height = right - left, bottom - top
    if width < _SMALLEST or left >= camera.width or top >= camera.height or right <= 0 or bottom <= 0:
        return None
    part = picture[max(top, 0) : bottom, max(left, 0) : right]
    after = max(bottom - camera.height, 0), max(right - camera.width, 0)
    pad = ((max(-top, 0), after[0]), (max(-left, 0), after[1]))
    known = np.pad(np.ones(part.shape[:2], np.uint8), pad)
    part = np.pad(part, (*pad, (0, 0)), mode="edge")
    view = camera.cropped(float(left), float(top), width, height)
    if width > _LARGEST:
        width, height = _LARGEST, max(round(height * _LARGEST / width), 1)
        part = cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA)
        known = cv2.resize(known, (width, height), interpolation=cv2.INTER_NEAREST)
        view = view.resized(width, height)
    return part.astype(np.float32) * np.float32(1 / 255), known > 0, view


def _uncovered(eye: Eye, vertices: Float[Tensor, "n 3"], sharper: Camera) -> Float[np.ndarray, "h w"]:
    seen = rasterize_mesh(vertices, eye.moving, sharper, cull_backfaces=True).face_index.numpy()
    ball = ((seen >= 0) & (seen < eye.ball)).astype(np.float32)
    size = sharper.width // _SHARPER, sharper.height // _SHARPER
    return cv2.resize(ball, size, interpolation=cv2.INTER_AREA)


def _around(
    eye: Eye, vertices: Float[Tensor, "n 3"], view: Camera
) -> tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Where skin is seen from in front, and what something hides that is neither eyeball nor lid."""
    seen = rasterize_mesh(vertices, eye.faces, view).face_index.long()
    triangles = vertices[eye.faces]
    normals = torch.linalg.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    towards = view.position - triangles.mean(1)
    cosine = (normals * towards).sum(1) / (normals.norm(dim=1) * towards.norm(dim=1)).clamp_min(1e-20)
    skin = (seen >= 0) & (eye.skin & (cosine > _LEAST_COSINE))[seen.clamp_min(0)]
    return skin.numpy(), (seen >= eye.lids).numpy()


def _logarithms(image: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    return np.log(image + np.float32(_DARKEST))


def _without_skin(
    colors: Float[np.ndarray, "h w 3"], opening: Bool[np.ndarray, "h w"], skin: Bool[np.ndarray, "h w"]
) -> tuple[Float[np.ndarray, "h w 3"] | None, float]:
    """Colours less the smooth one of the skin around an opening, and how much that skin's own differ from it."""
    columns = np.flatnonzero(opening.any(axis=0))
    width = max(int(np.ptp(columns)) if len(columns) else 0, 6)
    reach = 2 * max(int(_RING * width), 3) + 1
    near, touching = (
        cv2.dilate(opening.astype(np.uint8), np.ones((size, size), np.uint8)) > 0 for size in (reach, 3)
    )  # fmt: skip
    ring = near & ~touching & skin
    if ring.sum() < _LEAST_RING:
        return None, 0.0
    middle = np.median(colors[ring], axis=0)
    away = np.abs(colors - middle).sum(-1)
    # What differs much from the middle colour, such as the frame of glasses, is no skin.
    weight = (ring / (1 + (away / (2 * (np.median(away[ring]) + 0.05))) ** 4)).astype(np.float32)
    summed = cv2.GaussianBlur(colors * weight[..., None], (0, 0), _SMOOTH * width)
    total = cv2.GaussianBlur(weight, (0, 0), _SMOOTH * width)[..., None]
    difference = colors - (summed + 1e-4 * middle) / (total + 1e-4)
    spread = float(np.sqrt(((difference**2).sum(-1) * weight).sum() / weight.sum()))
    return difference.astype(np.float32), spread
