"""Cameras keep the conventions: OpenCV axes, pixel centres at one half, world to camera."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from mien.camera import Camera, camera_from_fov, camera_from_opengl, look_at
from mien.gaussians import Gaussians
from mien.render import rasterize
from mien.rotation import invert_rigid, matrix_from_axis_angle, rigid_transform

numbers = st.floats(-2, 2, allow_nan=False, width=32)
vectors = st.lists(numbers, min_size=3, max_size=3).map(lambda v: torch.tensor(v, dtype=torch.float64))
sizes = st.integers(1, 2000)
poses = st.tuples(vectors, vectors).map(lambda v: rigid_transform(matrix_from_axis_angle(v[0]), v[1]))

FEW = settings(max_examples=30)


def close(value: Tensor, truth: Tensor, tolerance: float = 1e-6) -> None:
    torch.testing.assert_close(value, truth, rtol=tolerance, atol=tolerance)


def camera_of(viewmat: Tensor, width: int = 640, height: int = 480) -> Camera:
    K = torch.tensor([[500.0, 0, 0.4 * width], [0, 520, 0.6 * height], [0, 0, 1]], dtype=torch.float64)
    return Camera(K, viewmat, width, height)


def apply(transform: Tensor, point: Tensor) -> Tensor:
    return transform[:3, :3] @ point + transform[:3, 3]


@FEW
@given(st.floats(0.2, 2.5), sizes, sizes)
def test_the_field_of_view_reaches_from_edge_to_edge_about_the_center(fov_x: float, width: int, height: int) -> None:
    half = math.tan(fov_x / 2)
    points = torch.tensor([[-half, 0.0, 1.0], [half, 0.0, 1.0], [0.0, 0.0, 2.0]])
    pixels, depths = camera_from_fov(fov_x, width, height).project(points)
    torch.testing.assert_close(pixels[:, 0], torch.tensor([0.0, width, width / 2]), rtol=1e-4, atol=1e-3)
    close(pixels[2], torch.tensor([width / 2, height / 2]))
    assert depths[2] == 2


def test_x_goes_right_and_y_goes_down() -> None:
    pixels, depths = camera_from_fov(1.0, 100, 100).project(torch.tensor([[0.1, 0, 1], [0, 0.1, 1], [0, 0, -1.0]]))
    assert pixels[0, 0] > 50
    assert pixels[1, 1] > 50
    assert depths[2] < 0


@FEW
@given(poses, poses, vectors)
def test_in_frame_sees_local_points_as_world_points(viewmat: Tensor, T_world_local: Tensor, point: Tensor) -> None:
    camera = camera_of(viewmat)
    close(apply(viewmat, camera.position), torch.zeros(3, dtype=torch.float64))
    expected_pixel, expected_depth = camera.project(apply(T_world_local, point))
    pixel, depth = camera.in_frame(T_world_local).project(point)
    close(depth, expected_depth, 1e-9)
    if expected_depth.abs() > 1e-3:
        close(pixel, expected_pixel)


@FEW
@given(poses, vectors, sizes, sizes, numbers, numbers)
def test_resizing_scales_pixels_and_cropping_shifts_them(
    viewmat: Tensor, point: Tensor, width: int, height: int, left: float, top: float
) -> None:
    camera = camera_of(viewmat)
    pixel, depth = camera.project(point)
    resized = camera.resized(width, height)
    assert (resized.width, resized.height) == (width, height)
    if depth.abs() > 1e-3:
        close(resized.project(point)[0], pixel * torch.tensor([width / 640, height / 480], dtype=torch.float64))
        close(camera.cropped(left, top, 10, 20).project(point)[0], pixel - torch.tensor([left, top]))


@FEW
@given(poses, vectors)
def test_opengl_cameras_look_along_minus_z_with_y_up(T_world_camera: Tensor, point: Tensor) -> None:
    camera = camera_from_opengl(T_world_camera, camera_of(T_world_camera).K, 640, 480)
    close(camera.position, T_world_camera[:3, 3])
    in_opengl = apply(invert_rigid(T_world_camera), point)
    in_opencv = apply(camera.viewmat, point)
    close(in_opencv, in_opengl * torch.tensor([1, -1, -1], dtype=torch.float64), 1e-9)


@FEW
@given(vectors, vectors)
def test_look_at_puts_its_target_at_the_center_with_up_upwards(position: Tensor, target: Tensor) -> None:
    up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    forward = target - position
    if torch.linalg.cross(forward, up).norm() < 1e-2:
        return
    viewmat = look_at(position, target, up)
    in_camera = apply(viewmat, target)
    close(in_camera, torch.stack([forward.new_zeros(()), forward.new_zeros(()), forward.norm()]))
    close(apply(viewmat, position), torch.zeros(3, dtype=torch.float64))
    assert apply(viewmat, target + up)[1] < 0
    close(torch.linalg.det(viewmat[:3, :3]), torch.ones((), dtype=torch.float64))


def test_projection_is_differentiable() -> None:
    viewmat = rigid_transform(matrix_from_axis_angle(torch.tensor([0.1, 0.2, 0.3])), torch.tensor([0.1, 0.2, 2.0]))
    inputs = (torch.randn(5, 3).double(), camera_of(viewmat.double()).K, viewmat.double())

    def project(points: Tensor, K: Tensor, viewmat: Tensor) -> tuple[Tensor, Tensor]:
        return Camera(K, viewmat, 640, 480).project(points)

    assert torch.autograd.gradcheck(project, tuple(t.requires_grad_() for t in inputs), atol=1e-4)


@pytest.mark.parametrize("backend", ["native", "reference"])
@pytest.mark.parametrize(("column", "row"), [(0, 0), (3, 2), (10, 7)])
def test_renderers_put_points_where_cameras_project_them(backend: str, column: int, row: int) -> None:
    """A tiny Gaussian at the centre of pixel (column, row) lights up that pixel, symmetrically."""
    camera = camera_from_fov(0.8, 11, 8)
    direction = torch.linalg.inv(camera.K) @ torch.tensor([column + 0.5, row + 0.5, 1.0])
    gaussians = Gaussians(
        direction[None], torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 1e-4), torch.tensor([0.9]),
        torch.zeros(1, 1, 3),
    )  # fmt: skip
    alpha = rasterize(gaussians, camera, backend=backend).alpha  # pyright: ignore[reportArgumentType]
    assert divmod(int(alpha.argmax()), 11) == (row, column)
    assert alpha.max().item() == pytest.approx(0.9, abs=1e-4)
    if 0 < column < 10 and 0 < row < 7:
        close(alpha[row, column - 1], alpha[row, column + 1], 1e-4)
        close(alpha[row - 1, column], alpha[row + 1, column], 1e-4)
