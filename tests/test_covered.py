"""Frames in which something covers a part of the face: a drawn hand in front of a drawn mouth, a dark slab."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from known import known
from mien.capture import Capture
from mien.evaluation.load import held_out_by_protocol
from mien.lab.synthetic import SyntheticRecipe, SyntheticScene, synthesize
from mien.tracking import Tracking, read_tracking, residual_report, write_tracking
from mien.tracking.landmarks import LEFT_EYELIDS, RIGHT_EYELIDS
from mien.tracking.pixels.covered import covered_parts, the_face, usual_look
from mien.tracking.report.page import findings
from mien.tracking.tracking import PARTS
from mien.training import TrainSettings
from mien.training.footage.frames import held_out, training_frames
from mien.training.footage.sequence import Sequence
from occlusion_case import with_hand, with_slab

RECIPE = SyntheticRecipe(
    name="hand", width=160, height=160, seconds=1.6, hair="none", glasses=False, brows_and_lashes=False,
    texture_size=128, rotation=(15.0, 8.0, 5.0),
)  # fmt: skip
HALF = [*range(6, 16), *range(25, 35)]
EYES = LEFT_EYELIDS + RIGHT_EYELIDS


@pytest.fixture(scope="module")
def drawn() -> tuple[Capture, Tracking, object]:
    capture, truth = synthesize(RECIPE, seed=7)
    return capture, truth, SyntheticScene(RECIPE, seed=7).model


def found_in(capture: Capture, drawn) -> dict[str, list[int]]:
    covered = covered_parts(capture, drawn[1], drawn[2])
    return {name: covered[:, 0, part].nonzero()[:, 0].tolist() for part, name in enumerate(PARTS)}


@pytest.mark.unchecked
@pytest.mark.parametrize("frames", [HALF, list(range(10, 14)), [], [12]], ids=["half", "tenth", "none", "one"])
def test_a_hand_in_front_of_the_mouth_is_found(drawn, frames):
    """One odd picture is an expression and not a hand."""
    found = found_in(with_hand(drawn[0], frames), drawn)
    assert found["mouth"] == (frames if len(frames) > 1 else [])
    assert set(found["nose"] + found["eyes"]) <= set(frames)


@pytest.mark.unchecked
def test_a_phone_in_front_of_the_eyes_is_found_there(drawn):
    found = found_in(with_slab(drawn[0], HALF, EYES), drawn)
    assert found["eyes"] == HALF
    assert found["mouth"] == []


def test_two_looks_that_are_equally_steady_leave_the_face_unknown():
    random = np.random.default_rng(0)
    face, cup = random.normal(size=(2, 60, 3)).astype(np.float32)
    shown = np.ones((40, 60), np.float32)

    def pictures(other: np.ndarray) -> np.ndarray:
        looks = np.concatenate([np.repeat(face[None], 22, axis=0), other])
        return (looks + 0.2 * random.normal(size=looks.shape)).astype(np.float32)

    still = pictures(np.repeat(cup[None], 18, axis=0))
    assert the_face(usual_look(still, shown), still, shown) is None
    moving = pictures(random.normal(size=(18, 60, 3)))
    look = known(the_face(usual_look(moving, shown), moving, shown))
    assert np.corrcoef(look.ravel(), face.ravel())[0, 1] > 0.95


def with_covered(truth: Tracking, frames: list[int]) -> Tracking:
    covered = torch.zeros(len(truth.valid), 1, len(PARTS), dtype=torch.bool)
    covered[frames, 0, 0] = True
    return replace(truth, covered=covered)


@pytest.mark.unchecked
@pytest.mark.parametrize(
    ("stride", "odd", "turn"), [(4, [20], 0.0), (1, [20, 21, 22, 23], 0.35)], ids=["rare", "turned"]
)
def test_what_few_pictures_show_is_no_hand(drawn, stride, odd, turn):
    """A grimace in one of a few pictures looks odd, and so does a side that no other picture shows."""
    capture, truth, model = drawn
    rotation = truth.face.head_rotation.clone()
    rotation[odd] += torch.tensor([turn, 0.0, 0.0])
    rare, shown = slice(None, None, stride), with_hand(capture, odd)
    face = replace(truth.face, head_rotation=rotation)
    tracking = replace(truth, valid=truth.valid[rare], face=face[rare])
    pictures = {name: getattr(shown, name)[rare] for name in ("timestamps", "images", "mattes", "landmarks", "valid")}
    few = replace(shown, fps=shown.fps / stride, **pictures)
    assert not covered_parts(few, tracking, model).any()


@pytest.mark.unchecked
def test_what_is_covered_is_kept_and_told(drawn, tmp_path):
    capture, truth, face_model = drawn
    write_tracking(tmp_path / "none", truth)
    assert read_tracking(tmp_path / "none").covered is None
    tracking = with_covered(truth, HALF)
    write_tracking(tmp_path / "some", tracking)
    assert torch.equal(known(read_tracking(tmp_path / "some").covered), known(tracking.covered))
    report = residual_report(capture, tracking, face_model)
    assert report["covered_frames"] == {"mouth": HALF}
    (told,) = [text for kind, text in findings(tracking, report) if kind == "odd" and "mouth" in text]
    for words in ("covers the mouth in 20 of 40 frames with a face", "6-15, 25-34", "film again"):
        assert words in told
    assert residual_report(capture, truth, face_model)["covered_frames"] == {}


@pytest.mark.unchecked
def test_covered_frames_are_not_trained_on_but_scored(drawn):
    capture, truth, _ = drawn
    settings = TrainSettings(split="blocks")
    out = held_out(len(truth.valid), settings.split).nonzero()[:, 0].tolist()
    assert set(out) & set(HALF)
    plain, hand, everything = (
        Sequence("hand", capture, tracking, np.array(capture.mattes))
        for tracking in (truth, with_covered(truth, HALF), replace(truth, covered=torch.ones(40, 1, len(PARTS)) > 0))
    )
    trained = {frame.timestep for frame in training_frames([hand], settings)}
    assert trained == set(range(40)) - set(HALF) - set(out)
    scored = held_out_by_protocol([hand], settings)["self_reenactment"][1]
    assert [frame.timestep for frame in scored] == out
    assert training_frames([everything], settings) == training_frames([plain], settings)
