"""Lids are put where pictures show them, and frames in which something covers a part of the face."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from known import known
from mien.camera import Camera
from mien.capture.capture import Capture
from mien.evaluation.load import held_out_by_protocol
from mien.face import FaceModel, load_face_model
from mien.lab.synthetic import synthesize
from mien.lab.synthetic.recipe import SyntheticRecipe
from mien.lab.synthetic.scene import SyntheticScene
from mien.render.mesh import rasterize_mesh
from mien.tracking import read_tracking, write_tracking
from mien.tracking.fitting.fit import Fit, SequenceFit
from mien.tracking.fitting.parameters import layout_of
from mien.tracking.fitting.sequence import SequenceData, sequence_data
from mien.tracking.fitting.views import CameraBatch, Views, batch_of
from mien.tracking.landmarks.groups import LEFT_EYELIDS, RIGHT_EYELIDS
from mien.tracking.landmarks.model import LandmarkModel, reduce_face_model
from mien.tracking.landmarks.term import unknown_subject
from mien.tracking.pixels.covered import covered_parts, the_face, usual_look
from mien.tracking.pixels.eyelids import place_lids, weigh_positions
from mien.tracking.pixels.eyes import eyes_of
from mien.tracking.report.page import findings
from mien.tracking.report.residuals import residual_report
from mien.tracking.settings import TrackingSettings
from mien.tracking.tracking import PARTS, Tracking
from mien.training import TrainSettings
from mien.training.footage.frames import held_out, training_frames
from mien.training.footage.sequence import Sequence
from small_face_model import make_small_face_model
from tracking_case import capture_of

SKIN, WHITE, IRIS = (0.72, 0.5, 0.42), (0.9, 0.88, 0.86), (0.2, 0.22, 0.3)
LIDS = ("eyeBlinkRight", "eyeBlinkLeft")
_SHARPER = 3


class BlinkCase:
    """A head that looks at the camera and nods a little; `pictures` draws it."""

    def __init__(self) -> None:
        self.model: FaceModel = load_face_model("anny")
        self.reduced: LandmarkModel = reduce_face_model(self.model, layout_of(self.model))
        self.columns = [self.reduced.layout.names.index(name) for name in LIDS]

    def states(self, lids: np.ndarray) -> Tensor:
        """Return parameters with these lids, [t, 2], right before left."""
        state = torch.zeros(len(lids), self.reduced.layout.size, dtype=torch.float64)
        state[:, 0] = 0.05 * torch.arange(len(lids)).sin()
        state[:, 1] = 0.1 * (0.7 * torch.arange(len(lids))).sin()
        state[:, 4], state[:, 5] = -0.02, -0.7
        state[:, self.columns] = torch.from_numpy(lids)
        return state

    def shot(self, lids: np.ndarray, size: int = 192, white: tuple[float, float, float] = WHITE) -> SequenceData:
        """Return a clip in which the lids are as given. `white` is the colour of the eyeballs."""
        camera = _camera(size)
        face = self.reduced.layout.face_params(self.states(lids), unknown_subject(self.reduced).identity)
        vertices = self.model(face.to(torch.zeros(())))
        images = np.stack([self._draw(mesh, camera, white, seed) for seed, mesh in enumerate(vertices)])
        marks = camera.project(self.model.landmark_positions(vertices, "mediapipe"))[0]
        capture = replace(
            capture_of(marks), images=images[:, None], mattes=np.full((len(lids), 1, size, size), 255, np.uint8),
            principal_point=np.full((1, 2), size / 2, np.float32),
        )  # fmt: skip
        return sequence_data(capture, TrackingSettings())

    def fit(self, lids: np.ndarray, size: int = 192) -> Fit:
        own = SequenceFit(batch_of((_camera(size),)), self.states(lids))
        return Fit(unknown_subject(self.reduced), (own,))

    def lids_of(self, fit: Fit) -> np.ndarray:
        return fit.sequences[0].state[:, self.columns].numpy()

    def _draw(self, vertices: Tensor, camera: Camera, white: tuple[float, float, float], seed: int) -> np.ndarray:
        model = self.model
        seen = rasterize_mesh(vertices, model.faces, camera.resized(*(2 * [_SHARPER * camera.width]))).face_index.long()
        colors = torch.tensor(SKIN).repeat(len(model.faces), 1)
        colors[model.region_mask("eyes")] = torch.tensor(white)
        colors[model.region_mask("irises")] = torch.tensor(IRIS if white == WHITE else white)
        shading = 0.8 + 4 * model.template[model.faces].mean(1)[:, :1]  # light from one side
        colors = torch.cat([colors * shading, torch.tensor([[0.3, 0.3, 0.3]])])
        image = colors[seen].reshape(camera.height, _SHARPER, camera.width, _SHARPER, 3).mean((1, 3))
        noise = 0.02 * torch.randn(image.shape, generator=torch.Generator().manual_seed(seed))
        return ((image + noise).clamp(0, 1) * 255).round().to(torch.uint8).numpy()


def _camera(size: int) -> Camera:
    K = torch.tensor([[4 * size, 0, size / 2], [0, 4 * size, size / 2], [0, 0, 1]])
    return Camera(K, torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])), size, size)


_MOUTH, _EYES, _FOREHEAD = (61, 291, 0, 17), (33, 263), 151


def with_hand(capture: Capture, frames: list[int]) -> Capture:
    """The capture with a moving hand of the colour of the person's forehead in front of the mouth in some frames."""
    images, mattes = np.array(capture.images), np.array(capture.mattes)
    for timestep in frames:
        marks = capture.landmarks[timestep, 0]
        hand, shade = _hand(marks, timestep, images.shape[2:4])
        x, y = marks[_FOREHEAD].round().astype(int)
        skin = images[timestep, 0, y - 2 : y + 3, x - 2 : x + 3].reshape(-1, 3).mean(0)
        random = np.random.default_rng(timestep)
        drawn = skin * shade[..., None] + random.normal(0, 1.5, (*shade.shape, 3))
        share = hand[..., None]
        mixed = images[timestep, 0] * (1 - share) + drawn * share
        images[timestep, 0] = mixed.clip(0, 255).round().astype(np.uint8)
        mattes[timestep, 0] = np.maximum(mattes[timestep, 0], (255 * hand).astype(np.uint8))
    return replace(capture, images=images, mattes=mattes)


