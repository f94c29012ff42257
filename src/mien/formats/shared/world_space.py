"""Moves Gaussians into frames of other programs: to world space, and to +y down."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from mien.gaussians import Gaussians, world_means
from mien.render.projection import spherical_harmonics_basis
from mien.rotation import multiply_quaternions, quaternion_from_matrix

_DIRECTIONS = 64


def in_world(gaussians: Gaussians) -> Gaussians:
    """The same unbatched Gaussians without `T_world_local`. They look the same from every camera."""
    pose = gaussians.T_world_local
    if pose is None:
        return gaussians
    assert not gaussians.batched, "move one timestep: gaussians.timestep(t)"
    turn = quaternion_from_matrix(pose[:3, :3])
    quats = multiply_quaternions(turn.expand_as(gaussians.quats), gaussians.quats)
    sh = rotate_sh(gaussians.sh, pose[:3, :3])
    return Gaussians(world_means(gaussians), quats, gaussians.scales, gaussians.opacities, sh)


def with_y_down(gaussians: Gaussians) -> Gaussians:
    """Unbatched Gaussians in world space after half a turn about x, which changes signs alone, so it is exact."""
    turned = gaussians.means.new_tensor([1, -1, -1])
    w, x, y, z = gaussians.quats.unbind(-1)
    directions, count = _spread_directions()[1:2].to(gaussians.sh), gaussians.sh.shape[-2]
    signs = spherical_harmonics_basis(directions * turned, count) / spherical_harmonics_basis(directions, count)
    return Gaussians(
        gaussians.means * turned, torch.stack([-x, w, -z, y], dim=-1), gaussians.scales, gaussians.opacities,
        gaussians.sh * signs.sign().T,
    )  # fmt: skip


def rotate_sh(sh: Float[Tensor, "n k 3"], rotation: Float[Tensor, "3 3"]) -> Float[Tensor, "n k 3"]:
    """SH coefficients after `rotation`: along R d, the colours are what they were along d before.

    A rotation mixes the coefficients of each degree linearly. The mixing matrix is solved from values in many
    directions. This is exact, because the rotated functions are again spherical harmonics.
    """
    count = sh.shape[-2]
    directions = _spread_directions().to(sh.dtype)
    turned = spherical_harmonics_basis(directions @ rotation.to(directions).T, count)
    mixing = torch.linalg.lstsq(turned, spherical_harmonics_basis(directions, count)).solution
    return torch.einsum("jk,nkc->njc", mixing.to(sh), sh)


def _spread_directions() -> Float[Tensor, "d 3"]:
    """Unit vectors spread over the whole sphere, on a golden spiral."""
    index = torch.arange(_DIRECTIONS, dtype=torch.float64)
    height = 1 - 2 * (index + 0.5) / _DIRECTIONS
    angle = index * math.pi * (3 - math.sqrt(5))
    radius = (1 - height**2).sqrt()
    return torch.stack([radius * angle.cos(), height, radius * angle.sin()], dim=-1)
