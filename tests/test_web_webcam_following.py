"""How a page follows a face that its camera sees: relative to the neutral face, within limits, and calmly."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mien.driving.live import OneEuro
from web_case import run_node


def found(
    seconds: float, scores: dict[str, float], rotvec: Sequence[float] = (0, 0, 0), at: Sequence[float] = (0, 0, 0)
):
    """Return what a detector says about a picture: a head in front of the camera, with place in metres."""
    matrix = np.eye(4)
    matrix[:3, :3] = 1.1 * Rotation.from_rotvec(rotvec).as_matrix()
    matrix[:3, 3] = 100 * np.asarray(at) + (0, 0, -40)
    return {
        "scores": list(scores.items()), "matrix": matrix.T.reshape(-1).tolist(), "milliseconds": 1000 * seconds,
        "work": 1,
    }  # fmt: skip


def followed(built: Path, mirrored: bool, pictures: list[dict[str, Any]], **more: Any) -> dict[str, Any]:
    return run_node("webcam.mjs", built / "webcam.js", {"mirrored": mirrored, "found": pictures, **more})


AT_REST = {"jawOpen": 0.1, "eyeBlinkLeft": 0.2, "eyeBlinkRight": 0.15, "mouthSmileLeft": 0.3, "mouthSmileRight": 0.3}
REST_TURN = [0.1, 0.2, -0.05]


def second_at_rest() -> list[dict[str, Any]]:
    """A second of a face at rest, with a blink in it."""
    blink = AT_REST | {"eyeBlinkLeft": 0.7, "eyeBlinkRight": 0.7}
    return [found(i / 30, blink if i in (9, 10, 11) else AT_REST, REST_TURN, (0.02, 0, 0)) for i in range(31)]


@pytest.mark.parametrize("mirrored", [False, True])
def test_faces_are_relative_to_the_neutral_one(built: Path, mirrored: bool) -> None:
    """Held for two seconds, so that no smoothing is left."""
    held = {"jawOpen": 1.0, "eyeBlinkLeft": 0.75, "eyeBlinkRight": 0.15, "mouthSmileLeft": 0.1, "mouthSmileRight": 0.3}
    turn = (Rotation.from_rotvec(REST_TURN) * Rotation.from_rotvec([0.2, 0.3, 0.1])).as_rotvec()
    at = np.array([0.02, 0, 0]) + Rotation.from_rotvec(REST_TURN).as_matrix() @ [0.01, 0.02, -0.005]
    rest = second_at_rest()
    told = followed(built, mirrored, rest + [found(1.1 + i / 30, held, turn, at) for i in range(60)])["readings"]
    assert told[: len(rest) - 1] == [None] * (len(rest) - 1)
    first, last = told[len(rest) - 1], told[-1]
    assert all(abs(value) < 1e-6 for value in first["scores"].values())
    np.testing.assert_allclose(first["turn"], np.eye(3).reshape(-1), atol=1e-6)
    closed, open_ = ("eyeblinkright", "eyeblinkleft") if mirrored else ("eyeblinkleft", "eyeblinkright")
    less, same = ("mouthsmileright", "mouthsmileleft") if mirrored else ("mouthsmileleft", "mouthsmileright")
    expected = {"jawopen": 1, closed: 1, open_: 0, less: -0.2, same: 0}
    assert last["scores"] == pytest.approx(expected, abs=1e-3)
    side = -1 if mirrored else 1
    expected_turn = Rotation.from_rotvec([0.2, side * 0.3, side * 0.1]).as_matrix()
    np.testing.assert_allclose(np.reshape(last["turn"], (3, 3)), expected_turn, atol=1e-2)
    np.testing.assert_allclose(last["shift"], [side * 0.01, 0.02, -0.005], atol=1e-3)


def test_the_button_takes_another_neutral_face(built: Path) -> None:
    smile = AT_REST | {"mouthSmileLeft": 0.6, "mouthSmileRight": 0.6}
    pictures = second_at_rest() + [found(1.1 + i / 30, smile) for i in range(60)]
    told = followed(built, False, pictures, recalibrate=40)["readings"]
    assert told[45]["calibrating"] is True
    assert told[45]["scores"]["mouthsmileleft"] > 0.2
    assert told[-1]["calibrating"] is False
    assert abs(told[-1]["scores"]["mouthsmileleft"]) < 1e-2


def test_a_mouth_that_is_open_at_first_is_not_neutral(built: Path) -> None:
    """An open mouth and a head far aside in the first second are motion; raised brows may be how one looks at rest."""
    held = {"jawOpen": 0.7, "browInnerUp": 0.6}
    turn = Rotation.from_rotvec([0, 0.9, 0])
    pictures = [found(i / 30, held, turn.as_rotvec()) for i in range(90)]
    last = followed(built, False, pictures)["readings"][-1]
    assert last["scores"] == pytest.approx({"jawopen": 0.7, "browinnerup": 0}, abs=1e-3)
    np.testing.assert_allclose(np.reshape(last["turn"], (3, 3)), turn.as_matrix(), atol=1e-2)


def test_pictures_without_a_face_say_nothing(built: Path) -> None:
    lost = {"scores": None, "matrix": None, "milliseconds": 2000, "work": 1}
    assert followed(built, True, [*second_at_rest(), lost])["readings"][-1] is None


def test_a_head_that_goes_far_away_stays_in_the_picture(built: Path) -> None:
    far = [found(1.1 + i / 30, AT_REST, REST_TURN, (0.5, -0.4, -1)) for i in range(60)]
    last = followed(built, False, second_at_rest() + far)["readings"][-1]
    assert np.abs(last["shift"]).max() <= 0.08


def test_smoothing_is_that_of_the_viewer(built: Path) -> None:
    values, step = np.random.default_rng(1).standard_normal(40), 1 / 30
    smooth = {"smoothing": {"rest": 1.5, "follow": 6}, "values": values.tolist(), "step": step}
    smoothed = np.array(followed(built, False, [], smooth=smooth)["smoothed"])
    smoother = OneEuro(np.array([1.5]), np.array([6.0]))
    expected = [smoother(np.array([value]), index * step)[0] for index, value in enumerate(values)]
    np.testing.assert_allclose(smoothed, expected, rtol=1e-9, atol=1e-12)