def with_slab(capture: Capture, frames: list[int], group: tuple[int, ...]) -> Capture:
    """The capture with a dark slab, such as a phone, in front of some landmarks in some frames."""
    images = np.array(capture.images)
    for timestep in frames:
        marks = capture.landmarks[timestep, 0]
        unit = float(np.linalg.norm(marks[_EYES[0]] - marks[_EYES[1]]))
        x, y = marks[list(group)].mean(0) + 0.1 * unit * np.sin(0.3 * timestep + np.array([0, 1]))
        wide, high = 0.75 * unit, 0.45 * unit
        columns, rows = slice(round(x - wide), round(x + wide)), slice(round(y - high), round(y + high))
        images[timestep, 0, rows, columns] = (38, 40, 46)
    return replace(capture, images=images)


def _hand(marks: np.ndarray, timestep: int, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """The opacity of a hand that moves, and its brightness relative to the skin: fingers with dark rims."""
    unit = float(np.linalg.norm(marks[_EYES[0]] - marks[_EYES[1]]))
    sway, angle = np.sin([0.31 * timestep, 0.23 * timestep + 1]) * (0.10, 0.06), 0.25 * np.sin(0.17 * timestep)
    x, y = marks[list(_MOUTH)].mean(0) + unit * sway
    rows, columns = np.mgrid[: size[0], : size[1]].astype(np.float32)
    across = ((columns - x) * np.cos(angle) - (rows - y) * np.sin(angle)) / unit
    down = ((columns - x) * np.sin(angle) + (rows - y) * np.cos(angle)) / unit - 0.4
    hand = np.clip(20 * (1 - np.hypot(across / 0.6, down)), 0, 1)
    return hand, 0.9 + 0.1 * np.cos(2 * np.pi * across / 0.28) - 0.1 * down


TIMESTEPS = 24
POSITIONS = np.linspace(-0.4, 1.2, 13)


case = pytest.fixture(scope="module")(lambda: BlinkCase())
STILL = np.full((TIMESTEPS, 2), 0.1)
BLINKS = STILL.copy()
"""Both eyes blink for three frames, and the left one alone for one frame."""
BLINKS[7:10] = np.array([0.6, 1.0, 0.7])[:, None]
BLINKS[16, 1] = 1.0


blinking = pytest.fixture(scope="module")(lambda case: case.shot(BLINKS))


def place(case: BlinkCase, shot: SequenceData, tracked: np.ndarray) -> np.ndarray:
    """Return the lids that are placed, after a look that nothing but lids has moved."""
    before = case.fit(tracked)
    after = place_lids(case.reduced, [shot], before, 1.0)
    others = torch.ones(case.reduced.layout.size, dtype=torch.bool)
    others[case.columns] = False
    assert torch.equal(after.sequences[0].state[:, others], before.sequences[0].state[:, others])
    return case.lids_of(after)


def test_blinks_that_landmarks_missed_are_found_in_pictures(case, blinking, monkeypatch):
    monkeypatch.setenv("MIEN_THREADS", "1")
    found = place(case, blinking, 0.1 + 0.4 * (BLINKS - 0.1))
    np.testing.assert_allclose(found[BLINKS > 0.5], BLINKS[BLINKS > 0.5], atol=0.15)
    # A wink closes only one eye, and open eyes stay open.
    np.testing.assert_allclose(found[BLINKS < 0.5], 0.1, atol=0.05)
    monkeypatch.setenv("MIEN_THREADS", "3")
    np.testing.assert_array_equal(place(case, blinking, 0.1 + 0.4 * (BLINKS - 0.1)), found)


@pytest.mark.unchecked
def test_blinks_that_never_were_are_opened_and_nobody_blinks_where_nobody_does(case):
    shot, false = case.shot(STILL), STILL.copy()
    false[11] = 0.7
    np.testing.assert_allclose(place(case, shot, false), 0.1, atol=0.1)
    tracked = STILL + 0.03 * np.random.default_rng(0).standard_normal((TIMESTEPS, 2))
    assert np.abs(place(case, shot, tracked) - 0.1).max() < np.abs(tracked - 0.1).max() + 0.01


@pytest.mark.unchecked
@pytest.mark.parametrize(("size", "white", "weight", "most"), [
    pytest.param(192, WHITE, 0.0, 0, id="no weight"),
    pytest.param(40, WHITE, 1.0, 0, id="too small"),
    pytest.param(192, SKIN, 1.0, 0.05, id="eyes like skin"),
])  # fmt: skip
def test_what_pictures_do_not_show_stays_as_tracked(case, size, white, weight, most):
    found = place_lids(case.reduced, [case.shot(BLINKS, size, white=white)], case.fit(STILL, size), weight)
    np.testing.assert_allclose(case.lids_of(found), STILL, atol=most)


@pytest.mark.unchecked
def test_of_several_cameras_the_one_that_an_eye_faces_tells(case, blinking):
    tracked, one = case.fit(STILL), blinking.capture
    cameras = tracked.sequences[0].cameras
    side = cameras.viewmat[0].clone()
    side[:3, 3] += torch.tensor([0.5, 0.0, 0.0])  # sees the head from 35 degrees to the side
    cameras = CameraBatch(cameras.K.repeat(2, 1, 1), torch.stack([cameras.viewmat[0], side]))
    both = {name: np.repeat(getattr(one, name), 2, axis=1) for name in ("mattes", "landmarks", "valid")}
    capture = replace(
        one, **both, camera_ids=("front", "side"), principal_point=np.repeat(one.principal_point, 2, axis=0),
        images=np.concatenate([one.images, np.full_like(one.images, 128)], axis=1),
    )  # fmt: skip
    picture, detected = torch.arange(2 * TIMESTEPS), blinking.views.detected.repeat_interleave(2, 0)
    views = Views(detected, picture // 2, picture % 2, torch.ones(len(picture), dtype=torch.float64))
    shot, own = replace(blinking, views=views, capture=capture), replace(tracked.sequences[0], cameras=cameras)
    found = place_lids(case.reduced, [shot], replace(tracked, sequences=(own,)), 1.0)
    np.testing.assert_allclose(case.lids_of(found), BLINKS, atol=0.2)


def test_eyes_have_their_own_closing_coefficient(case):
    layout = layout_of(case.model)
    eyes = eyes_of(case.model, layout)
    assert [layout.names[eye.column] for eye in eyes] == ["eyeBlinkRight", "eyeBlinkLeft"]
    assert all(eye.closed == pytest.approx(1.0, abs=0.05) for eye in eyes)
    assert all(eye.forward[2] > 0.9 for eye in eyes)
    names = [name.replace("eyes", "x").replace("irises", "y") for name in case.model.region_names]
    for blind in (make_small_face_model(), replace(case.model, region_names=tuple(names))):
        assert eyes_of(blind, layout_of(blind)) == []


def at(places: dict[int, float], otherwise: float = 0.1) -> np.ndarray:
    """Return fifty positions of a lid that are alike but at some frames."""
    positions = np.full(50, otherwise)
    positions[list(places)] = list(places.values())
    return positions


TREMBLING = 0.1 + 0.02 * np.random.default_rng(0).standard_normal(50)
ANYWHERE = np.random.default_rng(0).uniform(0.0, 1.0, 50)
BLINK = {20: 0.5, 21: 1.0, 22: 0.5}


@pytest.mark.parametrize(("tracked", "seen", "expected", "tolerance"), [
    pytest.param(TREMBLING, TREMBLING, TREMBLING, 0.02, id="colours that agree change little"),
    pytest.param(at({}), at(BLINK), at(BLINK), 0.05, id="a few frames that disagree follow the colours"),
    pytest.param(at({}), ANYWHERE, at({}), 0.05, id="colours that contradict every frame count for nothing"),
    pytest.param(at({30: 0.5}, 0.2), at({30: 1.0}), at({30: 0.97}, 0.2), 0.02, id="too open but where lids meet"),
    pytest.param(at({}), at({10: -2.0}), at({}), 0.01, id="opener than any is left alone"),
])  # fmt: skip
def test_positions_are_weighed(tracked: np.ndarray, seen: np.ndarray, expected: np.ndarray, tolerance: float):
    bowls = 400.0 * (POSITIONS - seen[:, None]) ** 2
    np.testing.assert_allclose(weigh_positions(bowls, tracked, 1.0), expected, atol=tolerance)


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
    assert (found["eyes"], found["mouth"]) == (HALF, [])


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
    assert not covered_parts(replace(shown, fps=shown.fps / stride, **pictures), tracking, model).any()


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
