"""Measure whether a tracking keeps up: lag and lost amplitude of blinks and fast turns, and jitter at rest."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float

from mien.lab.synthetic.truth import Truth
from mien.rotation import align_centered, axis_angle_from_matrix, matrix_from_axis_angle
from mien.tracking.landmarks.groups import LEFT_LID_PAIRS, RIGHT_LID_PAIRS
from mien.tracking.report.overlay import frontal_camera
from mien.tracking.tracking import Tracking

LIDS = (*RIGHT_LID_PAIRS, *LEFT_LID_PAIRS)
"""MediaPipe's pairs of landmarks across the eyes' openings."""
_MIN_BLINK = 0.25
"""Smallest decrease of an eye's opening in a blink, as a part of the median. A blink begins at half of it."""


@dataclass(frozen=True)
class Following:
    """How a tracked signal follows the true one, over all events of one kind."""

    lag_frames: float
    """Delay of the true signal at which it correlates most with the tracked one."""
    loss_percent: float
    """Lost amplitude: 100 (1 - g), where the tracked signal is about g times the delayed true one."""
    events: int


def following(
    tracked: Float[np.ndarray, "t k"], true: Float[np.ndarray, "t k"], busy: Bool[np.ndarray, " t"], around: int
) -> Following | None:
    """Return lag and lost amplitude of k signals around events; None if there is no event.

    Each run of `busy` timesteps is an event, to which `around` timesteps before and after belong. Events with tracked
    values that are not finite are skipped.
    """
    wide = np.convolve(busy, np.ones(2 * around + 1), mode="same") > 0  # windows that overlap are one
    edges = np.flatnonzero(np.diff(np.concatenate([[0], wide.astype(int), [0]])))
    windows = [slice(int(first), int(last)) for first, last in edges.reshape(-1, 2)]
    parts = [part for part in windows if np.isfinite(tracked[part]).all() and part.stop - part.start > 2]
    if not parts:
        return None
    lags = np.arange(-4.0, 4.0 + 0.05 / 2, 0.05)
    sums = np.array([_products(tracked, true, parts, lag) for lag in lags])
    best = int((sums[:, 0] / np.sqrt(sums[:, 1] * sums[:, 2] + 1e-30)).argmax())
    return Following(float(lags[best]), float(100 * (1 - sums[best, 0] / max(sums[best, 2], 1e-30))), len(parts))


def _around(fps: float) -> int:
    """Timesteps before and after an event that belong to it: 0.3 s."""
    return max(round(0.3 * fps), 2)


def _products(
    tracked: Float[np.ndarray, "t k"], true: Float[np.ndarray, "t k"], parts: list[slice], lag: float
) -> tuple[float, float, float]:
    """Sums of tracked x true, tracked squared and true squared, of the delayed true signal, less each part's means."""
    time, sums = np.arange(len(true)), np.zeros(3)
    for part in parts:
        for x, y in zip(tracked.T, true.T, strict=True):
            delayed = _between(y, time[part] - lag)
            a, b = x[part] - x[part].mean(), delayed - delayed.mean()
            sums += np.array([a @ b, a @ a, b @ b])
    return float(sums[0]), float(sums[1]), float(sums[2])


def _between(values: Float[np.ndarray, " t"], at: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Interpolate values by cubic convolution (Keys 1981), since linear interpolation would flatten a blink."""
    at = np.clip(at, 0, len(values) - 1)
    first = np.floor(at).astype(int)
    x = at - first
    taps = [values[np.clip(first + step, 0, len(values) - 1)] for step in (-1, 0, 1, 2)]
    shares = (
        (-(x**3) + 2 * x**2 - x) / 2,
        (3 * x**3 - 5 * x**2 + 2) / 2,
        (-3 * x**3 + 4 * x**2 + x) / 2,
        (x**3 - x**2) / 2,
    )
    return sum((tap * share for tap, share in zip(taps, shares, strict=True)), np.zeros_like(at))


def eye_opening(landmarks: Float[np.ndarray, "t l 2"]) -> Float[np.ndarray, " t"]:
    """Return the mean distance of the lids over the mean width of the eyes; about 0 when closed."""
    gaps = [np.linalg.norm(landmarks[:, upper] - landmarks[:, lower], axis=-1) for upper, lower in LIDS]
    widths = [
        np.linalg.norm(landmarks[:, one] - landmarks[:, other], axis=-1) for one, other in ((33, 133), (362, 263))
    ]
    return np.mean(gaps, axis=0) / np.mean(widths, axis=0)


def blink_following(
    projected: Float[np.ndarray, "t c l 2"], true: Float[np.ndarray, "t c l 2"], truth: Truth, fps: float
) -> Following | None:
    """Measure how blinks are followed, in the frontal camera's pictures."""
    camera = frontal_camera(truth.tracking)
    tracked, opening = (eye_opening(points[:, camera].astype(np.float64)) for points in (projected, true))
    middle = float(np.median(opening))
    depth = middle - opening.min()
    if depth < _MIN_BLINK * middle:
        return None
    closing = opening < middle - max(0.5 * depth, 0.5 * _MIN_BLINK * middle)
    return following(tracked[:, None], opening[:, None], closing, _around(fps))


def turn_following(tracking: Tracking, truth: Truth, fps: float) -> Following | None:
    """Measure how fast head turns are followed. A constant difference of pose does not count."""
    tracked, true = (
        matrix_from_axis_angle(one.face.head_rotation.double()) for one in (tracking, truth.tracking)
    )  # fmt: skip
    steady = mean_rotation(tracked[tracking.valid].mT @ true[tracking.valid])
    middle = mean_rotation(true)
    signals = [axis_angle_from_matrix(middle.T @ turns).numpy() for turns in (tracked @ steady, true)]
    speed = axis_angle_from_matrix(true[:-1].mT @ true[1:]).norm(dim=-1).numpy() * fps
    fast = np.concatenate([speed > np.radians(15.0), [False]])
    return following(signals[0], signals[1], fast, _around(fps))


def mean_rotation(rotations: Float[torch.Tensor, "n 3 3"]) -> Float[torch.Tensor, "3 3"]:
    """Return the rotation nearest to the mean of the matrices."""
    nearest, _ = align_centered(np.eye(3), rotations.double().mean(0).T.numpy())
    return torch.from_numpy(nearest)


def still_timesteps(true: Float[np.ndarray, "t c l 2"]) -> Bool[np.ndarray, " t2"]:
    """Return, for all timesteps but the first and the last, whether true landmarks stand still around them."""
    moving = np.linalg.norm(np.diff(true[:, 0], axis=0), axis=-1).max(-1)
    still = moving < 0.02  # pixels a frame
    return still[1:] & still[:-1]


def jitter(points: Float[np.ndarray, "t *l d"], still: Bool[np.ndarray, " t2"]) -> float | None:
    """Return the median length of second differences over time where nothing moves, in the points' unit."""
    second = np.linalg.norm(points[2:] - 2 * points[1:-1] + points[:-2], axis=-1)[still]
    second = second[np.isfinite(second)]
    return float(np.median(second)) if len(second) else None
