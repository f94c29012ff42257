"""The `paper` schedule: better than landmarks alone, the same in every run, its terms and its optimiser."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from mien.tracking import Tracking, TrackingSettings, resume, track, track_subject
from mien.tracking.paper_adam import Moments
from mien.tracking.paper_settings import PaperSettings
from mien.tracking.resume import Keeper
from photometric_case import FOCAL, PhotometricCase, assert_alike, make_photometric_case
from test_photometric_tracking import turn_error, wobble

LANDMARKS = TrackingSettings(focal=FOCAL, schedule="landmarks")
QUICK = PaperSettings(texture_size=128, first_steps=150, epochs=3)


@pytest.fixture(scope="module")
def case() -> PhotometricCase:
    return make_photometric_case(timesteps=8)


@pytest.fixture(scope="module")
def by_landmarks(case: PhotometricCase) -> Tracking:
    return track(case.capture, case.model, LANDMARKS)


@pytest.fixture(scope="module")
def by_descent(case: PhotometricCase) -> Tracking:
    return track(case.capture, case.model, replace(LANDMARKS, schedule="paper", paper=QUICK))


def test_pixels_calm_what_landmarks_leave(case, by_landmarks, by_descent):
    assert wobble(case, by_descent) < 0.25 * wobble(case, by_landmarks)
    assert turn_error(case, by_descent) < 0.9 * turn_error(case, by_landmarks)


def test_it_says_how_it_was_made(by_descent):
    assert by_descent.settings["schedule"] == "paper"
    assert by_descent.face.vertex_offsets is not None
    assert by_descent.face.vertex_offsets.norm(dim=1).max() < 0.005


def test_the_same_in_every_run(case, by_descent):
    short = replace(QUICK, first_steps=10, steps=3, epochs=1)
    runs = [track(case.capture, case.model, replace(LANDMARKS, schedule="paper", paper=short)) for _ in range(2)]
    for name, tensor in runs[0].face.tensors().items():
        assert torch.equal(tensor, runs[1].face.tensors()[name]), name


def test_adam_is_that_of_torch():
    random = torch.Generator().manual_seed(0)
    values, moments = torch.randn(5, generator=random), Moments.like(torch.zeros(5))
    expected = torch.nn.Parameter(values.clone())
    optimizer = torch.optim.Adam([expected], lr=0.1, eps=1e-12)
    for _ in range(4):
        gradient = torch.randn(5, generator=random)
        expected.grad = gradient.clone()
        optimizer.step()
        moments.step(values, gradient, 0.1)
    torch.testing.assert_close(values, expected.detach(), atol=1e-6, rtol=0)


@pytest.mark.parametrize("interrupted_at", [3, 9])
def test_an_interrupted_fit_goes_on(case, tmp_path, monkeypatch, interrupted_at: int):
    """Interrupted on its way through the frames, or in the epochs: the same numbers as without."""
    short = replace(QUICK, first_steps=10, steps=3, epochs=3)
    settings = replace(LANDMARKS, schedule="paper", paper=short)
    expected = track_subject([case.capture], case.model, settings)[0]
    monkeypatch.setattr(resume, "_INTERVAL_SECONDS", 0.0)
    offer, offers = Keeper.offer, []

    def offer_then_stop(self: Keeper, name: str, make: Callable) -> None:
        offer(self, name, make)
        offers.append(None)
        if len(offers) == interrupted_at:
            raise KeyboardInterrupt

    monkeypatch.setattr(Keeper, "offer", offer_then_stop)
    keep = tmp_path / "kept"
    with pytest.raises(KeyboardInterrupt):
        track_subject([case.capture], case.model, settings, keep)
    assert (keep / "descent.safetensors").is_file()
    resumed = track_subject([case.capture], case.model, settings, keep)[0]
    assert not keep.exists()
    assert_alike(expected, resumed)
