"""Gradients through rasterized meshes agree with finite differences of the same operations in float64, and areas."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import pytest
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from mien.face import FaceModel
from mien.render.mesh import MeshFragments, interpolate_reference, rasterize_mesh, sample_texture, shade
from mien.render.mesh_gradients import LitMesh, MeshEdges, image_points, mesh_edges, mesh_loss
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


def test_texture_lookup():
    random = torch.Generator().manual_seed(1)
    texture = torch.rand(5, 7, 3, generator=random)
    uv = torch.rand(9, 4, 2, generator=random) * 1.2 - 0.1  # also beyond the borders
    torch.testing.assert_close(sample_texture(texture, uv), sample_texture_reference(texture, uv))


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
    fragments = rasterize_mesh(vertices, faces, camera)
    mesh = LitMesh(faces, torch.zeros(len(faces), 3, 2), torch.ones(len(faces)), mesh_edges(faces))
    white, light = torch.ones(1, 1, 3), torch.zeros(9, 3)
    light[0] = math.sqrt(4 * math.pi)
    black = (torch.zeros(size, size, 3), torch.ones(size, size), 1e-6)
    covered, fine = (fragments.face_index >= 0).sum(), camera.resized(2 * size, 2 * size)

    def area(scale: Tensor) -> Tensor:
        """The sum of a white picture before black: each pixel counts with the root of three."""
        points = image_points(camera, vertices * scale)
        return (
            covered / math.sqrt(3) * mesh_loss(fragments, points, torch.ones(len(points), 3), mesh, white, light, black)
        )

    def pixels(scale: float) -> float:
        return float((rasterize_mesh(vertices * scale, faces, fine).face_index >= 0).sum()) / 4

    assert 0.97 < float(gradient(area, torch.tensor(1.0))) / ((pixels(1.01) - pixels(0.99)) / 0.02) < 1.03


def test_native_operations_refuse_what_does_not_belong_together(scene: Scene):
    mesh = LitMesh(scene.faces, torch.zeros(len(scene.faces), 3, 2), torch.ones(len(scene.faces)), scene.edges)
    target = (torch.zeros(36, 40, 3), torch.ones(36, 40), 0.05)
    with pytest.raises(IndexError, match="vertex"):
        mesh_loss(
            scene.fragments, scene.points[:5], torch.ones(5, 3), mesh, torch.ones(2, 2, 3), torch.ones(9, 3), target
        )


def barycentrics_reference(
    fragments: MeshFragments, points: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"]
) -> Float[Tensor, "h w 3"]:
    """Barycentrics of the fragments' triangles, computed from image points and clamped at 0."""
    covered = fragments.face_index >= 0
    rows, columns = covered.nonzero().unbind(1)
    pixels = torch.stack([columns + 0.5, rows + 0.5, torch.ones(len(rows))], dim=-1).to(points)
    a, b, c = points[faces[fragments.face_index[covered].long()]].unbind(1)
    volumes = [(torch.linalg.cross(p, q) * pixels).sum(-1) for p, q in ((b, c), (c, a), (a, b))]
    weights = torch.stack(volumes, dim=-1)
    weights = weights * torch.sign(weights.detach().sum(-1, keepdim=True))
    weights = torch.where(fragments.barycentric[covered] > 0, weights, torch.zeros_like(weights)).clamp_min(0)
    out = points.new_zeros(*covered.shape, 3)
    return out.masked_scatter(covered[..., None], weights / weights.sum(-1, keepdim=True))


def sample_texture_reference(texture: Float[Tensor, "th tw c"], uv: Float[Tensor, "*n 2"]) -> Float[Tensor, "*n c"]:
    grid = torch.stack([2 * uv[..., 0] - 1, 1 - 2 * uv[..., 1]], dim=-1).reshape(1, 1, -1, 2)
    sampled = grid_sample(
        texture.permute(2, 0, 1)[None], grid, mode="bilinear", padding_mode="border", align_corners=False
    )
    return sampled[0, :, 0].T.reshape(*uv.shape[:-1], -1)


def antialias_reference(image, fragments, points, faces, edges) -> Float[Tensor, "h w c"]:
    inner, outer, position = _crossings(fragments, points, faces, edges)
    beyond = position - 0.5
    changed, other = torch.where(beyond > 0, outer, inner), torch.where(beyond > 0, inner, outer)
    flat = image.flatten(0, 1)
    return flat.index_add(0, changed, beyond.abs()[:, None] * (flat[other] - flat[changed])).view(image.shape)


