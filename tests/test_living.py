"""The film of an avatar: its head turns to the sides that were filmed, and fills the picture."""

from dataclasses import replace

import numpy as np
import pytest

from mien import runtime
from mien.evaluation import living
from mien.evaluation.living import Living
from web_case import drawn_head

DEGREES = np.degrees(1.0)


avatar = pytest.fixture(lambda: runtime.Avatar(drawn_head(1500)))


def aside(avatar: runtime.Avatar, degrees: float) -> runtime.Avatar:
    """The avatar of a person whose head, at rest, is turned to its left."""
    portable = avatar.portable
    turned = living.turned_head(avatar, degrees / DEGREES, 0.0)
    return runtime.Avatar(replace(portable, neutral=replace(portable.neutral, head_rotation=turned)))


def test_the_head_turns_to_the_sides_that_were_filmed_and_never_leaves_the_film(avatar: runtime.Avatar, monkeypatch):
    # The head of the drawn person looks 5.1 degrees to its right of the camera.
    assert np.multiply(living.yaws_of(aside(avatar, 5.1), (15, 10)), DEGREES) == pytest.approx((-10, 15), abs=0.1)
    # A camera that sees its right already leaves less on that side.
    assert np.multiply(living.yaws_of(aside(avatar, 10.1), (15, 10)), DEGREES) == pytest.approx((-15, 10), abs=0.1)
    assert living.yaws_of(avatar, (0, 0)) == (-living.LEAST_YAW, living.LEAST_YAW)
    assert living.yaws_of(avatar, (180, 180)) == living.yaws_of(avatar, None) == (-living.MOST_YAW, living.MOST_YAW)
    yaws = (-0.1, 0.4)
    monkeypatch.setattr(living, "FPS", 4)
    pictures = np.stack(list(living.pictures_of(Living(avatar, living.near_camera(avatar, yaws), yaws))))
    drawn = pictures.min(-1) < 200
    rows, columns = np.flatnonzero(drawn.max((0, 2))), np.flatnonzero(drawn.max((0, 1)))
    for ends in (rows, columns):
        assert ends[0] > 0
        assert ends[-1] < living.SIDE - 1
    assert max(np.ptp(rows), np.ptp(columns)) > 0.8 * living.SIDE
    assert np.mean(pictures[0] != pictures[5]) > 0.1, "the head turns"
