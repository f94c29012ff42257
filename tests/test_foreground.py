"""Colours of the person alone at soft edges of the matte."""

import numpy as np
import pytest

from mien.training.foreground import foreground_colors
from mien.training.sequence import Targets, composite
from toy_scene import toy_sequence

PERSON, WALL = np.array([150.0, 90.0, 60.0]), np.array([210.0, 220.0, 235.0])


def _filmed(side: int = 480) -> tuple[np.ndarray, np.ndarray]:
    """A brown disc with a soft rim of 8 pixels and a brighter lower half, before a light wall; and its matte."""
    rows, columns = np.mgrid[:side, :side] - side / 2
    alpha = np.clip((0.3 * side - np.hypot(rows, columns)) / 8 + 0.5, 0, 1)
    matte = np.rint(alpha * 255).astype(np.uint8)
    share = matte[..., None] / 255.0
    return np.rint(share * _person(side) + (1 - share) * WALL).astype(np.uint8), matte


def _person(side: int) -> np.ndarray:
    return PERSON + np.where(np.arange(side) > side / 2, 20.0, 0.0)[:, None, None]


def test_soft_edges_have_the_colour_of_the_person() -> None:
    image, matte = _filmed()
    found = foreground_colors(image, matte)
    share, soft = matte[..., None] / 255.0, (matte > 0) & (matte < 252)
    for background in (0.0, 255.0):
        true = share * _person(480) + (1 - share) * background
        filmed, cleaned = (share * colors + (1 - share) * background for colors in (image, found))
        before, after = (np.abs(picture - true)[soft].mean() for picture in (filmed, cleaned))
        assert before > 10
        assert after < 0.15 * before


def test_solid_pixels_stay_and_empty_ones_are_black() -> None:
    image, matte = _filmed()
    found = foreground_colors(image, matte)
    assert np.array_equal(found[matte >= 252], image[matte >= 252])
    assert not found[matte == 0].any()
    assert not foreground_colors(image, np.zeros_like(matte)).any()


def test_only_what_is_near_the_edge_counts() -> None:
    """Another wall far from the head changes nothing; one beside it does."""
    image, matte = _filmed()
    found = foreground_colors(image, matte)
    far, near = image.copy(), image.copy()
    far[:, :10] = 0
    near[:, :150] = 0
    assert np.array_equal(foreground_colors(far, matte), found)
    assert not np.array_equal(foreground_colors(near, matte), found)


@pytest.mark.parametrize("keep", [True, False])
def test_training_pictures_are_cleaned_with_the_capture_s_matte(keep: bool) -> None:
    """The cut at the neck is no edge of the person; the scored mask only says what is shown."""
    _, sequence = toy_sequence(2, 32)
    background = np.array([10, 20, 30], np.uint8)
    image, matte = (np.array(part[1, 0]) for part in (sequence.capture.images, sequence.capture.mattes))
    expected = composite(foreground_colors(image, matte), np.array(sequence.scoring[1, 0]), background)
    targets = Targets(sequence, 0, cleaned=True)
    for _ in range(2):
        assert np.array_equal(targets.target(1, 0, background, keep=keep).picture.numpy(), expected)
    plain = Targets(sequence, 0).target(1, 0, background, keep=keep).picture.numpy()
    assert np.array_equal(plain, composite(image, np.array(sequence.scoring[1, 0]), background))
