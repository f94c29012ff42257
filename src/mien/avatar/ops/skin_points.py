"""Points from their places in one pose of a skeleton to those in other poses.

MonoGaussianAvatar's points are free in the canonical pose: skinning is undone, displacements are added, and the points
are skinned again (Chen et al., section 3.2). Native for float32 on a CPU: one call forward and one backward.
"""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from mien import _native
from mien.arrays import native, recycled_like, unpacked


def skin_points_reference(
    points: Float[Tensor, "n 3"],
    moved: Float[Tensor, "b n 3"],
    weights: Float[Tensor, "n k"],
    from_bones: Float[Tensor, "k 3 4"],
    to_bones: Float[Tensor, "b k 3 4"],
) -> Float[Tensor, "b n 3"]:
    """`skin_points` in plain PyTorch."""
    shaped = unskin(points, blend_transforms(weights, from_bones[None])[0]) + moved
    skinning = blend_transforms(weights, to_bones)
    return (skinning[..., :3] @ shaped[..., None])[..., 0] + skinning[..., 3]


@native(skin_points_reference)
def skin_points(
    points: Float[Tensor, "n 3"],
    moved: Float[Tensor, "b n 3"],
    weights: Float[Tensor, "n k"],
    from_bones: Float[Tensor, "k 3 4"],
    to_bones: Float[Tensor, "b k 3 4"],
) -> Float[Tensor, "b n 3"]:
    """Places of points in other poses. Differentiable in everything but `from_bones`.

    `points` are in the first pose. `moved` is added at rest, for each of the other poses.
    """
    return _SkinPoints.apply(points, moved, weights, from_bones, to_bones)


def blend_transforms(weights: Float[Tensor, "n k"], transforms: Float[Tensor, "b k 3 4"]) -> Float[Tensor, "b n 3 4"]:
    """Each point's transform: the mean of the joints' transforms, weighted by its skinning weights."""
    return (weights @ transforms.flatten(2)).unflatten(-1, (3, 4))


def unskin(points: Float[Tensor, "n 3"], transforms: Float[Tensor, "n 3 4"]) -> Float[Tensor, "n 3"]:
    """Positions of the points before affine transforms moved them (inverse skinning)."""
    a, b, c = transforms[..., :3].unbind(-2)
    # Cramer's rule is several times as fast as a general inverse of many small matrices.
    columns = torch.stack([torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], dim=-1)
    determinant = (a * columns[..., 0]).sum(-1, keepdim=True)
    return (columns @ (points - transforms[..., 3])[..., None])[..., 0] / determinant


class _SkinPoints(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Tensor) -> Tensor:
        given = [tensor.contiguous() for tensor in arguments]
        posed = recycled_like(given[1])
        _native.skin_points(_native.SkinPoints(*unpacked(*given)), *unpacked(posed))
        ctx.save_for_backward(*given)
        return posed

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_posed: Tensor) -> tuple[Tensor | None, ...]:
        given = ctx.saved_tensors
        points, moved, weights, _, to_bones = given
        by = [recycled_like(tensor) for tensor in (points, moved, weights, to_bones)]
        gradients = _native.SkinPointsGradients(*unpacked(by_posed.contiguous(), *by))
        _native.skin_points_backward(_native.SkinPoints(*unpacked(*given)), gradients)
        return by[0], by[1], by[2], None, by[3]
