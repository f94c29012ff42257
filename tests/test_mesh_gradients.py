"""Gradients through rasterized meshes agree with finite differences of the same operations in float64, and areas."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from mesh_reference import antialias_reference, barycentrics_reference, mesh_loss_reference, sample_texture_reference
from mien import _native
from mien.face import FaceModel
from mien.render.mesh import MeshFragments, interpolate, interpolate_reference, rasterize_mesh, sample_texture
from mien.render.mesh_gradients import (
    LitMesh,
    MeshEdges,
    antialias,
    differentiable_fragments,
    image_points,
    mesh_edges,
    mesh_loss,
)
from test_mesh import camera_at


@dataclass(frozen=True)
class Scene:
    """Bumpy ball behind a smaller one, with silhouettes over the background and over another surface."""

    points: Tensor
    faces: Tensor
    fragments: MeshFragments
    edges: MeshEdges


def ball(rings: int, around: int, radius: float, center: list[float], random: torch.Generator) -> tuple[Tensor, Tensor]:
    turns = torch.arange(around) * 2 * torch.pi / around
    polar, angle = torch.meshgrid(torch.linspace(0.1, 3.0, rings), turns, indexing="ij")
    points = torch.stack([polar.sin() * angle.cos(), polar.cos(), polar.sin() * angle.sin()], -1).reshape(-1, 3)
    points = points * radius * (1 + 0.05 * torch.randn(len(points), 1, generator=random)) + torch.tensor(center)
    ring, column = torch.meshgrid(torch.arange(rings - 1), torch.arange(around), indexing="ij")
    first, second = ring * around + column, ring * around + (column + 1) % around
    quads = torch.stack([first, second, first + around, second, second + around, first + around], -1)
    return points, quads.reshape(-1, 3)


@pytest.fixture(scope="module")
def scene() -> Scene:
    random = torch.Generator().manual_seed(0)
    large, large_faces = ball(12, 16, 0.5, [0.05, 0.0, 0.0], random)
    small, small_faces = ball(8, 10, 0.2, [-0.1, 0.1, 0.8], random)
    vertices, faces = torch.cat([large, small]), torch.cat([large_faces, small_faces + len(large)])
    camera = camera_at([0.2, 0.1, 3.0], 0.6, 40).cropped(0.0, 2.0, 40, 36)
    return Scene(image_points(camera, vertices), faces, rasterize_mesh(vertices, faces, camera), mesh_edges(faces))


def loss_weights(shape: tuple[int, ...]) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)


def finite_difference(function: Callable[[Tensor], Tensor], at: Tensor, step: float) -> tuple[Tensor, Tensor]:
    """Return some entries of a function's gradient and their derivatives by central differences."""
    flat = at.double().flatten()
    chosen = torch.randperm(len(flat), generator=torch.Generator().manual_seed(9))[:24]
    out = []
    for index in chosen:
        shift = torch.zeros_like(flat)
        shift[index] = step
        ends = [float(function((flat + sign * shift).view(at.shape))) for sign in (1, -1)]
        out.append((ends[0] - ends[1]) / (2 * step))
    return chosen, torch.tensor(out, dtype=torch.float64)


def gradient(function: Callable[[Tensor], Tensor], at: Tensor) -> Tensor:
    at = at.clone().requires_grad_()
    return torch.autograd.grad(function(at), at)[0].double()


def assert_close(value: Tensor, expected: Tensor | tuple[Tensor, Tensor], relative: float) -> None:
    if isinstance(expected, tuple):
        value, expected = value.flatten()[expected[0]], expected[1]
    assert float((value.double() - expected).norm() / expected.norm()) < relative


TOLERANCE = 1e-4


def test_interpolation_moves_with_the_vertices(scene: Scene):
    attributes, weights = torch.rand(len(scene.points), 2).double(), loss_weights((36, 40, 2))

    def reference(points: Tensor) -> Tensor:
        seen = replace(scene.fragments, barycentric=barycentrics_reference(scene.fragments, points, scene.faces))
        return (interpolate_reference(seen, attributes, scene.faces) * weights).sum()

    def function(points: Tensor) -> Tensor:
        seen = differentiable_fragments(scene.fragments, points, scene.faces)
        return (interpolate(seen, attributes.float(), scene.faces) * weights).sum()

    assert_close(function(scene.points), reference(scene.points.double()), 1e-5)
    assert_close(gradient(function, scene.points), finite_difference(reference, scene.points, 1e-7), TOLERANCE)
    exact = barycentrics_reference(scene.fragments, scene.points.double(), scene.faces)
    torch.testing.assert_close(exact.float(), scene.fragments.barycentric, atol=2e-4, rtol=0)


def test_texture_lookup_has_both_gradients():
    random, weights = torch.Generator().manual_seed(1), loss_weights((9, 4, 3))
    texture = torch.rand(5, 7, 3, generator=random)
    uv = torch.rand(9, 4, 2, generator=random) * 1.2 - 0.1  # also beyond the borders

    def exact(texture: Tensor, uv: Tensor) -> Tensor:
        return (sample_texture_reference(texture.double(), uv.double()) * weights).sum()

    expected = sample_texture_reference(texture.double(), uv.double())
    torch.testing.assert_close(sample_texture(texture, uv).double(), expected, atol=1e-6, rtol=1e-6)
    by_texture = finite_difference(lambda value: exact(value, uv), texture, 1e-3)
    by_uv = finite_difference(lambda value: exact(texture, value), uv, 1e-7)
    assert_close(gradient(lambda value: (sample_texture(value, uv) * weights).sum(), texture), by_texture, TOLERANCE)
    assert_close(gradient(lambda value: (sample_texture(texture, value) * weights).sum(), uv), by_uv, 10 * TOLERANCE)


