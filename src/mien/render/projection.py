"""Projection of a Gaussian to a splat on the screen, in plain PyTorch: the constants and the formulas.

Every back end follows this file (docs/conventions.md). The native kernels and the web runtime repeat its numbers.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mien.camera import Camera
from mien.gaussians import SH_C0, Gaussians
from mien.rotation import matrix_from_quaternion

NEAR = 0.01
"""Least depth of a Gaussian that is drawn, in metres."""
DILATION = 0.3
"""Added to the diagonal of each 2D covariance, in pixels squared, so that no splat is smaller than about a pixel."""
MAX_ALPHA = 0.999
MIN_ALPHA = 1 / 255
"""Contributions with a smaller alpha are dropped."""
MIN_TRANSMITTANCE = 1e-4
"""A Gaussian that would reduce the transmittance to this or less is not blended and ends the pixel."""
MAX_FOV_MARGIN = 0.3
"""The Jacobian is computed at a direction at most this many half-images outside the picture."""


@dataclass(frozen=True, eq=False)
class Splats:
    """Projected Gaussians, in the order of the input."""

    means2d: Float[Tensor, "n 2"]
    """Projected centres, in pixels."""
    covariances: Float[Tensor, "n 3"]
    """Dilated 2D covariances xx, xy, yy, in pixels squared."""
    depths: Float[Tensor, " n"]
    opacities: Float[Tensor, " n"]
    colors: Float[Tensor, "n 3"]
    extents: Float[Tensor, "n 2"]
    """Half sizes of the box outside of which alpha is below MIN_ALPHA, in pixels."""
    drawn: Bool[Tensor, " n"]

    def radii(self) -> Int[Tensor, " n"]:
        """3 sigma of the longer axis in pixels, rounded up; 0 where not drawn."""
        xx, xy, yy = self.covariances.unbind(-1)
        largest = 0.5 * (xx + yy) + torch.sqrt(0.25 * (xx - yy) ** 2 + xy**2)
        return torch.where(self.drawn, torch.ceil(3 * largest.sqrt()), 0).to(torch.int32)


def project_splats(gaussians: Gaussians, camera: Camera, means2d_offset: Float[Tensor, "n 2"]) -> Splats:
    """Project unbatched Gaussians, given in the camera's world, by EWA splatting (Zwicker 2001). Differentiable."""
    rotation, translation = camera.viewmat[:3, :3], camera.viewmat[:3, 3]
    points = gaussians.means @ rotation.T + translation
    depths = points[:, 2]
    in_front = depths > NEAR
    points = torch.where(in_front[:, None], points, torch.ones_like(points))  # undrawn points get no gradient
    jacobian = projection_jacobian(points, camera)
    axes = matrix_from_quaternion(gaussians.quats) * gaussians.scales[:, None, :]
    half = jacobian @ rotation @ axes  # [n, 2, 3]; the covariance is half @ half.T.
    covariance = half @ half.transpose(1, 2)
    xx, xy, yy = covariance[:, 0, 0] + DILATION, covariance[:, 0, 1], covariance[:, 1, 1] + DILATION
    means2d = (points @ camera.K.T)[:, :2] / points[:, 2:] + means2d_offset
    with torch.no_grad():
        cutoff = 2 * torch.log(gaussians.opacities / MIN_ALPHA)  # squared Mahalanobis distance at alpha 1/255
        extents = torch.sqrt(cutoff.clamp_min(0)[:, None] * torch.stack([xx, yy], -1))
        size = torch.tensor([camera.width, camera.height]).to(means2d)
        on_screen = ((means2d + extents > 0) & (means2d - extents < size)).all(-1)
        drawn = in_front & (gaussians.opacities >= MIN_ALPHA) & on_screen
    camera_position = -(rotation.T @ translation)
    directions = torch.nn.functional.normalize(gaussians.means - camera_position, dim=-1)
    colors = torch.clamp_min(spherical_harmonics(gaussians.sh, directions) + 0.5, 0)
    return Splats(
        means2d, torch.stack([xx, xy, yy], -1), depths, gaussians.opacities, colors, extents, drawn
    )  # fmt: skip


def projection_jacobian(points: Float[Tensor, "n 3"], camera: Camera) -> Float[Tensor, "n 2 3"]:
    """The derivative of pixels with respect to camera-space points.

    Far outside the picture the affine approximation explodes, so the direction is clamped to a margin around the
    picture, as in 3D Gaussian Splatting. The margin has no gradient.
    """
    fx, fy, cx, cy = camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]
    x, y, z = points.unbind(-1)
    with torch.no_grad():
        margin_x, margin_y = MAX_FOV_MARGIN * 0.5 * camera.width / fx, MAX_FOV_MARGIN * 0.5 * camera.height / fy
        left, right = -cx / fx - margin_x, (camera.width - cx) / fx + margin_x
        top, bottom = -cy / fy - margin_y, (camera.height - cy) / fy + margin_y
    clamped_x = z * torch.clamp(x / z, left, right)
    clamped_y = z * torch.clamp(y / z, top, bottom)
    zero = torch.zeros_like(z)
    rows = [fx / z, zero, -fx * clamped_x / z**2, zero, fy / z, -fy * clamped_y / z**2]
    return torch.stack(rows, -1).reshape(-1, 2, 3)


def spherical_harmonics(sh: Float[Tensor, "n k 3"], directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Colours before 0.5 is added, from real spherical harmonics (Sloan 2013) as in 3D Gaussian Splatting."""
    basis = spherical_harmonics_basis(directions, sh.shape[-2])
    return (basis[:, :, None] * sh).sum(1)


def spherical_harmonics_basis(directions: Float[Tensor, "n 3"], count: int) -> Float[Tensor, "n k"]:
    """The first 1, 4, 9 or 16 real spherical harmonics at unit directions."""
    x, y, z = directions.unbind(-1)
    basis = [torch.full_like(x, SH_C0)]
    if count > 1:
        basis += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if count > 4:
        basis += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * z * z - x * x - y * y),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (x * x - y * y),
        ]
    if count > 9:
        basis += [
            -0.5900435899266435 * y * (3 * x * x - y * y),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
            0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
            1.445305721320277 * z * (x * x - y * y),
            -0.5900435899266435 * x * (x * x - 3 * y * y),
        ]
    return torch.stack(basis, -1)
