"""Targets that a worker thread prepares are those that a step would make itself, and the worker always ends."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import train_toy
from bounded_memory import MIB, allocating_at_most
from mien.training import train
from mien.training.ahead import AHEAD, targets_ahead
from mien.training.footage.frames import FrameOrder, background_at, training_frames
from mien.training.footage.sequence import Sequence, Target, Targets, composite, composite_reference
from mien.training.settings import TrainSettings
from plain_settings import plain_run
from test_training_resume import RESULTS
from toy_scene import toy_sequence
from training_progress import stopped_at

SETTINGS = plain_run(steps=40, split="none", background="random")


def workers() -> list[str]:
    return [thread.name for thread in threading.enumerate() if thread.name.startswith("mien-targets")]


def one_by_one(order: FrameOrder, targets: list[Targets], settings: TrainSettings, step: int) -> Target:
    frame, _ = order.at(step)
    return targets[frame.sequence].target(frame.timestep, frame.camera, background_at(settings, step), keep=False)


def test_native_composite_has_the_integers_of_the_reference() -> None:
    random = np.random.default_rng(0)
    for width in (1, 7, 8, 50, 64) * 20:
        image = random.integers(0, 256, (9, width, 3), dtype=np.uint8)
        matte = np.repeat(random.choice([0, 0, 255, 255, 3, 254], (9, -(-width // 5))), 5, axis=1)[:, :width]
        matte = matte.astype(np.uint8)
        left, right = sorted(random.integers(0, width + 1, 2).tolist())
        inside = np.zeros((9, width), bool)
        inside[2:7, left:right] = True
        background = random.integers(0, 256, 3, dtype=np.uint8)
        for seen, box in ((matte, None), (matte * inside, (left, 2, right - left, 5))):
            expected = composite_reference(image, seen, background, box)
            np.testing.assert_array_equal(composite(image, seen, background, box), expected)


def test_every_integer_is_the_rounded_one() -> None:
    """All pairs of a value and an opacity, over a few backgrounds."""
    value, matte = np.meshgrid(np.arange(256, dtype=np.uint8), np.arange(256, dtype=np.uint8))
    image = np.repeat(value[..., None], 3, axis=2)
    for gray in (0, 1, 100, 255):
        found = composite(image, np.ascontiguousarray(matte), np.full(3, gray, np.uint8))
        total = value.astype(int) * matte + gray * (255 - matte.astype(int))
        np.testing.assert_array_equal(found[..., 0], (2 * total + 255) // 510)


@pytest.mark.parametrize("resolution", [0, 21])
@pytest.mark.parametrize("background", ["white", "mixed", "random"])
def test_the_queue_gives_the_targets_of_the_steps(resolution: int, background: str) -> None:
    sequence = toy_sequence(6, 32)[1]
    settings = replace(SETTINGS, background=background)
    order = FrameOrder(training_frames([sequence], settings), 0)
    targets = [Targets(sequence, resolution)]
    with targets_ahead(order, lambda _: targets, settings) as queue:
        for step in (*range(9), *range(30, 40), 3, 4):  # as a run that resumes, too
            found, own = queue.target(step), one_by_one(order, [Targets(sequence, resolution)], settings, step)
            assert found.box == own.box
            for name in ("picture", "matte", "background"):
                assert getattr(found, name).equal(getattr(own, name)), (step, name)
    assert not workers()


def test_no_more_targets_wait_than_the_next_few_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    sequence = toy_sequence(6, 32)[1]
    order, made = FrameOrder(training_frames([sequence], SETTINGS), 0), []
    targets = Targets(sequence, 0)
    composed = targets.composed
    monkeypatch.setattr(targets, "composed", lambda *arguments: made.append(arguments) or composed(*arguments))
    with targets_ahead(order, lambda _: [targets], SETTINGS) as queue:
        for step in range(SETTINGS.steps):
            queue.target(step)
            assert len(made) <= step + 1 + AHEAD
    assert len(made) == SETTINGS.steps, "nothing is made beyond the last step"


@pytest.mark.unchecked
def test_a_run_has_the_same_bytes_with_and_without_the_worker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    face_model, sequence = toy_sequence(6, 32)
    settings = replace(train_toy.SETTINGS, steps=8, background="random", split="none", resolution=25)
    train([sequence], face_model, train_toy.CONFIG, settings, tmp_path / "ahead")

    @contextmanager
    def nothing(*_: object) -> Iterator[None]:
        yield None

    monkeypatch.setattr("mien.training.trainer.targets_ahead", nothing)
    train([sequence], face_model, train_toy.CONFIG, settings, tmp_path / "alone")
    for name in RESULTS:
        assert (tmp_path / "ahead" / name).read_bytes() == (tmp_path / "alone" / name).read_bytes(), name


def test_the_worker_ends_with_an_error_of_its_own_and_with_an_interrupted_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    face_model, sequence = toy_sequence(6, 32)
    with pytest.raises(KeyboardInterrupt):
        train([sequence], face_model, train_toy.CONFIG, train_toy.SETTINGS, tmp_path / "stopped", stopped_at(1))
    assert not workers()

    def unreadable(*_: object, **__: object) -> Target:
        raise OSError("the disk is gone")

    monkeypatch.setattr(Targets, "composed", unreadable)
    with pytest.raises(OSError, match="the disk is gone"):
        train([sequence], face_model, train_toy.CONFIG, train_toy.SETTINGS, tmp_path / "run")
    assert not workers()


@pytest.mark.unchecked
def test_the_pictures_of_a_long_capture_are_never_held_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    sequence = large_sequence(80, 256)
    monkeypatch.setattr("mien.training.footage.sequence.CACHE_BYTES", 4 * MIB)
    settings = replace(SETTINGS, steps=80, background="white")
    order = FrameOrder(training_frames([sequence], settings), 0)
    targets = Targets(sequence, 0)
    with allocating_at_most(10 * MIB), targets_ahead(order, lambda _: [targets], settings) as queue:
        for step in range(settings.steps):
            queue.target(step)


def large_sequence(timesteps: int, size: int) -> Sequence:
    """A sequence whose pictures are all the same one in memory."""
    _, sequence = toy_sequence(timesteps, 8)
    one = np.random.default_rng(0).integers(0, 256, (size, size, 3), dtype=np.uint8)
    images = np.broadcast_to(one, (timesteps, 1, size, size, 3))
    scoring = np.broadcast_to(one[..., 0], (timesteps, 1, size, size))
    capture = replace(sequence.capture, images=images, mattes=scoring)
    cameras = tuple(camera.resized(size, size) for camera in sequence.tracking.cameras)
    return replace(sequence, capture=capture, scoring=scoring, tracking=replace(sequence.tracking, cameras=cameras))
