"""Cameras keep the conventions, and calibrations that are written in another way are read or named."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from torch import Tensor

from mien import rotation
from mien.camera import Camera, camera_from_fov, look_at
from mien.capture.cameras import readings as ranking
from mien.capture.cameras.head_path import consensus, find_head_path
from mien.errors import UserError
from mien.face import load_face_model
from mien.runtime import rotation as runtime_rotation


def vectors_of(size: int, most: float) -> st.SearchStrategy[Tensor]:
    numbers = st.floats(-most, most, allow_nan=False, width=32)
    return st.lists(numbers, min_size=size, max_size=size).map(lambda v: torch.tensor(v, dtype=torch.float64))


numbers = st.floats(-2, 2, allow_nan=False, width=32)
vectors = vectors_of(3, 2)
sizes = st.integers(1, 2000)
poses = st.tuples(vectors, vectors).map(lambda v: rotation.rigid_transform(rotation.matrix_from_axis_angle(v[0]), v[1]))

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
    points = torch.tensor([[-half, 0.0, 1.0], [half, 0.0, 1.0], [0.0, 0.0, 2.0], [0.0, 0.1, 1.0], [0.0, 0.0, -1.0]])
    pixels, depths = camera_from_fov(fov_x, width, height).project(points)
    torch.testing.assert_close(pixels[:3, 0], torch.tensor([0.0, width, width / 2]), rtol=1e-4, atol=1e-3)
    close(pixels[2], torch.tensor([width / 2, height / 2]))
    assert pixels[3, 1] > height / 2, "y goes down"
    assert depths.tolist() == [1, 1, 2, 1, -1]


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
def test_resizing_scales_pixels_and_cropping_shifts_them(viewmat, point, width, height, left, top) -> None:
    camera = camera_of(viewmat)
    pixel, depth = camera.project(point)
    resized = camera.resized(width, height)
    assert (resized.width, resized.height) == (width, height)
    if depth.abs() > 1e-3:
        close(resized.project(point)[0], pixel * torch.tensor([width / 640, height / 480], dtype=torch.float64))
        close(camera.cropped(left, top, 10, 20).project(point)[0], pixel - torch.tensor([left, top]))


@FEW
@given(vectors, vectors)
def test_look_at_puts_its_target_at_the_center_with_up_upwards(position: Tensor, target: Tensor) -> None:
    up, forward = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64), target - position
    assume(torch.linalg.cross(forward, up).norm() >= 1e-2)
    viewmat = look_at(position, target, up)
    close(apply(viewmat, target), forward.norm() * torch.tensor([0.0, 0, 1], dtype=torch.float64))
    close(apply(viewmat, position), torch.zeros(3, dtype=torch.float64))
    assert apply(viewmat, target + up)[1] < 0
    close(torch.linalg.det(viewmat[:3, :3]), torch.ones((), dtype=torch.float64))


turns = vectors_of(3, 3)
quaternions = vectors_of(4, 3).filter(lambda q: float(q.norm()) > 1e-3)


def agree(value: Tensor, truth: Tensor, tolerance: float = 1e-9) -> None:
    torch.testing.assert_close(value, truth, rtol=0, atol=tolerance)


def assert_rotation(matrix: Tensor) -> None:
    agree(matrix @ matrix.transpose(-1, -2), torch.eye(3, dtype=matrix.dtype).expand_as(matrix))
    agree(torch.linalg.det(matrix), torch.ones(matrix.shape[:-2], dtype=matrix.dtype))


@given(turns, turns)
def test_axis_angle_gives_rotations_that_keep_their_axis_and_comes_back(axis_angle: Tensor, other: Tensor) -> None:
    agree(rotation.skew(axis_angle) @ other, torch.linalg.cross(axis_angle, other))
    matrix = rotation.matrix_from_axis_angle(axis_angle)
    assert_rotation(matrix)
    agree(matrix @ axis_angle, axis_angle)
    agree(torch.trace(matrix), 1 + 2 * torch.cos(axis_angle.norm()))
    agree(rotation.matrix_from_axis_angle(-axis_angle), matrix.T)
    recovered = rotation.axis_angle_from_matrix(matrix)
    assert recovered.norm() <= math.pi + 1e-6
    agree(rotation.matrix_from_axis_angle(recovered), matrix, 1e-7)
    if axis_angle.norm() < math.pi - 1e-3:
        agree(recovered, axis_angle, 1e-6)


@given(quaternions, quaternions)
def test_quaternions_and_matrices_agree(quat: Tensor, other: Tensor) -> None:
    matrix, unit = rotation.matrix_from_quaternion(quat), quat / quat.norm()
    assert_rotation(matrix)
    agree((rotation.quaternion_from_matrix(matrix) * unit).sum().abs(), torch.ones((), dtype=torch.float64))
    agree(rotation.matrix_from_axis_angle(rotation.axis_angle_from_quaternion(unit)), matrix, 1e-7)
    product = rotation.multiply_quaternions(quat, other)
    agree(rotation.matrix_from_quaternion(product), matrix @ rotation.matrix_from_quaternion(other))
    agree(product.norm(), quat.norm() * other.norm())


@given(st.lists(turns, min_size=1, max_size=4).map(torch.stack))
def test_leading_axes_are_batches_and_rotations_without_torch_are_the_same(axis_angles: Tensor) -> None:
    matrices = rotation.matrix_from_axis_angle(axis_angles[:, None])
    quats = rotation.quaternion_from_matrix(matrices)
    for index, axis_angle in enumerate(axis_angles):
        matrix = rotation.matrix_from_axis_angle(axis_angle)
        agree(matrices[index, 0], matrix)
        agree(quats[index, 0], rotation.quaternion_from_matrix(matrix))
    found = runtime_rotation.matrix_from_axis_angle(axis_angles.numpy())
    agree(torch.from_numpy(found), matrices[:, 0])
    recovered = torch.from_numpy(runtime_rotation.axis_angle_from_matrix(found))
    agree(rotation.matrix_from_axis_angle(recovered), matrices[:, 0], 1e-7)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_are_finite_at_every_angle_and_those_of_differences_around_zero(dtype: torch.dtype) -> None:
    for angle in (0.0, 1e-9, 1e-4, 1.0, math.pi - 1e-4, math.pi):
        axis_angle = torch.tensor([0.6 * angle, -0.8 * angle, 0.0], dtype=dtype, requires_grad=True)
        matrix = rotation.matrix_from_axis_angle(axis_angle)
        (gradient,) = torch.autograd.grad(matrix.sum() + rotation.axis_angle_from_matrix(matrix).sum(), axis_angle)
        assert gradient.isfinite().all(), angle
    for axis_angle in (torch.zeros(3), torch.tensor([5e-5, 0, 5e-5]), torch.tensor([2e-4, -3e-4, 0])):
        assert torch.autograd.gradcheck(rotation.matrix_from_axis_angle, axis_angle.double().requires_grad_(), eps=1e-7)


def test_known_turns_also_without_torch() -> None:
    x, y = torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 1, 0])
    agree(rotation.matrix_from_axis_angle(torch.tensor([0, 0, math.pi / 2])) @ x, y, 1e-6)
    agree(rotation.matrix_from_quaternion(torch.tensor([1.0, 0, 0, 1])) @ x, y, 1e-6)
    agree(rotation.matrix_from_quaternion(torch.zeros(4)), torch.eye(3))
    first, second = (torch.randn(4, 4, generator=torch.Generator().manual_seed(seed)) for seed in (1, 2))
    composed = rotation.compose_rigid(first, second)
    torch.testing.assert_close(composed, first @ second)
    np.testing.assert_array_equal(composed.numpy(), runtime_rotation.compose_rigid(first.numpy(), second.numpy()))


FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
WIDTH, HEIGHT, FRAMES = 640, 512, 5
HEAD = torch.tensor([0.0, 0.0, -0.9])


def camera_at(yaw: float, pitch: float = 0.0) -> Camera:
    a, b = math.radians(yaw), math.radians(pitch)
    place = HEAD + 0.9 * torch.tensor([math.sin(a) * math.cos(b), math.sin(b), math.cos(a) * math.cos(b)])
    K = torch.tensor([[768.0, 0, WIDTH / 2 + 8], [0, 768.0, HEIGHT / 2 - 60], [0, 0, 1]])
    return Camera(K, look_at(place, HEAD, torch.tensor([0.0, 1.0, 0.0])), WIDTH, HEIGHT)


RIGS = {
    "ring": [camera_at(yaw) for yaw in (-80, -30, 0, 30, 80)],
    "pair": [camera_at(-15), camera_at(15)],
    "line": [camera_at(-20), camera_at(0), camera_at(20)],
    "mixed": [camera_at(-30, 5), camera_at(0, -10), camera_at(25, 15), camera_at(50)],
}
WORLDS = {"room": None, "one camera": torch.eye(4), "one camera, OpenGL": FLIP}
POSES: dict[str, tuple[Callable[[Tensor], Tensor], str]] = {
    "world to camera": (lambda viewmat: viewmat, ""),
    "camera to world": (
        rotation.invert_rigid, "the matrices go from camera to world, so write the inverse of each viewmat"),
    "OpenGL": (lambda viewmat: FLIP @ viewmat, "the axes are OpenGL's, so change the signs of rows 2 and 3"),
    "camera to world, OpenGL": (lambda viewmat: rotation.invert_rigid(FLIP @ viewmat),
        "go from camera to world with OpenGL's axes, so change the signs of columns 2 and 3 of each, and write"),
}  # fmt: skip
INTRINSICS: dict[str, tuple[Callable[[Tensor], Tensor], str]] = {
    "pixels": (lambda K: K, ""),
    "parts": (lambda K: K * torch.tensor([[1 / WIDTH], [1 / HEIGHT], [1.0]]),
        "K is in parts of the picture, so multiply its row 1 by the width and row 2 by"),
    "half size": (lambda K: K * torch.tensor([[0.5], [0.5], [1.0]]),
        "K is for pictures of another size, so multiply its rows 1 and 2 by 2"),
    "from below": (lambda K: torch.stack([K[0], torch.stack([K[1, 0], K[1, 1], HEIGHT - K[1, 2]]), K[2]]),
        "y of K counts from below, so write K[1][2] as height - K[1][2]"),
}  # fmt: skip


@pytest.fixture(scope="module")
def marks() -> Tensor:
    """Landmarks of a head that turns, [t, 478, 3]."""
    model = load_face_model("anny")
    time = torch.arange(FRAMES) / 3
    turns = torch.stack([0.15 * (2 * time).sin(), 0.25 * (1.3 * time).sin(), 0 * time], dim=1)
    face = replace(model.neutral(FRAMES), head_rotation=turns, head_translation=HEAD.repeat(FRAMES, 1))
    return model.landmark_positions(model(face), "mediapipe")


def seen_by(cameras: list[Camera], marks: Tensor) -> np.ndarray:
    """Return landmarks as a detector finds them: noise in each picture, and slides that stay."""
    random = np.random.default_rng(0)
    shape = marks.shape[1], 2
    pixels = [
        camera.project(marks)[0].numpy() + random.normal(0, 0.5, (FRAMES, *shape)) + random.normal(0, 1.5, shape)
        for camera in cameras
    ]
    return np.stack(pixels, axis=1)


def written(cameras: list[Camera], world: str, pose: str = "world to camera", K: str = "pixels") -> list[Camera]:
    """Return cameras as a file has them: in a world of its own, with matrices and intrinsics in another form."""
    axes = WORLDS[world]
    T_world_new = torch.eye(4) if axes is None else rotation.invert_rigid(cameras[0].viewmat) @ axes
    return [
        replace(camera, viewmat=POSES[pose][0](camera.viewmat @ T_world_new), K=INTRINSICS[K][0](camera.K))
        for camera in cameras
    ]


PLACES = (("ring", "room"), ("pair", "one camera"), ("line", "one camera, OpenGL"), ("mixed", "one camera"))
READINGS = [
    *((*place, pose, "pixels") for place in PLACES for pose in POSES),
    *(("ring", "one camera, OpenGL", "camera to world, OpenGL", K) for K in list(INTRINSICS)[1:]),
    *(("ring", "one camera, OpenGL", pose, "half size") for pose in list(POSES)[:-1]),
]


@pytest.mark.parametrize(("rig", "world", "pose", "K"), READINGS)
def test_every_reading_is_named_in_any_world(marks: Tensor, rig: str, world: str, pose: str, K: str) -> None:
    found = ranking.rank_readings(seen_by(RIGS[rig], marks), ranking.readings_of(written(RIGS[rig], world, pose, K)))
    tied = ranking.ties_of(found)
    assert len(tied) == 1
    assert POSES[pose][1] in tied[0].reading.remedy
    assert INTRINSICS[K][1] in tied[0].reading.remedy
    assert tied[0].share < 0.02
    assert ranking.is_wrong(found) == bool(POSES[pose][1] + INTRINSICS[K][1])


def told_of(cameras: list[Camera], pixels: np.ndarray, capsys) -> str:
    ranking.warn_of_misfit(ranking.rank_readings(pixels, ranking.readings_of(cameras)))
    return capsys.readouterr().err


def boxes_of(pixels: np.ndarray) -> np.ndarray:
    return np.concatenate([pixels.min(axis=2), pixels.max(axis=2)], axis=-1)


def test_a_reading_that_agrees_on_a_face_inside_out_is_warned_of(marks: Tensor, capsys) -> None:
    """Two readings place faces alike in depth; what is left then is a nose that points away. What fits is no matter."""
    assert not any(told_of(cameras, seen_by(cameras, marks), capsys) for cameras in RIGS.values())
    given = written(RIGS["line"], "one camera, OpenGL", "camera to world, OpenGL")
    turned, pixels = [replace(camera, viewmat=FLIP @ camera.viewmat) for camera in given], seen_by(RIGS["line"], marks)
    assert consensus(boxes_of(pixels), turned).agrees.mean() > 0.5, "boxes do not tell them apart"
    told = told_of(turned, pixels, capsys)
    assert "warning: --calibration" in told
    assert "agree within" in told


def test_ties_are_said_and_advice_is_part_of_the_refusal(marks: Tensor) -> None:
    entries = [ranking.Ranked(ranking.Reading((text,) if text else (), ()), pixels, pixels / 100) for text, pixels in
               (("write A", 0.7), ("write B", 0.8), ("write C", 4.0), ("", float("inf")))]  # fmt: skip
    advice = ranking.advice_of(entries)
    assert "cannot tell 2 readings apart" in advice
    assert "(1) write A, which leaves 0.7 px; or (2) write B, which leaves 0.8 px" in advice
    assert "write C" not in advice
    assert ranking.advice_of(entries[1:]) == "write B (points of the face then agree within 0.8 px)"
    assert ranking.advice_of(entries[3:]) == ""
    given, pixels = written(RIGS["ring"], "room", "camera to world"), seen_by(RIGS["ring"], marks)
    refusal = "no two cameras ever .*; the matrices go from camera to world, .* agree within"
    with pytest.raises(UserError, match=refusal):
        find_head_path(
            boxes_of(pixels),
            given,
            lambda: ranking.advice_of(ranking.rank_readings(pixels, ranking.readings_of(given))),
        )
