"""The pinhole camera (docs/conventions.md)."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from mien.rotation import compose_rigid, invert_rigid, rigid_transform

__all__ = ["Box", "Camera", "camera_from_fov", "look_at"]

Box = tuple[int, int, int, int]
"""Left, top, width and height of a part of a picture, in pixels."""


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera with OpenCV axes: +x right, +y down, +z forward.

    Pixel (i, j), column i and row j, has its centre at (i + .5, j + .5).
    """

    K: Float[Tensor, "3 3"]
    """Intrinsics in pixels."""
    viewmat: Float[Tensor, "4 4"]
    """T_camera_world, in metres."""
    width: int
    """Width in pixels."""
    height: int
    """Height in pixels."""

    @property
    def position(self) -> Float[Tensor, " 3"]:
        """The camera's centre in world space, in metres."""
        x, y, z = (self.viewmat[:3, :3] * self.viewmat[:3, 3:]).unbind()
        return -((x + y) + z)

    def to(self, like: Tensor) -> "Camera":
        """This camera with the dtype and device of `like`."""
        if all(tensor.dtype == like.dtype and tensor.device == like.device for tensor in (self.K, self.viewmat)):
            return self
        return replace(self, K=self.K.to(like), viewmat=self.viewmat.to(like))

    def in_frame(self, T_world_local: Float[Tensor, "4 4"]) -> "Camera":
        """The camera as seen from a local frame: it views local points as `self` views them in world space."""
        return replace(self, viewmat=compose_rigid(self.viewmat, T_world_local))

    def resized(self, width: int, height: int) -> "Camera":
        """The same view with another resolution."""
        scale = torch.tensor([width / self.width, height / self.height, 1.0]).to(self.K)
        return replace(self, K=self.K * scale[:, None], width=width, height=height)

    def cropped(self, left: float, top: float, width: int, height: int) -> "Camera":
        """The part of the view whose top left corner is at pixel (left, top). The part may reach outside the view."""
        K = self.K.clone()
        K[0, 2] -= left
        K[1, 2] -= top
        return replace(self, K=K, width=width, height=height)

    def fitted(self, width: int, height: int, zoom: float = 1.0) -> "Camera":
        """The same view in a picture of another shape: all of it is visible, centred, and magnified by `zoom`."""
        scale = min(width / self.width, height / self.height) * zoom
        K = self.K * self.K.new_tensor([[scale], [scale], [1.0]])
        K[0, 2] += 0.5 * (width - scale * self.width)
        K[1, 2] += 0.5 * (height - scale * self.height)
        return replace(self, K=K, width=width, height=height)

    def project(self, points: Float[Tensor, "*b 3"]) -> tuple[Float[Tensor, "*b 2"], Float[Tensor, "*b"]]:
        """Pixel positions and depths of world-space points. Depth is the camera's z in metres, not positive behind it.

        Differentiable in `points`, `K` and `viewmat`.
        """
        in_camera = points @ self.viewmat[:3, :3].T + self.viewmat[:3, 3]
        depth = in_camera[..., 2]
        pixels = (in_camera @ self.K.T)[..., :2] / depth[..., None]
        return pixels, depth


def camera_from_fov(fov_x: float, width: int, height: int, viewmat: Float[Tensor, "4 4"] | None = None) -> Camera:
    """A camera with square pixels, its principal point at the centre, and a horizontal field of view in radians."""
    focal = 0.5 * width / math.tan(0.5 * fov_x)
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Camera(K, torch.eye(4) if viewmat is None else viewmat, width, height)


def look_at(
    position: Float[Tensor, " 3"], target: Float[Tensor, " 3"], up: Float[Tensor, " 3"]
) -> Float[Tensor, "4 4"]:
    """The viewmat of a camera at `position` that looks at `target`; `up` points upwards in the picture."""
    forward = _unit(target - position)
    right = _unit(_cross(forward, up))
    down = _cross(forward, right)
    return invert_rigid(rigid_transform(torch.stack([right, down, forward], dim=-1), position))


# Each product and sum is computed by itself, so that the bits are the same on every processor.
def _cross(first: Float[Tensor, " 3"], second: Float[Tensor, " 3"]) -> Float[Tensor, " 3"]:
    return first.roll(-1) * second.roll(1) - first.roll(1) * second.roll(-1)


def _unit(vector: Float[Tensor, " 3"]) -> Float[Tensor, " 3"]:
    x, y, z = (vector * vector).unbind()
    return vector / ((x + y) + z).sqrt().clamp_min(1e-12)
