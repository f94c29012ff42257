"""A run can begin with pictures of half the size."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import train_toy
from mien.training import train, trainer
from mien.training.batch import coarse_steps
from mien.training.constants import TRAINING
from mien.training.footage import Targets
from test_training_resume import assert_same_results
from toy_scene import toy_sequence

SETTINGS = replace(train_toy.SETTINGS, steps=10, coarse=0.5, record_every=1)


@pytest.fixture
def _halved(monkeypatch: pytest.MonkeyPatch) -> None:
    """The toy's pictures are large enough to be halved."""
    monkeypatch.setattr("mien.training.batch.TRAINING", replace(TRAINING, least_halved=32))


def sizes_of(run_dir: Path, monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, ...]]:
    """The sizes of targets and renderings of a run's steps."""
    face_model, sequence = toy_sequence(timesteps=5, size=32)
    seen, compare = [], trainer.compare

    def looked(state, batch, shown):  # noqa: ANN001, ANN202
        camera = batch[0].camera
        seen.append((camera.width, batch[0].target.picture.shape[0], shown[0].image.shape[0]))
        return compare(state, batch, shown)

    monkeypatch.setattr(trainer, "compare", looked)
    train([sequence], face_model, train_toy.CONFIG, SETTINGS, run_dir)
    return seen


@pytest.mark.usefixtures("_halved")
def test_the_first_half_of_a_run_sees_pictures_of_half_the_size(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert sizes_of(tmp_path, monkeypatch) == [(16, 16, 16)] * 5 + [(32, 32, 32)] * 5


@pytest.mark.usefixtures("_halved")
def test_halved_pictures_are_forgotten_after_their_last_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    forgotten, forget = [], Targets.forget
    monkeypatch.setattr(Targets, "forget", lambda self: forgotten.append(self.width) or forget(self))
    sizes_of(tmp_path, monkeypatch)
    assert forgotten == [16]


def test_small_pictures_keep_their_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert sizes_of(tmp_path, monkeypatch) == [(32, 32, 32)] * 10


@pytest.mark.usefixtures("_halved")
@pytest.mark.parametrize("last", [3, 5, 6])
def test_a_run_that_is_stopped_near_the_change_ends_with_the_same_bytes(last: int, tmp_path: Path) -> None:
    face_model, sequence = toy_sequence(timesteps=5, size=32)
    train([sequence], face_model, train_toy.CONFIG, SETTINGS, tmp_path / "whole")
    steps = iter(range(1, SETTINGS.steps + 1))

    def watch(_: object) -> None:
        if next(steps) == last:
            raise KeyboardInterrupt

    settings = replace(SETTINGS, checkpoint_every=1)
    with pytest.raises(KeyboardInterrupt):
        train([sequence], face_model, train_toy.CONFIG, settings, tmp_path / "stopped", watch=watch)
    train([sequence], face_model, train_toy.CONFIG, settings, tmp_path / "stopped")
    assert_same_results(tmp_path / "stopped", tmp_path / "whole")


def test_halved_targets_show_the_same() -> None:
    sequence = toy_sequence(timesteps=3, size=33)[1]
    targets = Targets(sequence, 0)
    halved = targets.halved()
    assert (halved.width, halved.height) == (17, 17)
    camera, small = targets.camera(0), halved.camera(0)
    assert small.K[0, 0] == pytest.approx(camera.K[0, 0] * 17 / 33)
    white = np.full(3, 255, np.uint8)
    large, low = (one.target(0, 0, white, keep=False).picture.float().mean() for one in (targets, halved))
    assert float(low) == pytest.approx(float(large), abs=1)


@pytest.mark.parametrize(("share", "steps"), [(0.0, 0), (0.5, 5), (1.0, 10)])
@pytest.mark.usefixtures("_halved")
def test_the_share_says_how_many_steps(share: float, steps: int) -> None:
    targets = [Targets(toy_sequence(timesteps=3, size=32)[1], 0)]
    assert coarse_steps(targets, replace(SETTINGS, coarse=share)) == steps
