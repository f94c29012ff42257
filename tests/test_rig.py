"""Triangle frames and Gaussians bound to them."""

import pytest
import torch
from torch import Tensor

from mien.avatar.rig import DEGENERATE_LENGTH, bind_to_world, frames_to_world, triangle_frames
from mien.rotation import matrix_from_axis_angle, matrix_from_quaternion


def random_rig(
    seed: int = 0, timesteps: tuple[int, ...] = (), dtype: torch.dtype = torch.float64
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """The arguments of `bind_to_world`, at the size of a head."""
    generator = torch.Generator().manual_seed(seed)
    vertices = 0.1 * torch.randn(*timesteps, 20, 3, generator=generator, dtype=dtype)
    faces = torch.stack([torch.randperm(20, generator=generator)[:3] for _ in range(30)])
    face_index = torch.randint(0, 30, (100,), generator=generator)
    means = torch.randn(100, 3, generator=generator, dtype=dtype)
    quats = torch.randn(100, 4, generator=generator, dtype=dtype)
    log_scales = torch.randn(100, 3, generator=generator, dtype=dtype)
    return vertices, faces, face_index, means, quats, log_scales


def test_frame_of_a_known_triangle():
    vertices = torch.tensor([[0.0, 0, 0], [2, 0, 0], [0.5, 1, 0]])
    frames = triangle_frames(vertices, torch.tensor([[0, 1, 2]]))
    # Columns: first edge (+x), normal (+z), their cross product (-y).
    torch.testing.assert_close(frames.R[0], torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]))
    torch.testing.assert_close(frames.T[0], torch.tensor([2.5 / 3, 1 / 3, 0]))
    torch.testing.assert_close(frames.k[0], torch.tensor(1.5))


def test_frames_are_rotations_and_batch():
    vertices, faces, *_ = random_rig(timesteps=(2, 3))
    frames = triangle_frames(vertices, faces)
    assert frames.R.shape == (2, 3, 30, 3, 3)
    identity = torch.eye(3, dtype=torch.float64).expand_as(frames.R)
    torch.testing.assert_close(frames.R @ frames.R.transpose(-1, -2), identity)
    torch.testing.assert_close(torch.linalg.det(frames.R), torch.ones(2, 3, 30, dtype=torch.float64))
    alone = triangle_frames(vertices[1, 2], faces)
    torch.testing.assert_close(frames.k[1, 2], alone.k)


def test_gaussians_follow_a_similarity_of_the_mesh():
    vertices, faces, *local = random_rig()
    rotation = matrix_from_axis_angle(torch.tensor([0.3, -2.0, 1.0], dtype=torch.float64))
    shift = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    means, quats, scales = bind_to_world(vertices, faces, *local)
    moved_means, moved_quats, moved_scales = bind_to_world(2 * vertices @ rotation.T + shift, faces, *local)
    torch.testing.assert_close(moved_means, 2 * means @ rotation.T + shift)
    torch.testing.assert_close(matrix_from_quaternion(moved_quats), rotation @ matrix_from_quaternion(quats))
    torch.testing.assert_close(moved_scales, 2 * scales)


def test_a_gaussian_at_rest_takes_its_triangles_frame():
    vertices, faces, face_index, *_ = random_rig()
    zeros = torch.zeros(100, 3, dtype=torch.float64)
    unit = torch.tensor([3.0, 0, 0, 0], dtype=torch.float64).expand(100, 4)
    frames = triangle_frames(vertices, faces)
    means, quats, scales = bind_to_world(vertices, faces, face_index, zeros, unit, zeros)
    torch.testing.assert_close(means, frames.T[face_index])
    torch.testing.assert_close(matrix_from_quaternion(quats), frames.R[face_index])
    torch.testing.assert_close(scales, frames.k[face_index, None].expand(-1, 3))


def test_reference_gradients_equal_finite_differences():
    vertices, faces, face_index, *local = random_rig()

    def world(vertices: Tensor, means: Tensor, quats: Tensor, log_scales: Tensor) -> tuple[Tensor, ...]:
        frames = triangle_frames(vertices, faces)
        return frames_to_world(frames, face_index, means, quats, log_scales)

    inputs = [tensor.requires_grad_() for tensor in (vertices, *local)]
    assert torch.autograd.gradcheck(world, inputs, fast_mode=True)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_degenerate_triangles_stay_finite(dtype: torch.dtype):
    corners = [[0, 0, 0], [0, 0, 0], [1, 1, 1], [1e-9, 0, 0], [2, 2, 2], [1, 0, 0]]
    vertices = torch.tensor(corners, dtype=dtype, requires_grad=True)
    # A point, an edge without a length, collinear vertices, a sliver, and a sound one.
    faces = torch.tensor([[0, 0, 0], [0, 1, 2], [0, 2, 4], [0, 3, 2], [0, 5, 2]])
    local = [torch.randn(5, width, dtype=dtype, requires_grad=True) for width in (3, 4, 3)]
    frames = triangle_frames(vertices, faces)
    torch.testing.assert_close(frames.k[:4], torch.full((4,), DEGENERATE_LENGTH, dtype=dtype))
    world = bind_to_world(vertices, faces, torch.arange(5), *local)
    sum(output.square().sum() for output in world).backward()
    for tensor in (*world, vertices.grad, *(tensor.grad for tensor in local)):
        assert tensor is not None
        assert tensor.isfinite().all()
    assert vertices.grad is not None
    assert vertices.grad[5].abs().sum() > 0
