"""Known lags, losses of amplitude and jitter are found."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from mien.lab.benchmarking.following import (
    LIDS,
    Following,
    blink_following,
    eye_opening,
    following,
    jitter,
    mean_rotation,
    still_timesteps,
    turn_following,
)
from mien.lab.synthetic import Truth
from mien.rotation import axis_angle_from_matrix, matrix_from_axis_angle
from mien.tracking import Tracking
from small_face_model import make_small_face_model
from tracking_case import still_camera

FPS = 25.0
TIME = np.arange(100.0)


def bumps(delay: float = 0.0, height: float = 1.0, width: float = 2.0) -> np.ndarray:
    """Return the coefficient of two blinks over time."""
    return height * np.stack([np.exp(-(((TIME - at - delay) / width) ** 2)) for at in (30.0, 62.0)]).sum(0)


def found_in(values: np.ndarray) -> Following:
    found = following(values[:, None], bumps()[:, None], bumps() > 0.3, 6)
    assert found is not None
    return found


def test_delay_and_height_are_found():
    for delay, height in [(-1.3, 0.8), (0.0, 1.0), (0.6, 1.1), (2.0, 0.8)]:
        found = found_in(5 + bumps(delay, height))
        assert found.lag_frames == pytest.approx(delay, abs=0.1)
        assert found.loss_percent == pytest.approx(100 * (1 - height), abs=2)
        assert found.events == 2
    # Smoothing loses amplitude, and noise does not.
    smooth = found_in(np.convolve(bumps(), np.ones(5) / 5, mode="same"))
    assert smooth.loss_percent > 10
    assert abs(smooth.lag_frames) < 0.1
    noisy = found_in(bumps() + 0.03 * np.random.default_rng(0).standard_normal(len(TIME)))
    assert abs(noisy.loss_percent) < 4
    assert abs(noisy.lag_frames) < 0.15
    # Where nothing happens there is nothing to measure, and an event that was not tracked is left out.
    assert following(bumps()[:, None], bumps()[:, None], np.zeros(len(TIME), bool), 6) is None
    gap = bumps()
    gap[28:33] = np.nan
    assert found_in(gap).events == 1


def truth_of(rotations: torch.Tensor) -> tuple[Tracking, Truth]:
    face = replace(make_small_face_model().neutral(len(rotations)), head_rotation=rotations)
    tracking = Tracking(
        face_model="small", face_model_hash="", face=face, valid=torch.ones(len(rotations)).bool(),
        cameras=(still_camera().to(torch.zeros(())),), neck_lines=torch.zeros(len(rotations), 1, 3),
        residuals=torch.zeros(len(rotations), 1),
    )  # fmt: skip
    nothing = np.zeros((len(rotations), 1, 478, 2), np.float32)
    return tracking, Truth(tracking, np.zeros(1, np.int64), np.zeros((len(rotations), 1, 3), np.float32), nothing)


def turns(delay: float = 0.0, share: float = 1.0) -> torch.Tensor:
    """Return pitch and yaw that turn and come back, at 60 degrees a second at most."""
    angle = share * np.stack([0.1 * bumps(delay, width=5.0), 0.4 * bumps(delay, width=5.0), 0 * TIME], axis=1)
    return torch.from_numpy(angle).float()


def test_turns_that_come_late_are_found_beside_a_constant_error():
    _, truth = truth_of(turns())
    off = matrix_from_axis_angle(torch.tensor([0.05, 0.1, -0.08]))
    late = axis_angle_from_matrix(matrix_from_axis_angle(turns(1.5, 0.9)) @ off.T)
    found = turn_following(truth_of(late)[0], truth, FPS)
    assert found is not None
    assert found.lag_frames == pytest.approx(1.5, abs=0.1)
    assert found.loss_percent == pytest.approx(10, abs=2)
    assert turn_following(truth_of(turns())[0], truth_of(0 * turns())[1], FPS) is None


def test_blinks_are_seen_in_the_lids():
    open_eyes = np.random.default_rng(0).uniform(100, 200, (1, 1, 478, 2)).repeat(len(TIME), 0)
    _, truth = truth_of(0 * turns())

    def blinking(delay: float, depth: float) -> np.ndarray:
        points = open_eyes.copy()
        for upper, lower in LIDS:
            share = depth * bumps(delay)[:, None, None]
            points[:, :, upper] += share * (points[:, :, lower] - points[:, :, upper])
        return points

    true, tracked = blinking(0.0, 0.9), blinking(1.0, 0.6)
    assert eye_opening(true[:, 0]).min() < 0.2 * eye_opening(true[:, 0]).max()
    found = blink_following(tracked, true, truth, FPS)
    assert found is not None
    assert found.events == 2
    assert found.lag_frames == pytest.approx(1.0, abs=0.1)
    assert found.loss_percent == pytest.approx(100 * (1 - 0.6 / 0.9), abs=3)
    assert blink_following(tracked, open_eyes, truth, FPS) is None


def test_jitter_counts_where_the_truth_stands_still():
    true = np.zeros((20, 1, 478, 2), np.float32)
    true[10:] += np.arange(10)[:, None, None, None]
    still = still_timesteps(true)
    assert (still[:8].all(), still[9:].any()) == (True, False)
    points = np.zeros((20, 478, 3))
    points[1::2, :, 0] = 0.001
    points[12:] = 50 * np.random.default_rng(0).standard_normal((8, 478, 3))
    assert jitter(points, still) == pytest.approx(0.002)
    assert jitter(points, np.zeros(18, bool)) is None


def test_a_mean_rotation_is_in_the_middle():
    vectors = torch.tensor([[0.0, 0.3, 0.0], [0.0, -0.1, 0.0]])
    middle = axis_angle_from_matrix(mean_rotation(matrix_from_axis_angle(vectors)))
    torch.testing.assert_close(middle, torch.tensor([0.0, 0.1, 0.0]).double(), atol=1e-6, rtol=0)