def mesh_loss_reference(fragments, points, normals, mesh, texture, light, target) -> tuple[Tensor, Tensor]:
    """Take what `mien.render.mesh_gradients.mesh_loss` takes, and return its value and the drawn picture."""
    image, mask, epsilon = target
    seen = MeshFragments(fragments.face_index, barycentrics_reference(fragments, points, mesh.faces), fragments.depth)
    corners = torch.arange(3 * len(mesh.faces)).view(-1, 3)
    uv = interpolate_reference(seen, mesh.uv.to(points).flatten(0, 1), corners)
    directions = normalize(interpolate_reference(seen, normals, mesh.faces), dim=-1)
    face_weight = torch.cat([mesh.face_weights, mesh.face_weights.new_zeros(1)])[fragments.face_index.long()]
    colors = torch.where(
        (face_weight > 0)[..., None], sample_texture_reference(texture, uv) * shade(directions, light), image
    )
    picture = antialias_reference(colors, seen, points, mesh.faces, mesh.edges)
    weight = mask * torch.where(face_weight > 0, face_weight, torch.ones_like(face_weight))
    lengths = ((picture - image).square().sum(-1) + epsilon**2).sqrt() - epsilon
    return (weight * lengths).sum() / (mask * face_weight).sum().clamp_min(1), picture


def _crossings(
    fragments: MeshFragments, points: Tensor, faces: Int[Tensor, "f 3"], edges: MeshEdges
) -> tuple[Int[Tensor, " n"], Int[Tensor, " n"], Float[Tensor, " n"]]:
    """Inner and outer pixel of every crossing of a silhouette, and its position between them (0..1, differentiable)."""
    a, b, c = points.detach()[faces].unbind(1)
    front = torch.sign((a * torch.linalg.cross(b, c)).sum(-1))
    first, second = edges.faces.long().unbind(1)
    silhouette = ((second < 0) | (front[first] != front[second])).nonzero()[:, 0]
    ends = points[edges.vertices[silhouette].long()]
    xy, inverse_depth = ends[..., :2] / ends[..., 2:], 1 / ends[..., 2]
    third = points.detach()[edges.opposite[silhouette].long()]
    inside = third[:, :2] / third[:, 2:] - xy[:, 0].detach()
    step = (xy[:, 1] - xy[:, 0]).detach()
    vertical = (step[:, 0].abs() > step[:, 1].abs()).long()  # 1 for pixels one above the other.
    side = step[:, 0] * inside[:, 1] - step[:, 1] * inside[:, 0]
    towards = torch.where(vertical == 1, side * step[:, 0], -side * step[:, 1]) < 0

    height, width = fragments.face_index.shape
    pick = vertical[:, None, None].expand(-1, 2, 1)
    along, across = xy.gather(2, 1 - pick)[..., 0], xy.gather(2, pick)[..., 0]
    lines = torch.arange(max(height, width)).to(points) + 0.5
    low, high = along.detach().amin(1), along.detach().amax(1)
    crossed = (lines >= low[:, None]) & (lines < high[:, None])
    crossed &= lines < torch.where(vertical == 1, width, height)[:, None]
    edge, line = crossed.nonzero().unbind(1)

    t = (lines[line] - along[edge, 0]) / (along[edge, 1] - along[edge, 0])
    at = across[edge, 0] + t * (across[edge, 1] - across[edge, 0])
    depth = 1 / (inverse_depth[edge, 0] + t * (inverse_depth[edge, 1] - inverse_depth[edge, 0]))
    before = (at.detach() - 0.5).floor()
    vertical, towards = vertical[edge], towards[edge]
    inner = (before + (~towards).to(before)).long()
    outer = (before + towards.to(before)).long()
    size = torch.where(vertical == 1, height, width)
    within = (torch.minimum(inner, outer) >= 0) & (torch.maximum(inner, outer) < size)
    kept = within.nonzero()[:, 0]
    inner, outer = (
        torch.where(vertical[kept] == 1, pixel[kept] * width + line[kept], line[kept] * width + pixel[kept])
        for pixel in (inner, outer)
    )
    beyond = (at - 0.5 - before)[kept]
    position = torch.where(towards[kept], beyond, 1 - beyond)
    seen = fragments.face_index.flatten()[inner] >= 0
    seen &= depth.detach()[kept] < fragments.depth.flatten()[outer]
    inner, outer, position = inner[seen], outer[seen], position[seen]
    outermost = _outermost(inner * height * width + outer, position.detach())
    return inner[outermost], outer[outermost], position[outermost]


def _outermost(pair: Int[Tensor, " n"], position: Float[Tensor, " n"]) -> Int[Tensor, " k"]:
    """Indices of the entries with the largest position of each pair (the first of equal ones)."""
    best: dict[int, int] = {}
    for index, (key, value) in enumerate(zip(pair.tolist(), position.tolist(), strict=True)):
        if key not in best or value > float(position[best[key]]):
            best[key] = index
    return torch.tensor(sorted(best.values()), dtype=torch.long)
