"""Gaussians of GaussianAvatars stay on the surface, within limits to their place, size and tilt."""

import math

import pytest
import torch

from mien.avatar import GaussianStore
from mien.avatar.gaussian_avatars.settings import SurfaceLimits
from mien.avatar.gaussian_avatars.surface_limits import (
    keep_on_surface,
    keep_on_surface_reference,
    limits_of_triangles,
    pull_colors,
)
from mien.avatar.ops.triangle_frames import bind_to_world, triangle_ellipses
from mien.rotation import matrix_from_quaternion


@pytest.mark.parametrize(("hair", "widen"), [(0.0, 1.0), (0.01, 1.0), (0.0, 2.0)])
def test_limits_keep_gaussians_on_the_surface(hair: float, widen: float) -> None:
    torch.manual_seed(0)
    count, limits = 200, SurfaceLimits(enabled=True)
    values = {"means": torch.randn(count, 3), "quats": torch.randn(count, 4), "log_scales": torch.randn(count, 3)}
    store = GaussianStore(values, {"face_index": torch.arange(count) % 5})
    sizes = torch.tensor([0.001, 0.002, 0.004, 0.01, 0.1])
    widening = torch.full((5,), widen)
    table = limits_of_triangles(limits, sizes, torch.full((5,), hair), widening)
    keep_on_surface(store, table, limits.ratio)
    size = sizes[store["face_index"]]
    height, scales = store["means"][:, 1] * size, store["log_scales"].exp() * size[:, None]
    depth, thickness = widen * limits.depth, widen * limits.thickness
    assert (height <= depth + limits.hair_share * hair + 1e-7).all()
    assert (height >= -depth - 1e-7).all()
    assert (height.abs() > 0.9 * depth).any()
    assert (scales[:, 1] <= thickness + limits.hair_thickness * hair + 1e-7).all()
    flat = scales[:, [0, 2]]
    assert (flat <= limits.width + limits.hair_width * hair + 1e-7).all()
    assert (flat.amax(1) / flat.amin(1) <= limits.ratio * 1.0001).all()
    normal = matrix_from_quaternion(torch.nn.functional.normalize(store["quats"], dim=1))[:, 1, 1]
    assert (normal >= math.cos(math.radians(widen * limits.tilt)) - 1e-5).all()
    before = {name: store[name].clone() for name in store.names()}
    keep_on_surface(store, table, limits.ratio)
    for name, value in before.items():
        torch.testing.assert_close(store[name], value)


def some_gaussians(count: int) -> GaussianStore:
    generator = torch.Generator().manual_seed(3)
    shapes = {"means": (3,), "quats": (4,), "log_scales": (3,), "sh_constant": (1, 3)}
    values = {name: torch.randn(count, *shape, generator=generator) for name, shape in shapes.items()}
    values["quats"][:2] = 0
    return GaussianStore(values, {"face_index": torch.arange(count) % 5})


@pytest.mark.parametrize("count", [0, 1, 5000])
@pytest.mark.parametrize("pulled", [False, True])
def test_native_limits_equal_their_reference(count: int, pulled: bool) -> None:
    sizes, limits = torch.tensor([0.001, 0.002, 0.004, 0.01, 0.1]), SurfaceLimits(enabled=True)
    table = limits_of_triangles(limits, sizes, torch.tensor([0, 0.01, 0, 0.02, 0]), torch.tensor([1, 1, 2, 2, 50.0]))
    pulls = torch.tensor([[1.0, -1, 0.5, 0.1]] * 4 + [[1.0, -1, 0.5, 0]]) if pulled else None
    ours, theirs = some_gaussians(count), some_gaussians(count)
    keep_on_surface(ours, table, limits.ratio, pulls)
    keep_on_surface_reference(theirs, table, limits.ratio)
    if pulls is not None:
        pull_colors(theirs, pulls)
    for name in ours.names():
        torch.testing.assert_close(ours[name], theirs[name], rtol=1e-5, atol=1e-6)
    assert count == 0 or pulled == (not torch.equal(ours["sh_constant"], some_gaussians(count)["sh_constant"]))


def test_needles_grow_wider_and_not_shorter() -> None:
    """Training cannot hold a side that is thinner than a pixel. It must not take the longer side with it."""
    limits, sizes = SurfaceLimits(enabled=True), torch.ones(1)
    scales = torch.tensor([[0.004, 0.0001, 1e-7], [1e-7, 0.0001, 0.004], [0.9, 0.0001, 1e-7], [0.002, 0.0001, 0.001]])
    values = {"means": torch.zeros(4, 3), "quats": torch.eye(4)[:1].repeat(4, 1), "log_scales": scales.log()}
    store = GaussianStore(values, {"face_index": torch.zeros(4, dtype=torch.long)})
    keep_on_surface(store, limits_of_triangles(limits, sizes, torch.zeros(1)), limits.ratio)
    expected = [[0.004, 0.0001, 0.0008], [0.0008, 0.0001, 0.004], [0.006, 0.0001, 0.0012], [0.002, 0.0001, 0.001]]
    torch.testing.assert_close(store["log_scales"].exp(), torch.tensor(expected))


def test_ellipses_have_the_moments_of_their_triangles() -> None:
    torch.manual_seed(0)
    vertices, faces = torch.randn(9, 3), torch.arange(9).view(3, 3)
    quats, log_scales = triangle_ellipses(vertices, faces)
    _, world, scales = bind_to_world(vertices[None], faces, torch.arange(3), torch.zeros(3, 3), quats, log_scales)
    rotation = matrix_from_quaternion(world[0])
    found = rotation @ torch.diag_embed(scales[0] ** 2) @ rotation.mT
    corners = vertices[faces] - vertices[faces].mean(1, keepdim=True)
    expected = 2.0**2 / 12 * torch.einsum("fci,fcj->fij", corners, corners)
    normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = normal / normal.norm(dim=-1, keepdim=True)
    thin = torch.einsum("f,fi,fj->fij", scales[0].amin(-1) ** 2, normal, normal)
    torch.testing.assert_close(found, expected + thin, atol=1e-4, rtol=1e-3)
