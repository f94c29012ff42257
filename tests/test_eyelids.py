"""Lids are put where pictures show them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from blink_case import SKIN, BlinkCase
from mien.tracking.eyelids import place_lids
from mien.tracking.eyelids.eyes import eyes_of
from mien.tracking.eyelids.placing import weigh_positions
from mien.tracking.fitting import CameraBatch, Views, layout_of
from small_face_model import make_small_face_model

pytestmark = pytest.mark.unchecked

TIMESTEPS = 24
POSITIONS = np.linspace(-0.4, 1.2, 13)


@pytest.fixture(scope="module")
def case() -> BlinkCase:
    return BlinkCase()


def still() -> np.ndarray:
    return np.full((TIMESTEPS, 2), 0.1)


def blinks() -> np.ndarray:
    """Return lids that blink: both eyes for three frames, and the left one alone for one frame."""
    lids = still()
    lids[7:10] = np.array([0.6, 1.0, 0.7])[:, None]
    lids[16, 1] = 1.0
    return lids


def test_blinks_that_landmarks_missed_are_found_in_pictures(case):
    true = blinks()
    tracked = 0.1 + 0.4 * (true - 0.1)
    found = case.lids_of(place_lids(case.reduced, [case.shot(true)], case.fit(tracked), 1.0))
    np.testing.assert_allclose(found[true > 0.5], true[true > 0.5], atol=0.15)
    # A wink closes only one eye, and open eyes stay open.
    np.testing.assert_allclose(found[true < 0.5], 0.1, atol=0.05)


def test_blinks_that_never_were_are_opened(case):
    false = still()
    false[11] = 0.7
    found = case.lids_of(place_lids(case.reduced, [case.shot(still())], case.fit(false), 1.0))
    np.testing.assert_allclose(found, 0.1, atol=0.1)


def test_nobody_blinks_where_nobody_does(case):
    tracked = still() + 0.03 * np.random.default_rng(0).standard_normal((TIMESTEPS, 2))
    found = case.lids_of(place_lids(case.reduced, [case.shot(still())], case.fit(tracked), 1.0))
    assert np.abs(found - 0.1).max() < np.abs(tracked - 0.1).max() + 0.01


def test_only_lids_move(case):
    true = blinks()
    before = case.fit(still())
    after = place_lids(case.reduced, [case.shot(true)], before, 1.0)
    others = torch.ones(case.reduced.layout.size, dtype=torch.bool)
    others[case.columns] = False
    assert torch.equal(after.sequences[0].state[:, others], before.sequences[0].state[:, others])


@pytest.mark.parametrize("what", ["no weight", "too small", "eyes like skin"])
def test_what_pictures_do_not_show_stays_as_tracked(case, what):
    size = 40 if what == "too small" else 192
    true, tracked = blinks(), still()
    shot = case.shot(true, size, **({"white": SKIN} if what == "eyes like skin" else {}))
    found = place_lids(case.reduced, [shot], case.fit(tracked, size), 0.0 if what == "no weight" else 1.0)
    np.testing.assert_allclose(case.lids_of(found), tracked, atol=0.05 if what == "eyes like skin" else 0)


def test_of_several_cameras_the_one_that_an_eye_faces_tells(case):
    true = blinks()
    front, tracked = case.shot(true), case.fit(still())
    cameras = tracked.sequences[0].cameras
    side = cameras.viewmat[0].clone()
    side[:3, 3] += torch.tensor([0.5, 0.0, 0.0])  # sees the head from 35 degrees to the side
    cameras = CameraBatch(cameras.K.repeat(2, 1, 1), torch.stack([cameras.viewmat[0], side]))
    one = front.capture
    capture = replace(
        one, camera_ids=("front", "side"), images=np.concatenate([one.images, np.full_like(one.images, 128)], axis=1),
        mattes=np.repeat(one.mattes, 2, axis=1), landmarks=np.repeat(one.landmarks, 2, axis=1),
        valid=np.repeat(one.valid, 2, axis=1), principal_point=np.repeat(one.principal_point, 2, axis=0),
    )  # fmt: skip
    picture = torch.arange(2 * TIMESTEPS)
    detected = front.views.detected.repeat_interleave(2, 0)
    views = Views(detected, picture // 2, picture % 2, torch.ones(len(picture), dtype=torch.float64))
    shot, own = replace(front, views=views, capture=capture), replace(tracked.sequences[0], cameras=cameras)
    found = place_lids(case.reduced, [shot], replace(tracked, sequences=(own,)), 1.0)
    np.testing.assert_allclose(case.lids_of(found), true, atol=0.2)


def test_is_the_same_with_any_number_of_threads(case, monkeypatch):
    shot, found = case.shot(blinks()), []
    for threads in ("1", "3"):
        monkeypatch.setenv("MIEN_THREADS", threads)
        found.append(place_lids(case.reduced, [shot], case.fit(still()), 1.0).sequences[0].state)
    assert torch.equal(*found)


def test_eyes_have_their_own_closing_coefficient(case):
    layout = layout_of(case.model)
    eyes = eyes_of(case.model, layout)
    assert [layout.names[eye.column] for eye in eyes] == ["eyeBlinkRight", "eyeBlinkLeft"]
    assert all(eye.closed == pytest.approx(1.0, abs=0.05) for eye in eyes)
    assert all(eye.forward[2] > 0.9 for eye in eyes)


def test_models_that_cannot_close_an_eye_have_none(case):
    small = make_small_face_model()
    assert eyes_of(small, layout_of(small)) == []
    blind = replace(case.model, region_names=tuple(name.replace("eyes", "x") for name in case.model.region_names))
    blind = replace(blind, region_names=tuple(name.replace("irises", "y") for name in blind.region_names))
    assert eyes_of(blind, layout_of(blind)) == []


def bowls(at: np.ndarray, depth: float = 400.0) -> np.ndarray:
    return depth * (POSITIONS - at[:, None]) ** 2


def test_colors_that_agree_change_little():
    tracked = 0.1 + 0.02 * np.random.default_rng(0).standard_normal(50)
    np.testing.assert_allclose(weigh_positions(bowls(tracked), tracked, 1.0), tracked, atol=0.02)


def test_a_few_frames_that_disagree_follow_the_colors():
    tracked = np.full(50, 0.1)
    seen = tracked.copy()
    seen[20:23] = (0.5, 1.0, 0.5)
    np.testing.assert_allclose(weigh_positions(bowls(seen), tracked, 1.0), seen, atol=0.05)


def test_colors_that_contradict_every_frame_count_for_nothing():
    random = np.random.default_rng(0)
    tracked = np.full(50, 0.1)
    found = weigh_positions(bowls(random.uniform(0.0, 1.0, 50)), tracked, 1.0)
    np.testing.assert_allclose(found, tracked, atol=0.05)


def test_what_colors_find_too_open_throughout_is_corrected_but_where_lids_meet():
    tracked = np.full(50, 0.2)
    tracked[30] = 0.5
    seen = np.full(50, 0.1)
    seen[30] = 1.0
    found = weigh_positions(bowls(seen), tracked, 1.0)
    np.testing.assert_allclose(np.delete(found, 30), 0.2, atol=0.02)
    assert found[30] == pytest.approx(1.0, abs=0.05)


def test_frames_whose_lids_would_be_opener_than_any_are_left_alone():
    tracked = np.full(50, 0.1)
    seen = tracked.copy()
    seen[10] = -2.0
    assert weigh_positions(bowls(seen), tracked, 1.0)[10] == pytest.approx(0.1, abs=0.01)
