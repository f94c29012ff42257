"""The mesh rasterizer handles coverage, perspective, depth order and the near plane, and its pictures are right."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor
from torch.nn.functional import avg_pool2d

from mien.camera import Camera, camera_from_fov, look_at
from mien.render.mesh import (
    Headlight,
    interpolate,
    interpolate_reference,
    rasterize_mesh,
    render_mesh,
    sh_basis,
    shade,
    vertex_normals,
)


def pixel_camera(width: int = 16, height: int = 12) -> Camera:
    """Return a camera for which world x and y at depth 1 are pixels."""
    return Camera(torch.eye(3), torch.eye(4), width, height)


def at_depth(pixels: Sequence[tuple[float, float, float]]) -> Tensor:
    """Return the world points of (x, y, depth) for `pixel_camera`."""
    points = torch.tensor(pixels, dtype=torch.float32)
    return torch.cat([points[:, :2] * points[:, 2:], points[:, 2:]], dim=-1)


def random_mesh(seed: int = 0, faces: int = 60) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    vertices = torch.randn(40, 3, generator=generator) * 0.3
    return vertices, torch.randint(0, 40, (faces, 3), generator=generator)


def camera_at(position: list[float], fov_x: float, size: int) -> Camera:
    """Return a square camera that looks at the origin."""
    viewmat = look_at(torch.tensor(position), torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]))
    return camera_from_fov(fov_x, size, size, viewmat)


head_camera = partial(camera_at, [0.2, 0.1, 1.2], 0.9)


def test_a_known_triangle_lands_on_known_pixels_and_the_nearest_is_seen():
    vertices = at_depth([(2, 1, 1), (6, 1, 1), (2, 5, 1)])
    fragments = rasterize_mesh(vertices, torch.tensor([[0, 1, 2]]), pixel_camera())
    rows, columns = (fragments.face_index >= 0).nonzero().unbind(1)
    # Centres on the slanted edge x + y = 7 belong to the triangle on its other side: it is no top or left edge.
    expected = {(row, column) for row in range(1, 5) for column in range(2, 6) if row + column + 1 < 7}
    assert set(zip(rows.tolist(), columns.tolist(), strict=True)) == expected
    assert (fragments.depth[1, 2], fragments.depth[0, 0]) == (1, torch.inf)
    assert fragments.barycentric[0, 0].sum() == 0
    torch.testing.assert_close(fragments.barycentric[1, 2], torch.tensor([0.75, 0.125, 0.125]))
    for order, seen in (([0, 1, 2], False), ([0, 2, 1], True)):  # clockwise, counter-clockwise
        culled = rasterize_mesh(vertices, torch.tensor([order]), pixel_camera(), cull_backfaces=True)
        assert bool((culled.face_index == 0).any()) == seen
    near, far = [(1, 1, 1), (9, 1, 1), (1, 9, 1)], [(0, 0, 2), (15, 0, 2), (0, 11, 2)]
    vertices = at_depth(near + far)
    for faces, expected in (([[0, 1, 2], [3, 4, 5]], 0), ([[3, 4, 5], [0, 1, 2]], 1)):
        fragments = rasterize_mesh(vertices, torch.tensor(faces), pixel_camera())
        assert (fragments.face_index[3, 3], fragments.depth[3, 3]) == (expected, 1)
        assert fragments.face_index[0, 5] == 1 - expected


@pytest.mark.parametrize("seed", range(4))
def test_every_pixel_of_a_tessellated_quad_is_covered_exactly_once(seed: int):
    generator = torch.Generator().manual_seed(seed)
    size, cells = 32, 9
    # Vertices on pixel centres as well as anywhere, so that edges pass exactly through centres.
    line = torch.linspace(-4.5, 36.5, cells + 1)
    grid = torch.stack(torch.meshgrid(line, line, indexing="xy"), -1)
    grid[1:-1, 1:-1] += 2 * torch.rand(cells - 1, cells - 1, 2, generator=generator) - 1
    grid[::2] = grid[::2].round() + 0.5
    vertices = at_depth([(x, y, 1.0) for x, y in grid.flatten(0, 1).tolist()])
    corner = (torch.arange(cells)[:, None] * (cells + 1) + torch.arange(cells)).flatten()
    first = torch.stack([corner, corner + 1, corner + cells + 1], -1)
    second = torch.stack([corner + 1, corner + cells + 2, corner + cells + 1], -1)
    faces = torch.cat([first, second[:, [0, 2, 1]]])  # both windings
    hits = sum((rasterize_mesh(vertices, face[None], pixel_camera(size, size)).face_index >= 0).int() for face in faces)
    assert isinstance(hits, Tensor)
    assert (hits == 1).all()


def test_interpolation_is_perspective_correct_and_that_of_its_reference():
    vertices, faces = random_mesh()
    camera = head_camera(96)
    fragments = rasterize_mesh(vertices, faces, camera)
    covered = fragments.face_index >= 0
    assert covered.sum() > 1000
    # In float64: the point where the ray through the pixel's centre meets the triangle's plane.
    rows, columns = covered.nonzero().unbind(1)
    pixels = torch.stack([columns + 0.5, rows + 0.5, torch.ones(len(rows))], -1).double()
    rays = pixels @ camera.K.double().inverse().T
    points = vertices.double() @ camera.viewmat[:3, :3].double().T + camera.viewmat[:3, 3].double()
    corners = points[faces[fragments.face_index[covered].long()]]
    scaled = torch.linalg.solve(corners.transpose(1, 2), rays[..., None])[..., 0]
    torch.testing.assert_close(fragments.depth[covered].double(), 1 / scaled.sum(-1), rtol=2e-3, atol=0)
    expected = scaled / scaled.sum(-1, keepdim=True)
    # Snapping to 1/256 pixel moves a centre at most that far out of its triangle, where weights are clamped at 0.
    inside = (expected > 0).all(-1)
    assert inside.float().mean() > 0.98
    torch.testing.assert_close(fragments.barycentric[covered][inside].double(), expected[inside], atol=1e-5, rtol=1e-5)
    projected, _ = camera.project(interpolate(fragments, vertices, faces)[covered][inside])
    torch.testing.assert_close(projected.double(), pixels[inside, :2], atol=1e-2, rtol=0)
    vertices, faces = random_mesh()
    fragments = rasterize_mesh(vertices, faces, head_camera(96))
    for attributes, corners in ((torch.randn(40, 5), faces), (torch.randn(60, 3, 4), torch.arange(180).view(60, 3))):
        expected = interpolate_reference(fragments, attributes.flatten(0, -2).double(), corners)
        found = interpolate(fragments, attributes, faces)
        torch.testing.assert_close(found.double(), expected, atol=1e-5, rtol=1e-5)


def test_a_triangle_through_the_near_plane_is_cut_there():
    # A floor 1 m below the camera that starts 5 m behind it: everything under the horizon is floor.
    vertices = torch.tensor([[-100.0, 1, -5], [100, 1, -5], [100, 1, 1000], [-100, 1, 1000]])
    camera = camera_from_fov(1.5, 64, 64)
    fragments = rasterize_mesh(vertices, torch.tensor([[0, 1, 2], [0, 2, 3]]), camera)
    focal = float(camera.K[0, 0])
    row = torch.arange(34, 64) + 0.5
    depth = focal / (row - 32)
    assert (fragments.face_index[:32] == -1).all()
    torch.testing.assert_close(fragments.depth[34:], depth[:, None].expand(-1, 64), rtol=1e-4, atol=0)
    # A wall on the plane z = 0.01 + x, which meets the near plane on the optical axis: only its right half is left.
    wall = torch.tensor([[-1.0, -9, -0.99], [1, -9, 1.01], [1, 9, 1.01], [-1, 9, -0.99]])
    seen = rasterize_mesh(wall, torch.tensor([[0, 1, 2], [0, 2, 3]]), camera_from_fov(2.0, 64, 64)).face_index >= 0
    assert not seen[:, :32].any()
    assert seen[:, 32:50].all()
    beyond = rasterize_mesh(vertices - torch.tensor([0, 0, 2000.0]), torch.tensor([[0, 1, 2]]), camera)
    assert (beyond.face_index == -1).all()
    close = torch.tensor([[-1.0, -1, 0.009], [1, -1, 0.009], [0, 1, 0.009]])
    assert (rasterize_mesh(close, torch.tensor([[0, 1, 2]]), camera).face_index == -1).all()
    assert (rasterize_mesh(close * 1.2, torch.tensor([[0, 1, 2]]), camera).face_index == 0).any()


def test_bad_input_is_dropped_or_refused():
    vertices = at_depth([(2, 1, 1), (6, 1, 1), (2, 5, 1), (1e30, 3, 1), (3, 3, 1)])
    vertices = torch.cat([vertices, torch.tensor([[torch.nan, 0, 1], [torch.inf, 0, 1]])])
    faces = torch.tensor([[0, 1, 5], [0, 1, 6], [0, 0, 0], [0, 4, 4], [0, 1, 2]])
    assert set(rasterize_mesh(vertices, faces, pixel_camera()).face_index.unique().tolist()) == {-1, 4}
    huge = rasterize_mesh(vertices, torch.tensor([[0, 3, 2]]), pixel_camera())
    assert huge.barycentric.isfinite().all()
    assert (rasterize_mesh(vertices, faces[:0], pixel_camera()).face_index == -1).all()
    with pytest.raises(IndexError, match="vertex"):
        rasterize_mesh(vertices, torch.tensor([[0, 1, 7]]), pixel_camera())


def test_harmonics_are_orthonormal_and_light_is_linear():
    z = torch.linspace(-1, 1, 2001).double()
    angle = torch.arange(64).double() * (2 * torch.pi / 64)
    ring = (1 - z * z).clamp_min(0).sqrt()[:, None]
    directions = torch.stack([ring * angle.cos(), ring * angle.sin(), z[:, None].expand(-1, 64)], -1).flatten(0, 1)
    basis = sh_basis(directions)
    gram = 4 * torch.pi * basis.T @ basis / len(directions)
    torch.testing.assert_close(gram, torch.eye(9).double(), atol=1e-2, rtol=0)
    light = torch.zeros(9, 3).double()
    light[0] = (4 * torch.pi) ** 0.5
    torch.testing.assert_close(shade(directions[:5], light), torch.ones(5, 3).double())
    light[0], light[1] = 0, 1
    assert shade(torch.tensor([[0.0, 1, 0]]).double(), light).min() > 0.4


def test_picture_of_a_sphere():
    sphere = trimesh.creation.icosphere(subdivisions=4)
    vertices, faces = torch.tensor(np.array(sphere.vertices)).float(), torch.tensor(np.array(sphere.faces)).long()
    camera = camera_at([0.0, 0.0, 4.0], 0.8, 64)
    radius = float(camera.K[0, 0]) / (4**2 - 1) ** 0.5
    image, alpha = render_mesh(vertices, faces, camera, background=(0.0, 0.0, 1.0), supersample=4)
    fine, _ = render_mesh(vertices, faces, camera.resized(256, 256), background=(0.0, 0.0, 1.0))
    torch.testing.assert_close(image, avg_pool2d(fine.permute(2, 0, 1), 4).permute(1, 2, 0))
    assert (vertex_normals(torch.stack([vertices, 2 * vertices]), faces) * vertices).sum(-1).min() > 0.999
    assert vertex_normals(torch.zeros(3, 3), torch.tensor([[0, 1, 2]])).abs().max() == 0
    assert abs(float(alpha.sum()) / (torch.pi * radius**2) - 1) < 0.005  # a box filter measures areas
    torch.testing.assert_close(image[0, 0], torch.tensor([0.0, 0.0, 1.0]))
    assert image[20, 20, 0] > image[44, 44, 0] + 0.2, "the lamp is up and to the left"
    lit, _ = render_mesh(vertices, faces, camera, light=Headlight(direction=(0.0, 0.0, -1.0), ambient=0.0))
    torch.testing.assert_close(lit[32, 32], torch.full((3,), 0.75), atol=2e-3, rtol=0)
    behind = torch.rand(64, 64, 3)
    colored, _ = render_mesh(vertices, faces, camera, vertices * 0.5 + 0.5, background=behind)
    torch.testing.assert_close(colored[32, 32], torch.tensor([0.5, 0.5, 1.0]), atol=0.02, rtol=0)
    torch.testing.assert_close(colored[0], behind[0])


def test_threads_draw_the_same_pictures():
    vertices, faces = random_mesh()
    cameras = [head_camera(size) for size in (48, 96, 33, 64)] * 4
    with ThreadPoolExecutor(4) as pool:
        drawn = list(pool.map(lambda camera: rasterize_mesh(vertices, faces, camera), cameras))
    for camera, fragments in zip(cameras, drawn, strict=True):
        alone = rasterize_mesh(vertices, faces, camera)
        assert torch.equal(alone.barycentric, fragments.barycentric)
        assert torch.equal(alone.face_index, fragments.face_index)
