"""`unseen_view`: true cameras are placed beside the tracked face, and rows count by angle."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from known import known
from mien.camera import Camera, camera_from_fov, look_at
from mien.lab.benchmarking.quality import unseen_lines
from mien.lab.benchmarking.unseen_views import Front, angle_names, camera_beside, write_unseen_chart
from mien.lab.synthetic import REFERENCES
from mien.lab.synthetic.recipe import SIDES
from mien.rotation import matrix_from_axis_angle


def test_views_begin_at_the_tracked_camera_and_show_moments_of_the_held_out_sequence() -> None:
    """Whatever the tracked face, focal length and distance are, the avatar is seen as it was trained."""
    own = _camera(0.48, (0.02, 0.1, 0.8))
    front = Front(_camera(0.5, (0.0, 0.1, 0.9)), own, np.array([0.01, 0.0, 0.02]), np.array([0.03, -0.01, 0.05]))
    placed = camera_beside(front.true, front)
    torch.testing.assert_close(placed.viewmat, own.viewmat)
    torch.testing.assert_close(placed.K, own.K)
    # The side views are those timesteps of the sequence, in the front camera as well, and no one else's.
    reference = REFERENCES["mono-sides"]
    assert known(reference.views).sequence in reference.held_out_sequences
    front, aside, views = reference.tiny().scenes()
    for index, timestep in enumerate(known(views.moments)):
        torch.testing.assert_close(views.vertices(index), aside.vertices(timestep))
    assert not torch.equal(front.vertices(0), aside.vertices(0))
    assert len(views.cameras) == len(SIDES) + 1
    torch.testing.assert_close(views.cameras[0].viewmat, aside.camera.viewmat)


def test_a_camera_aside_sees_a_true_tracking_where_it_sees_the_person() -> None:
    """The tracked world is turned, moved and a tenth larger; through the placed camera every point is at its pixel."""
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (20, 3))
    turn = matrix_from_axis_angle(torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)).numpy()
    shift = np.array([0.05, -0.02, 0.3])
    tracked = 1.1 * points @ turn.T + shift
    true = _camera(0.5, (0.0, 0.1, 0.9))
    view = true.viewmat.double().numpy()
    moved = np.eye(4)
    moved[:3, :3] = view[:3, :3] @ turn.T
    moved[:3, 3] = 1.1 * view[:3, 3] - moved[:3, :3] @ shift
    own = replace(true, viewmat=torch.from_numpy(moved).float())
    front = Front(true, own, points.mean(0), tracked.mean(0))
    assert front.scale == pytest.approx(1 / 1.1)
    behind = front.behind(np.array([0.0, 0.6, 0.8]))
    expected = 1.1 * (points.mean(0) - 0.08 * np.array([0.0, 0.6, 0.8])) @ turn.T + shift
    np.testing.assert_allclose(behind.tracked_middle, expected, atol=1e-6)
    aside = _camera(0.5, (0.5, 0.1, 0.7))
    placed = camera_beside(aside, behind)
    seen, _ = placed.project(torch.from_numpy(tracked).float())
    expected, _ = aside.project(torch.from_numpy(points).float())
    torch.testing.assert_close(seen, expected, atol=1e-2, rtol=0)
    torch.testing.assert_close(placed.viewmat[:3, :3] @ placed.viewmat[:3, :3].T, torch.eye(3), atol=1e-5, rtol=0)


def _camera(field_of_view: float, place: tuple[float, float, float]) -> Camera:
    viewmat = look_at(torch.tensor(place), torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]))
    return camera_from_fov(field_of_view, 320, 320, viewmat)


def test_table_and_chart(tmp_path) -> None:  # noqa: ANN001
    names = list(dict.fromkeys(angle_names()))
    assert names == ["front", "15", "30", "45", "60", "90", "180", "above 25", "below 25"]
    figures = {"psnr": 20.0, "ssim": 0.5, "l1": 0.1, "perceptual": 0.25}
    unknown = {**figures, "head": {**figures, "perceptual": None}}
    rows = {name: {"avatar": {**figures, "head": figures}, "mesh": unknown} for name in names}
    assert unseen_lines("mono-sides", rows)[3] == "| 15 | 20.00 / 0.500 / 0.250 | 20.00 / 0.500 / - |"
    write_unseen_chart(tmp_path / "chart.png", rows)
    assert (tmp_path / "chart.png").stat().st_size > 1000
    assert REFERENCES["ring-16"].views is None
