"""Rotations: axis-angle, matrices and wxyz quaternions, batched over leading axes."""

from functools import cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from mien import _native
from mien.arrays import recycled_like, unpacked
from mien.machine.devices import upload

# Each column has one entry, so that no sum is rounded.
_SKEW = np.array([[0, 0, 0, 0, 0, -1, 0, 1, 0], [0, 0, 1, 0, 0, 0, -1, 0, 0], [0, -1, 0, 1, 0, 0, 0, 0, 0]])
"""From a vector to its cross-product matrix, by rows."""
# Below this squared angle (radians), the closed forms lose digits and their Taylor series take over.
_SMALL_ANGLE_SQUARED = 1e-8


@cache
def _constant(values: bytes, shape: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    constant = torch.tensor(np.frombuffer(values).reshape(shape), dtype=dtype)
    return upload(constant, torch.empty(0, dtype=dtype, device=device))


def _like(values: np.ndarray, like: Tensor) -> Tensor:
    """A constant with the dtype and device of a tensor, made once."""
    return _constant(values.astype(float).tobytes(), values.shape, like.dtype, like.device)


def skew(vectors: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Cross-product matrices: `skew(a) @ b == cross(a, b)`."""
    return (vectors @ _like(_SKEW, vectors)).unflatten(-1, (3, 3))


def matrix_from_axis_angle(axis_angle: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Rotation matrices of axis-angle vectors in radians (Rodrigues' formula); smooth at zero."""
    squared = (axis_angle * axis_angle).sum(-1)[..., None, None]
    small = squared < _SMALL_ANGLE_SQUARED
    safe = torch.where(small, torch.ones_like(squared), squared)
    angle = safe.sqrt()
    sine = torch.where(small, 1 - squared / 6, angle.sin() / angle)
    cosine = torch.where(small, 0.5 - squared / 24, (1 - angle.cos()) / safe)
    cross = skew(axis_angle)
    return _like(np.eye(3), axis_angle) + sine * cross + cosine * (cross @ cross)


def axis_angle_from_matrix(matrices: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3"]:
    """Axis-angle vectors, angle in 0..pi, of rotation matrices."""
    return axis_angle_from_quaternion(quaternion_from_matrix(matrices))


def axis_angle_from_quaternion(quats: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b 3"]:
    """Axis-angle vectors, angle in 0..pi, of unit wxyz quaternions."""
    quats = torch.where(quats[..., :1] < 0, -quats, quats)
    real, imaginary = quats[..., 0], quats[..., 1:]
    squared = (imaginary * imaginary).sum(-1)
    small = squared < _SMALL_ANGLE_SQUARED
    norm = torch.where(small, torch.ones_like(squared), squared).sqrt()
    factor = torch.where(small, 2 / real.clamp_min(0.5), 2 * torch.atan2(norm, real) / norm)
    return imaginary * factor[..., None]


def matrix_from_quaternion(quats: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b 3 3"]:
    """Rotation matrices of wxyz quaternions, which are normalised first."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip
    return torch.stack(rows, dim=-1).reshape(*quats.shape[:-1], 3, 3)


def quaternion_from_matrix(matrices: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 4"]:
    """Unit wxyz quaternions of rotation matrices.

    Each matrix uses the one of four equivalent formulas that has the largest divisor. The result is then well
    conditioned everywhere, with finite gradients. The sign is arbitrary.
    """
    m = matrices
    m00, m11, m22 = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    # The four candidates: each is four times the quaternion, times one of its own components.
    candidates = torch.stack(
        [
            torch.stack([1 + m00 + m11 + m22, m[..., 2, 1] - m[..., 1, 2],
                         m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]], -1),
            torch.stack([m[..., 2, 1] - m[..., 1, 2], 1 + m00 - m11 - m22,
                         m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0]], -1),
            torch.stack([m[..., 0, 2] - m[..., 2, 0], m[..., 0, 1] + m[..., 1, 0],
                         1 - m00 + m11 - m22, m[..., 1, 2] + m[..., 2, 1]], -1),
            torch.stack([m[..., 1, 0] - m[..., 0, 1], m[..., 0, 2] + m[..., 2, 0],
                         m[..., 1, 2] + m[..., 2, 1], 1 - m00 - m11 + m22], -1),
        ],
        dim=-2,
    )  # fmt: skip
    best = candidates.diagonal(dim1=-2, dim2=-1).argmax(-1)
    index = best[..., None, None].expand(*best.shape, 1, 4)
    return torch.nn.functional.normalize(candidates.gather(-2, index).squeeze(-2), dim=-1)


def multiply_quaternions(first: Float[Tensor, "*b 4"], second: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b 4"]:
    """Hamilton product: rotate by `second`, then by `first`."""
    w1, x1, y1, z1 = first.unbind(-1)
    w2, x2, y2, z2 = second.unbind(-1)
    return torch.stack(
        [
            w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
            w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
            w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
            w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
        ],
        dim=-1,
    )


def rigid_transform(rotations: Float[Tensor, "*b 3 3"], translations: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 4 4"]:
    """Homogeneous matrices that first rotate, then translate."""
    top = torch.cat([rotations, translations[..., None]], dim=-1)
    bottom = torch.zeros_like(top[..., :1, :])
    bottom[..., 0, 3] = 1
    return torch.cat([top, bottom], dim=-2)


def compose_rigid(first: Float[Tensor, "4 4"], second: Float[Tensor, "4 4"]) -> Float[Tensor, "4 4"]:
    """`first @ second`, summed in the order that `mien.runtime` uses, so that both round alike."""
    return _ComposeRigid.apply(first, second)  # pyright: ignore[reportReturnType]


class _ComposeRigid(torch.autograd.Function):
    """One autograd node instead of twenty: each training step runs it once, and only on the caller's thread."""

    @staticmethod
    def forward(ctx: Any, first: Tensor, second: Tensor) -> Tensor:
        first, second = first.contiguous(), second.contiguous()
        ctx.save_for_backward(first, second)
        if first.dtype == torch.float32 and first.device.type == "cpu":
            out = recycled_like(first)
            _native.compose_rigid(*unpacked(first, second, out))
            return out
        if first.device.type != "cpu":
            return first @ second
        one, two, three, four = (first[:, :, None] * second).unbind(1)
        return ((one + two) + three) + four

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor | None]:
        first, second = ctx.saved_tensors
        of_first, of_second = ctx.needs_input_grad
        if first.dtype == torch.float32 and first.device.type == "cpu":
            by_first, by_second = recycled_like(first), recycled_like(second)
            _native.compose_rigid_backward(*unpacked(first, second, gradient.contiguous(), by_first, by_second))
            return by_first if of_first else None, by_second if of_second else None
        return gradient @ second.T if of_first else None, first.T @ gradient if of_second else None


def invert_rigid(transforms: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 4 4"]:
    """Inverses of rigid transforms: exact, cheaper than a general inverse, and the same bits on every processor."""
    rotation = transforms[..., :3, :3]
    x, y, z = (rotation * transforms[..., :3, 3:]).unbind(-2)
    return rigid_transform(rotation.transpose(-1, -2), -((x + y) + z))


def left_jacobian(axis_angle: Float[Tensor, "b 3"]) -> Float[Tensor, "b 3 3"]:
    """Left Jacobian of SO(3): exp(a + d) = exp(J d) exp(a) to first order."""
    squared = (axis_angle * axis_angle).sum(-1)[:, None, None]
    small = squared < _SMALL_ANGLE_SQUARED
    safe = torch.where(small, torch.ones_like(squared), squared)
    angle = safe.sqrt()
    first = torch.where(small, 0.5 - squared / 24, (1 - angle.cos()) / safe)
    second = torch.where(small, 1 / 6 - squared / 120, (angle - angle.sin()) / (safe * angle))
    cross = skew(axis_angle)
    return torch.eye(3).to(axis_angle) + first * cross + second * (cross @ cross)


def align_centered(
    source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "3 3"], float]:
    """Rotation and scale with target ~ scale * rotation @ source, by least squares (Umeyama 1991).

    Both sets of points have their mean at the origin.
    """
    u, values, vt = np.linalg.svd(target.T @ source)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    return (u * signs) @ vt, float((values * signs).sum() / (source**2).sum())
