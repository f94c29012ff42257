"""Principal components of people have unit variance, no rigid motion, and keep the scale."""

from dataclasses import replace

import numpy as np
import pytest

from mien.face import anny_identity
from mien.face.anny_identity import principal_components
from mien.face.constants import FACE

DIRECTIONS = 4


@pytest.fixture
def points(monkeypatch):
    """Return a symmetric cloud whose vertex i mirrors onto i ^ 1."""
    monkeypatch.setattr(anny_identity, "FACE", replace(FACE, anny_components=2 * DIRECTIONS))
    half = np.random.default_rng(0).normal(size=(20, 3)) * 0.05
    return np.stack([half, half * [-1, 1, 1]], axis=1).reshape(-1, 3)


def people_from(points: np.ndarray, move: bool) -> np.ndarray:
    random = np.random.default_rng(1)
    basis = random.normal(size=(DIRECTIONS, *points.shape)) * np.array([4e-3, 3e-3, 2e-3, 1e-3])[:, None, None]
    people = points * (1 + 0.04 * random.normal(size=(300, 1, 1))) + np.tensordot(
        random.normal(size=(300, DIRECTIONS)), basis, axes=1
    )
    if not move:
        return people
    angles = 0.05 * random.normal(size=300)
    turns = np.stack([[[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]] for a in angles])
    return people @ turns + 0.1 * random.normal(size=(300, 1, 3))


def fit(points, move):
    even = np.ones(len(points))
    return principal_components(people_from(points, move), np.arange(len(points)) ^ 1, even, even)


def test_coefficients_have_unit_variance(points):
    basis = fit(points, move=False)
    people = people_from(points, move=False)
    everyone = np.concatenate([people, people[:, np.arange(len(points)) ^ 1] * [-1, 1, 1]])
    everyone = anny_identity._align(everyone, basis.mean, np.ones(len(points)))
    flat = basis.components.reshape(len(basis.components), -1)
    coefficients = (everyone - basis.mean).reshape(len(everyone), -1) @ np.linalg.pinv(flat)
    np.testing.assert_allclose(coefficients.std(0), 1, atol=0.02)
    np.testing.assert_allclose(np.corrcoef(coefficients.T), np.eye(len(flat)), atol=0.05)
    assert basis.explained[-1] > 0.95
    assert (np.diff(basis.explained) >= 0).all()


def test_rigid_motion_does_not_count_and_scale_does(points):
    still, moved = fit(points, move=False), fit(points, move=True)
    total = [np.sqrt((b.components**2).sum()) for b in (still, moved)]
    np.testing.assert_allclose(total[1], total[0], rtol=0.05)
    growth = (points / np.linalg.norm(points)).ravel()
    spread = np.linalg.norm(still.components.reshape(len(still.components), -1) @ growth)
    assert spread > 0.8 * 0.04 * np.linalg.norm(points)


def test_mean_is_symmetric(points):
    mean = fit(points, move=True).mean
    np.testing.assert_allclose(mean[np.arange(len(mean)) ^ 1] * [-1, 1, 1], mean, atol=1e-6)
