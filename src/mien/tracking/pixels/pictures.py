"""Pictures for the photometric fit: smoothed, scaled down, masked to the pixels that can be trusted, and cut out."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mien.camera import Camera
from mien.capture.capture import Capture
from mien.tracking.fitting.views import CameraBatch

_BLUR = 0.8  # standard deviation of the blur, in pixels of the scaled picture
_MATTE_MARGIN = 2
"""Margin along the person's outline that is masked, in pixels of the scaled picture: it mixes with the background."""


@dataclass(frozen=True, eq=False)
class Picture:
    """One picture and the camera that took it."""

    camera: Camera
    image: Float[Tensor, "h w 3"]
    """Colours, sRGB, 0..1."""
    mask: Float[Tensor, "h w"]
    """Weight of each pixel, 0..1."""


@dataclass(frozen=True, eq=False)
class Pictures:
    """The pictures of a capture at one level of a pyramid."""

    capture: Capture
    shrink: int
    """Factor by which pictures are scaled down: 1 for the capture's size, 2 for half of it."""

    def picture(self, timestep: int, camera: int, cameras: CameraBatch) -> Picture:
        """The picture of one camera. Several threads may call this at once."""
        capture = self.capture
        width, height = max(capture.width // self.shrink, 8), max(capture.height // self.shrink, 8)
        image = np.asarray(capture.images[timestep, camera])
        matte = np.asarray(capture.mattes[timestep, camera])
        if self.shrink > 1:
            image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
            matte = cv2.resize(matte, (width, height), interpolation=cv2.INTER_AREA)
        image = cv2.GaussianBlur(image.astype(np.float32) * np.float32(1 / 255), (0, 0), _BLUR)
        kernel = np.ones((2 * _MATTE_MARGIN + 1, 2 * _MATTE_MARGIN + 1), np.uint8)
        mask = cv2.erode(matte, kernel, borderType=cv2.BORDER_REPLICATE).astype(np.float32) * np.float32(1 / 255)
        view = Camera(cameras.K[camera], cameras.viewmat[camera], capture.width, capture.height)
        view = view.resized(width, height).to(torch.zeros(()))
        return Picture(view, torch.from_numpy(image), torch.from_numpy(mask))


@dataclass(frozen=True, eq=False)
class Window:
    """The part of a picture that a mesh may cover. A head leaves most of a picture empty."""

    camera: Camera
    """The camera of that part alone."""
    rows: slice
    columns: slice


def window_of(camera: Camera, vertices: Float[Tensor, "v 3"]) -> Window:
    """The window of a mesh in a picture, with a margin of 3 pixels. It is never smaller than 8 x 8 pixels."""
    points, depth = camera.project(vertices)
    points = points[depth > 0] if (depth > 0).any() else points.new_zeros(1, 2)
    size = torch.tensor([camera.width, camera.height])
    first = torch.minimum((points.amin(0).floor().long() - 3).clamp_min(0), size - 8)
    last = torch.minimum(points.amax(0).ceil().long() + 3, size).maximum(first + 8)
    (left, top), (right, bottom) = first.tolist(), last.tolist()
    part = camera.cropped(float(left), float(top), right - left, bottom - top)
    return Window(part, slice(top, bottom), slice(left, right))
