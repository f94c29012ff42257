"""Rotations obey their axioms in every representation."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from mien.rotation import (
    axis_angle_from_matrix,
    axis_angle_from_quaternion,
    compose_rigid,
    invert_rigid,
    matrix_from_axis_angle,
    matrix_from_quaternion,
    multiply_quaternions,
    quaternion_from_matrix,
    rigid_transform,
    skew,
)
from mien.runtime import rotation as runtime_rotation

numbers = st.floats(-3, 3, allow_nan=False, width=32)
vectors = st.lists(numbers, min_size=3, max_size=3).map(lambda v: torch.tensor(v, dtype=torch.float64))
quaternions = (
    st.lists(numbers, min_size=4, max_size=4)
    .map(lambda v: torch.tensor(v, dtype=torch.float64))
    .filter(lambda q: float(q.norm()) > 1e-3)
)


def close(value: Tensor, truth: Tensor, tolerance: float = 1e-9) -> None:
    torch.testing.assert_close(value, truth, rtol=0, atol=tolerance)


def assert_rotation(matrix: Tensor) -> None:
    close(matrix @ matrix.transpose(-1, -2), torch.eye(3, dtype=matrix.dtype).expand_as(matrix))
    close(torch.linalg.det(matrix), torch.ones(matrix.shape[:-2], dtype=matrix.dtype))


@given(vectors, vectors)
def test_skew_is_the_cross_product(first: Tensor, second: Tensor) -> None:
    close(skew(first) @ second, torch.linalg.cross(first, second))


@given(vectors)
def test_axis_angle_gives_rotations_that_keep_their_axis(axis_angle: Tensor) -> None:
    matrix = matrix_from_axis_angle(axis_angle)
    assert_rotation(matrix)
    close(matrix @ axis_angle, axis_angle)
    close(torch.trace(matrix), 1 + 2 * torch.cos(axis_angle.norm()))
    close(matrix_from_axis_angle(-axis_angle), matrix.T)


@given(vectors)
def test_axis_angle_comes_back(axis_angle: Tensor) -> None:
    matrix = matrix_from_axis_angle(axis_angle)
    recovered = axis_angle_from_matrix(matrix)
    assert recovered.norm() <= math.pi + 1e-6
    close(matrix_from_axis_angle(recovered), matrix, 1e-7)
    if axis_angle.norm() < math.pi - 1e-3:
        close(recovered, axis_angle, 1e-6)


@given(quaternions)
def test_quaternions_and_matrices_agree(quat: Tensor) -> None:
    matrix = matrix_from_quaternion(quat)
    assert_rotation(matrix)
    unit = quat / quat.norm()
    recovered = quaternion_from_matrix(matrix)
    close((recovered * unit).sum().abs(), torch.ones((), dtype=torch.float64))
    close(matrix_from_axis_angle(axis_angle_from_quaternion(unit)), matrix, 1e-7)


@given(quaternions, quaternions)
def test_products_of_quaternions_are_products_of_matrices(first: Tensor, second: Tensor) -> None:
    product = multiply_quaternions(first, second)
    close(matrix_from_quaternion(product), matrix_from_quaternion(first) @ matrix_from_quaternion(second))
    close(product.norm(), first.norm() * second.norm())


@given(vectors, vectors, vectors)
def test_inverse_rigid_transforms_undo(axis_angle: Tensor, translation: Tensor, point: Tensor) -> None:
    transform = rigid_transform(matrix_from_axis_angle(axis_angle), translation)
    homogeneous = torch.cat([point, point.new_ones(1)])
    close((transform @ homogeneous)[:3], matrix_from_axis_angle(axis_angle) @ point + translation)
    close(invert_rigid(transform) @ transform, torch.eye(4, dtype=torch.float64))
    close(invert_rigid(transform), torch.linalg.inv(transform))


@given(st.lists(vectors, min_size=2, max_size=4))
def test_leading_axes_are_batches(axis_angles: list[Tensor]) -> None:
    batch = torch.stack(axis_angles)[:, None]
    matrices = matrix_from_axis_angle(batch)
    quats = quaternion_from_matrix(matrices)
    assert quats.shape == (*batch.shape[:-1], 4)
    for index, axis_angle in enumerate(axis_angles):
        close(matrices[index, 0], matrix_from_axis_angle(axis_angle))
        close(quats[index, 0], quaternion_from_matrix(matrix_from_axis_angle(axis_angle)))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_are_finite_at_every_angle(dtype: torch.dtype) -> None:
    for angle in (0.0, 1e-9, 1e-4, 1.0, math.pi - 1e-4, math.pi):
        axis_angle = torch.tensor([0.6 * angle, -0.8 * angle, 0.0], dtype=dtype, requires_grad=True)
        matrix = matrix_from_axis_angle(axis_angle)
        (matrix.sum() + axis_angle_from_matrix(matrix).sum()).backward()
        assert axis_angle.grad is not None
        assert axis_angle.grad.isfinite().all(), angle


def test_axis_angle_gradients_match_differences_around_zero() -> None:
    for axis_angle in (torch.zeros(3), torch.tensor([5e-5, 0, 5e-5]), torch.tensor([2e-4, -3e-4, 0])):
        assert torch.autograd.gradcheck(matrix_from_axis_angle, axis_angle.double().requires_grad_(), eps=1e-7)


def test_known_turns() -> None:
    x, y = torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 1, 0])
    close(matrix_from_axis_angle(torch.tensor([0, 0, math.pi / 2])) @ x, y, 1e-6)
    close(matrix_from_quaternion(torch.tensor([1.0, 0, 0, 1])) @ x, y, 1e-6)
    close(matrix_from_quaternion(torch.zeros(4)), torch.eye(3))


@given(st.lists(vectors, min_size=1, max_size=3).map(torch.stack))
def test_rotations_without_torch_are_the_same(axis_angles: Tensor) -> None:
    matrices = runtime_rotation.matrix_from_axis_angle(axis_angles.numpy())
    close(torch.from_numpy(matrices), matrix_from_axis_angle(axis_angles))
    recovered = runtime_rotation.axis_angle_from_matrix(matrices)
    close(matrix_from_axis_angle(torch.from_numpy(recovered)), torch.from_numpy(matrices), 1e-7)


def test_turns_without_torch_come_back() -> None:
    for axis in ((1, 0, 0), (0, -1, 0), (0, 0, 1), (0.6, 0, -0.8), (0.48, 0.6, 0.64)):
        for angle in (0.0, 1e-10, 0.3, 1.6, 3.1):
            turn = angle * np.array(axis)
            found = runtime_rotation.axis_angle_from_matrix(runtime_rotation.matrix_from_axis_angle(turn))
            np.testing.assert_allclose(found, turn, rtol=0, atol=1e-9)


def test_compositions_round_as_without_torch() -> None:
    first, second = (torch.randn(4, 4, generator=torch.Generator().manual_seed(seed)) for seed in (1, 2))
    composed = compose_rigid(first, second)
    torch.testing.assert_close(composed, first @ second)
    np.testing.assert_array_equal(composed.numpy(), runtime_rotation.compose_rigid(first.numpy(), second.numpy()))