def test_antialiasing_moves_with_silhouettes(scene: Scene):
    image, weights = torch.rand(36, 40, 3, generator=torch.Generator().manual_seed(2)), loss_weights((36, 40, 3))
    points = scene.points

    def draw(function: Callable[..., Tensor], image: Tensor, points: Tensor) -> Tensor:
        return function(image, scene.fragments, points, scene.faces, scene.edges)

    def exact(image: Tensor, points: Tensor) -> Tensor:
        return (draw(antialias_reference, image.double(), points.double()) * weights).sum()

    expected = draw(antialias_reference, image.double(), points.double())
    assert ((expected - image).abs().sum(-1) > 1e-3).sum() > 80
    torch.testing.assert_close(draw(antialias, image, points).double(), expected, atol=1e-5, rtol=0)
    by_points = finite_difference(lambda value: exact(image, value), points, 1e-7)
    by_image = gradient(lambda value: exact(value, points), image.double())
    assert_close(gradient(lambda value: (draw(antialias, image, value) * weights).sum(), points), by_points, TOLERANCE)
    assert_close(gradient(lambda value: (draw(antialias, value, points) * weights).sum(), image), by_image, TOLERANCE)


@pytest.mark.parametrize("field", ["points", "normals", "texture", "light"])
def test_loss_has_the_gradients_of_finite_differences(scene: Scene, field: str):
    """And it draws the picture that it compares."""
    random = torch.Generator().manual_seed(4)
    used = torch.rand(len(scene.faces), generator=random) > 0.15
    mesh = LitMesh(
        scene.faces, torch.rand(len(scene.faces), 3, 2, generator=random),
        used * (0.5 + torch.rand(len(used), generator=random)), mesh_edges(scene.faces, used),
    )  # fmt: skip
    inputs = {
        "points": scene.points, "normals": torch.randn(len(scene.points), 3, generator=random),
        "texture": torch.rand(6, 5, 3, generator=random), "light": torch.rand(9, 3, generator=random),
    }  # fmt: skip
    target, mask = torch.rand(36, 40, 3, generator=random), torch.rand(36, 40, generator=random)
    picture = torch.empty(36, 40, 3)

    def exact(values: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        values = {name: value.double() for name, value in values.items()}
        rest = replace(mesh, face_weights=mesh.face_weights.double())
        goal = (target.double(), mask.double(), 0.05)
        return mesh_loss_reference(scene.fragments, mesh=rest, target=goal, **values)

    def function(value: Tensor) -> Tensor:
        values = inputs | {field: value}
        return mesh_loss(scene.fragments, mesh=mesh, target=(target, mask, 0.05), picture=picture, **values)

    expected = finite_difference(lambda value: exact(inputs | {field: value})[0], inputs[field], 1e-6)
    loss, drawn = exact(inputs)
    assert abs(float(function(inputs[field])) - float(loss)) < 1e-6
    torch.testing.assert_close(picture.double(), drawn, atol=1e-4, rtol=0)
    assert_close(gradient(function, inputs[field]), expected, TOLERANCE)


def test_edges_of_a_square():
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    edges = mesh_edges(faces)
    rows = [tuple(row) for row in torch.cat([edges.vertices, edges.faces, edges.opposite[:, None]], 1).tolist()]
    assert rows == [(0, 1, 0, -1, 2), (0, 2, 0, 1, 1), (0, 3, 1, -1, 2), (1, 2, 0, -1, 0), (2, 3, 1, -1, 0)]
    assert mesh_edges(faces, torch.tensor([True, False])).vertices.tolist() == [[0, 1], [1, 2]]


@pytest.mark.parametrize("size", [256, 512])
def test_silhouette_gradient_of_a_head_is_that_of_its_area(anny: FaceModel, size: int):
    vertices, faces, camera = anny(anny.neutral())[0], anny.faces, camera_at([0.15, 0.0, 0.6], 0.55, size)
    fragments, edges = rasterize_mesh(vertices, faces, camera), mesh_edges(faces)
    covered, fine = (fragments.face_index >= 0)[..., None].float(), camera.resized(2 * size, 2 * size)

    def area(scale: Tensor) -> Tensor:
        return antialias(covered, fragments, image_points(camera, vertices * scale), faces, edges).sum()

    def pixels(scale: float) -> float:
        return float((rasterize_mesh(vertices * scale, faces, fine).face_index >= 0).sum()) / 4

    assert 0.97 < float(gradient(area, torch.tensor(1.0))) / ((pixels(1.01) - pixels(0.99)) / 0.02) < 1.03


def test_native_operations_refuse_what_does_not_belong_together(scene: Scene):
    found, wrong = scene.fragments, torch.zeros(len(scene.points) + 1, 3, dtype=torch.float64)
    native = _native.Fragments(found.face_index, found.barycentric, found.depth)
    with pytest.raises(ValueError, match="shape"):
        _native.barycentric_backward(native, scene.points, scene.faces, torch.zeros(36, 40, 3), wrong)
    with pytest.raises(IndexError, match="vertex"):
        antialias(torch.zeros(36, 40, 1), found, scene.points[:5], scene.faces, scene.edges)
