"""Landmarks that swing between two answers are found, and pictures that see a face from the side count little."""

import torch

from mien.camera import look_at
from mien.tracking.fitting import CameraBatch, Views
from mien.tracking.fitting.shot import without_flicker
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


def _still(timesteps: int = 20, noise: float = 0.0) -> torch.Tensor:
    random = torch.Generator().manual_seed(5)
    face = 100 * torch.rand(1, 1, 478, 2, generator=random, dtype=torch.float64)
    return face + noise * torch.randn(timesteps, 1, 478, 2, generator=random, dtype=torch.float64)


def _all_seen(marks: torch.Tensor) -> torch.Tensor:
    return torch.ones(marks.shape[:2], dtype=torch.bool)


def _swinging(marks: torch.Tensor, frames: slice) -> torch.Tensor:
    sign = (-1.0) ** torch.arange(len(marks), dtype=torch.float64)
    found = marks.clone()
    found[frames] += sign[frames, None, None, None] * torch.tensor([0.3, 0.8], dtype=torch.float64)
    return found


def test_swings_go_and_noise_motion_blinks_and_short_runs_stay():
    marks = _still(noise=0.05)
    found = without_flicker(_swinging(marks, slice(6, 15)), _all_seen(marks))
    torch.testing.assert_close(found[6:15], marks[6:15], atol=0.35, rtol=0)
    assert (found[8:13] - marks[8:13]).abs().mean() < 0.06
    kept = [*range(5), *range(16, 20)]
    torch.testing.assert_close(found[kept], marks[kept], atol=0, rtol=0)
    marks = _still(8)
    found = without_flicker(_swinging(marks, slice(0, 8)), _all_seen(marks))
    torch.testing.assert_close(found, marks, atol=1e-9, rtol=0)
    marks = _still(40, noise=0.25)
    marks[10:14, :, :50] += 6.0
    marks[20, :, :50] -= 6.0  # of a single frame
    marks[25:] += torch.linspace(0, 40, 15, dtype=torch.float64)[:, None, None, None]
    torch.testing.assert_close(without_flicker(marks, _all_seen(marks)), marks, atol=0, rtol=0)
    marks, seen = _swinging(_still(12), slice(0, 12)), torch.ones(12, 1, dtype=torch.bool)
    marks[[2, 5, 8]], seen[[2, 5, 8]] = torch.nan, False  # frames without a face part runs
    torch.testing.assert_close(without_flicker(marks, seen), marks, atol=0, rtol=0, equal_nan=True)
    marks = _swinging(_still(4), slice(0, 4))
    assert without_flicker(marks, _all_seen(marks)) is marks
