"""Scenes for benchmarks: a head of any number of Gaussians that fills half of a picture."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from mien.camera import Camera
from mien.gaussians import Gaussians


def synthetic_head(count: int, coefficients: int = 1) -> Gaussians:
    """Cover an ellipsoid with small, mostly opaque splats. Their total area does not depend on their number."""
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    spread = torch.exp(0.35 * torch.randn(count, 3, generator=generator))
    return Gaussians(
        means=directions * torch.tensor([0.085, 0.11, 0.095]),
        quats=torch.randn(count, 4, generator=generator),
        scales=spread * 0.00056 * (30000 / count) ** 0.5,
        opacities=torch.sigmoid(2 + 1.5 * torch.randn(count, generator=generator)),
        sh=0.3 * torch.randn(count, coefficients, 3, generator=generator),
    )


def head_camera(width: int, height: int) -> Camera:
    """Return a camera 60 cm in front of the head.

    The head's height is about three quarters of the picture's shorter side.
    """
    viewmat = torch.eye(4)
    viewmat[2, 3] = 0.6
    focal = 2.35 * min(width, height)
    return Camera(torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]), viewmat, width, height)


@dataclass(frozen=True, eq=False)
class Scene:
    """Gaussians, a camera, and a gradient of the picture for backward passes."""

    gaussians: Gaussians
    camera: Camera
    background: Float[Tensor, " 3"]
    gradient: Float[Tensor, "h w 3"]

    @property
    def parameters(self) -> list[Tensor]:
        """The tensors whose gradients are computed."""
        own = self.gaussians
        return [own.means, own.quats, own.scales, own.opacities, own.sh]


def head_scene(count: int, width: int, height: int) -> Scene:
    """Return the head over white. Its tensors are leaves."""
    head = synthetic_head(count)
    names = ("means", "quats", "scales", "opacities", "sh")
    head = replace(head, **{name: getattr(head, name).requires_grad_() for name in names})
    gradient = torch.randn(height, width, 3, generator=torch.Generator().manual_seed(1))
    return Scene(head, head_camera(width, height), torch.ones(3), gradient)
