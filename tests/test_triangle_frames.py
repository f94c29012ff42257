"""Triangle frames are right, and bound Gaussians move with them."""

import pytest
import torch
from torch import Tensor

from mien import _native
from mien.avatar.ops.triangle_frames import DEGENERATE_LENGTH, bind_to_world, frames_to_world, triangle_frames
from mien.rotation import matrix_from_axis_angle, matrix_from_quaternion


def random_rig(
    seed: int = 0, timesteps: tuple[int, ...] = (), dtype: torch.dtype = torch.float64
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return arguments of `bind_to_world`, at the size of a head."""
    generator = torch.Generator().manual_seed(seed)
    vertices = 0.1 * torch.randn(*timesteps, 20, 3, generator=generator, dtype=dtype)
    faces = torch.stack([torch.randperm(20, generator=generator)[:3] for _ in range(30)])
    face_index = torch.randint(0, 30, (100,), generator=generator)
    means = torch.randn(100, 3, generator=generator, dtype=dtype)
    quats = torch.randn(100, 4, generator=generator, dtype=dtype)
    log_scales = torch.randn(100, 3, generator=generator, dtype=dtype)
    return vertices, faces, face_index, means, quats, log_scales


def gradients(outputs: tuple[Tensor, ...], inputs: list[Tensor]) -> tuple[Tensor, ...]:
    """Return gradients of a loss that weighs every number of the outputs differently."""
    generator = torch.Generator().manual_seed(9)
    loss = sum((o * torch.randn(o.shape, generator=generator, dtype=torch.float64).to(o)).sum() for o in outputs)
    assert isinstance(loss, Tensor)
    return torch.autograd.grad(loss, inputs)


def test_frame_of_a_known_triangle():
    """A known triangle has the frame of the paper's formula."""
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
    torch.cat([output.square().flatten() for output in world]).sum().backward()
    for tensor in (*world, vertices.grad, *(tensor.grad for tensor in local)):
        assert tensor is not None
        assert tensor.isfinite().all()
    assert vertices.grad is not None
    assert vertices.grad[5].abs().sum() > 0


@pytest.mark.parametrize("timesteps", [(), (3,), (2, 2), (0,)])
@pytest.mark.parametrize("seed", [0, 1])
def test_native_equals_the_float64_reference(timesteps: tuple[int, ...], seed: int):
    vertices, faces, face_index, *local = random_rig(seed, timesteps)
    # Turned in every way, so that each of the four quaternion formulas is used; quaternions of any length.
    inputs = [tensor.requires_grad_() for tensor in (vertices, *local)]
    expected = bind_to_world(vertices, faces, face_index, *local)
    single = [tensor.detach().float().requires_grad_() for tensor in inputs]
    native = bind_to_world(single[0], faces, face_index, *single[1:])
    for value, reference in zip(native, expected, strict=True):
        assert value.dtype == torch.float32
        torch.testing.assert_close(value.double(), reference, atol=1e-6, rtol=2e-6)
    for value, reference in zip(gradients(native, single), gradients(expected, inputs), strict=True):
        error = (value.double() - reference).norm()
        assert error <= 2e-5 * reference.norm()  # 20 vertices carry 100 Gaussians: sums of many float32 terms


def test_native_uses_every_quaternion_formula():
    _, faces, *_ = random_rig()
    vertices = random_rig()[0]
    largest = triangle_frames(vertices, faces).R
    from_native = bind_to_world(
        vertices.float(), faces, torch.arange(30), torch.zeros(30, 3), torch.tensor([1.0, 0, 0, 0]).expand(30, 4),
        torch.zeros(30, 3),
    )[1]  # fmt: skip
    assert set(from_native.abs().argmax(-1).tolist()) == {0, 1, 2, 3}
    torch.testing.assert_close(matrix_from_quaternion(from_native).double(), largest, atol=2e-6, rtol=0)


def test_gradients_go_only_where_they_are_wanted():
    vertices, faces, face_index, *local = random_rig(dtype=torch.float32)
    local[0].requires_grad_()
    means, quats, scales = bind_to_world(vertices, faces, face_index, *local)
    quats.sum().backward(retain_graph=True)
    assert local[0].grad is not None
    assert local[0].grad.abs().max() == 0
    (means.sum() + scales.sum()).backward()
    assert local[0].grad.abs().min() > 0
    assert vertices.grad is None


def test_indices_are_checked():
    vertices, faces, face_index, *local = random_rig(dtype=torch.float32)
    with pytest.raises(IndexError, match="vertex"):
        bind_to_world(vertices, faces + 1, face_index, *local)
    with pytest.raises(IndexError, match="face"):
        bind_to_world(vertices, faces, face_index - 1, *local)


@pytest.mark.exact
def test_threads_do_not_change_a_bit():
    generator = torch.Generator().manual_seed(0)
    vertices, faces, *_ = random_rig(dtype=torch.float32)
    face_index = torch.randint(0, 30, (9000,), generator=generator)
    inputs = [vertices] + [torch.randn(9000, width, generator=generator) for width in (3, 4, 3)]
    for tensor in inputs:
        tensor.requires_grad_()
    results = []
    try:
        for threads in (1, 2, 3):
            _native.set_thread_count(threads)
            world = bind_to_world(inputs[0], faces, face_index, *inputs[1:])
            results.append((*world, *gradients(world, inputs)))
    finally:
        _native.set_thread_count(0)
    for result in results[1:]:
        assert all(torch.equal(one, other) for one, other in zip(result, results[0], strict=True))
