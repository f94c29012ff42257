"""Pixels of a picture around an eye: their colours, and how much of each is eyeball as the lids move."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from mien.camera import Camera
from mien.render.mesh import rasterize_mesh
from mien.tracking.eyelids.eyes import Eye

LEAST_COSINE = 0.25
"""Least cosine between the surface's normal and the direction to the camera at which the surface's colour is used."""

_WIDEST_EYE = 40  # largest width of an eyeball, in pixels. If it is wider, the picture is scaled down
_NARROWEST_EYE = 20  # smallest width of an eyeball, in pixels. Narrower eyeballs show too little and are skipped
_SUPERSAMPLING = 2
"""Multiple of the picture's size at which the mesh is drawn, so that edges of lids can lie between pixels."""
_EYE_MARGIN = 2  # margin around the eyeball, in pixels
_RING = 0.3  # width of the ring of skin around the eye, in widths of the opening
_RING_BLUR = 0.18  # standard deviation of the blur of the ring's colour, in widths of the opening
_LEAST_RING = 12  # fewest pixels of the ring of skin. With fewer the eye is skipped
_LEAST_OPENING = 12  # fewest pixels of the opening of the eye. With fewer the eye is skipped
_DARKEST = 0.03  # value added to colours (0..1) before the logarithm, so that noise in dark pixels does not matter


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
    """The pixels of an eye in a picture, or None if the picture shows too little of it.

    Args:
        eye: The eye.
        picture: The picture, sRGB.
        camera: The camera that took the picture.
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
    """The crop around an eyeball, which of its pixels lie inside the picture, and its camera.

    Returns None if the eyeball is too small, outside the picture, or behind the camera.
    """
    points, depth = camera.project(ball)
    if not (depth > 0).all():
        return None
    left, top = (points.amin(0).floor().long() - _EYE_MARGIN).tolist()
    right, bottom = (points.amax(0).ceil().long() + _EYE_MARGIN).tolist()
    width, height = right - left, bottom - top
    least, most = _NARROWEST_EYE, _WIDEST_EYE
    if width < least or left >= camera.width or top >= camera.height or right <= 0 or bottom <= 0:
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


def _logarithms(image: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    return np.log(image + np.float32(_DARKEST))


def _without_skin(
    colors: Float[np.ndarray, "h w 3"], opening: Bool[np.ndarray, "h w"], skin: Bool[np.ndarray, "h w"]
) -> tuple[Float[np.ndarray, "h w 3"] | None, float]:
    """Colours minus the smoothed colour of the skin around an opening, and that skin's own spread about it.

    The colours are None if too little skin is seen.
    """
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
    # Pixels far from the median colour, such as the frame of glasses, are not skin.
    weight = (ring / (1 + (away / (2 * (np.median(away[ring]) + 0.05))) ** 4)).astype(np.float32)
    summed = cv2.GaussianBlur(colors * weight[..., None], (0, 0), _RING_BLUR * width)
    total = cv2.GaussianBlur(weight, (0, 0), _RING_BLUR * width)[..., None]
    difference = colors - (summed + 1e-4 * middle) / (total + 1e-4)
    spread = float(np.sqrt(((difference**2).sum(-1) * weight).sum() / weight.sum()))
    return difference.astype(np.float32), spread
