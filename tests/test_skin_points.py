"""Points in other poses of a skeleton: native against PyTorch, finite differences, and the inverse of skinning."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from mien import _native
from mien.avatar.ops.skin_points import blend_transforms, skin_points, skin_points_reference, unskin
from toy_scene import toy_face, toy_face_model

SIZES = [(3000, 1, 6), (7, 3, 2), (1, 1, 1), (0, 2, 3)]
"""Points, poses, bones."""


def arguments(sizes: tuple[int, int, int], dtype: torch.dtype = torch.float32) -> list[Tensor]:
    """Points, displacements, weights, and bones in both poses. Every third point's gradient will be 0."""
    n, b, k = sizes
    generator = torch.Generator().manual_seed(n)

    def random(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    identity = torch.eye(3, 4)
    bones = [identity + 0.1 * random(k, 3, 4), identity + 0.2 * random(b, k, 3, 4)]
    made = [random(n, 3), 0.1 * random(b, n, 3), random(n, k).softmax(-1), *bones]
    return [tensor.to(dtype) for tensor in made]


def results(given: list[Tensor], native: bool) -> list[Tensor]:
    """Posed points and gradients."""
    leaves = [tensor.clone().requires_grad_(index != 3) for index, tensor in enumerate(given)]
    posed = (skin_points if native else skin_points_reference)(*leaves)
    by = torch.randn(posed.shape, generator=torch.Generator().manual_seed(1))
    by[:, ::3] = 0
    wanted = [leaf for leaf in leaves if leaf.requires_grad]
    return [posed.detach(), *torch.autograd.grad(posed, wanted, by.to(posed))]


@pytest.mark.parametrize("sizes", SIZES, ids=str)
def test_native_points_and_gradients_equal_their_reference(sizes: tuple[int, int, int]) -> None:
    given = arguments(sizes)
    expected = results([tensor.double() for tensor in given], native=False)
    for index, (own, truth) in enumerate(zip(results(given, native=True), expected, strict=True)):
        assert own.shape == truth.shape
        assert float((own.double() - truth).norm() / truth.norm().clamp_min(1e-6)) < 1e-5, index


def test_reference_has_the_gradients_of_finite_differences() -> None:
    given = [tensor.requires_grad_(i != 3) for i, tensor in enumerate(arguments((4, 2, 3), torch.float64))]
    assert torch.autograd.gradcheck(skin_points_reference, given)


def test_threads_do_not_change_a_bit() -> None:
    before, found = _native.thread_count(), []
    for threads in (1, 3):
        _native.set_thread_count(threads)
        found.append(results(arguments(SIZES[0]), native=True))
    _native.set_thread_count(before)
    assert all(torch.equal(one, two) for one, two in zip(*found, strict=True))


def test_unskin_undoes_blended_transforms() -> None:
    torch.manual_seed(0)
    face_model = toy_face_model()
    face = replace(toy_face(5), joints=torch.randn(5, 1, 3))
    weights = torch.rand(20, 3).softmax(-1)
    transforms = blend_transforms(weights, face_model.joint_transforms(face)[:, :, :3])[2]
    points = torch.randn(20, 3)
    moved = torch.stack(
        [transform[:, :3] @ x + transform[:, 3] for transform, x in zip(transforms, points, strict=True)]
    )
    torch.testing.assert_close(unskin(moved, transforms), points, atol=1e-5, rtol=1e-5)
