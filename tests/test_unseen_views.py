"""`unseen_view`: true cameras are placed beside the tracked face, and rows count by angle."""

from dataclasses import replace

import numpy as np
import torch

from mien.benchmarking.quality import unseen_lines
from mien.camera import camera_from_fov, look_at
from mien.evaluation.unseen_views import angle_names, camera_beside, write_unseen_chart
from mien.rotation import matrix_from_axis_angle
from mien.synthetic import REFERENCES
from mien.synthetic.recipe import SIDES


def test_a_camera_sees_the_tracked_face_where_it_sees_the_true_one() -> None:
    """The tracked face is turned, moved and a tenth larger; through the placed camera every point is at its pixel."""
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (20, 3))
    turn = matrix_from_axis_angle(torch.tensor([0.3, -0.2, 0.1])).numpy()
    tracked = 1.1 * points @ turn.T + np.array([0.05, -0.02, 0.3])
    viewmat = look_at(torch.tensor([0.5, 0.1, 0.9]), torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]))
    camera = camera_from_fov(0.5, 320, 320, viewmat)
    placed = camera_beside(camera, tracked, points)
    seen, _ = placed.project(torch.from_numpy(tracked).float())
    expected, _ = camera.project(torch.from_numpy(points).float())
    torch.testing.assert_close(seen, expected, atol=1e-2, rtol=0)
    rotation = placed.viewmat[:3, :3]
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3), atol=1e-5, rtol=0)
    elsewhere = camera_beside(camera, tracked + 0.05, points)
    assert not torch.allclose(elsewhere.viewmat, placed.viewmat, atol=1e-3)


def test_rows_are_angles() -> None:
    names = angle_names()
    assert len(names) == len(SIDES) + 1
    assert list(dict.fromkeys(names)) == ["front", "15", "30", "45", "60", "90", "180", "above 25", "below 25"]
    assert names.count("30") == 2


def test_views_show_moments_of_the_held_out_sequence() -> None:
    """The side views are those timesteps of the sequence, in the front camera as well, and no one else's."""
    reference = REFERENCES["mono-sides"]
    assert reference.views is not None
    assert reference.views.sequence in reference.held_out_sequences
    front, aside, views = reference.tiny().scenes()
    assert views.moments is not None
    for index, timestep in enumerate(views.moments):
        torch.testing.assert_close(views.vertices(index), aside.vertices(timestep))
    assert not torch.equal(front.vertices(0), aside.vertices(0))
    assert len(views.cameras) == len(SIDES) + 1
    torch.testing.assert_close(views.cameras[0].viewmat, aside.camera.viewmat)


def test_table_and_chart(tmp_path) -> None:  # noqa: ANN001
    figures = {"psnr": 20.0, "ssim": 0.5, "l1": 0.1, "perceptual": 0.25}
    entry = {**figures, "head": figures}
    unknown = {**entry, "head": {**figures, "perceptual": None}}
    rows = {name: {"avatar": entry, "mesh": unknown} for name in dict.fromkeys(angle_names())}
    lines = unseen_lines("mono-sides", rows)
    assert lines[3] == "| 15 | 20.00 / 0.500 / 0.250 | 20.00 / 0.500 / - |"
    write_unseen_chart(tmp_path / "chart.png", rows)
    assert (tmp_path / "chart.png").stat().st_size > 1000
    assert replace(REFERENCES["ring-16"]).views is None
