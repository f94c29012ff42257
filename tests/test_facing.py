"""Pictures that see a face from the side count little beside those from the front."""

import torch

from mien.camera import look_at
from mien.tracking.fitting import CameraBatch, Views
from mien.tracking.landmarks.term import trust_of
from tracking_case import still_camera

HEAD = torch.tensor([0.0, 0.0, -0.9], dtype=torch.float64)


def cameras_at(*angles: float) -> CameraBatch:
    """Return cameras around the head, at angles in radians to the subject's left of straight ahead."""
    turned = torch.tensor(angles, dtype=torch.float64)
    places = HEAD + 0.9 * torch.stack([turned.sin(), 0 * turned, turned.cos()], dim=1)
    looks = torch.stack([look_at(place, HEAD, HEAD.new_tensor([0.0, 1.0, 0.0])) for place in places])
    return CameraBatch(still_camera().K.expand(len(angles), 3, 3), looks)


def views_of(*pictures: tuple[int, int]) -> Views:
    """Return views of these pairs of a timestep and a camera."""
    row, camera = torch.tensor(pictures).unbind(1)
    nothing = torch.zeros(len(row), 1, 2, dtype=torch.float64)
    return Views(nothing, row, camera, torch.ones(len(row), dtype=torch.float64))


def heads_turned(*angles: float) -> torch.Tensor:
    state = torch.zeros(len(angles), 6, dtype=torch.float64)
    state[:, 1] = torch.tensor(angles, dtype=torch.float64)
    state[:, 3:6] = HEAD
    return state


def test_side_views_count_little_and_trust_goes_with_the_head():
    trust = trust_of(views_of((0, 0), (0, 1), (0, 2)), heads_turned(0.0), cameras_at(0.0, 0.3, -1.2))
    torch.testing.assert_close(trust[:2], torch.tensor([1.0, 0.5]).double(), atol=1e-6, rtol=0)
    assert trust[2] < 0.02
    trust = trust_of(views_of((0, 0), (0, 1), (1, 0), (1, 1)), heads_turned(0.0, 1.0), cameras_at(0.0, 1.0))
    assert trust[0] == trust[3] == 1
    assert trust[1:3].max() < 0.05
    # The best picture of a timestep counts whole, even from the side; otherwise priors would decide.
    trust = trust_of(views_of((0, 0), (1, 1), (2, 0), (2, 1)), heads_turned(0.0, 0.0, 0.0), cameras_at(1.2, -1.5))
    assert trust[:3].eq(1).all()
    assert 0.2 < trust[3] < 0.6
