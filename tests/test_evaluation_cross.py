"""Cross-reenactment is measured on made-up landmarks, and from folders with a made-up detector."""

import contextlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from evaluation_case import make_experiment, two_cameras, write_run, write_sequence
from mien.cli import main
from mien.evaluation import cross
from mien.evaluation.cross import cross_reenactment, load_driven
from mien.evaluation.redetection import angle_degrees, measure_motion, transfer_figures
from mien.face.params import most_frontal_camera
from mien.media.video import probe_video
from mien.rotation import matrix_from_axis_angle
from mien.tracking import write_tracking
from plain_settings import plain_run
from refusals import refuses

pytestmark = [pytest.mark.unchecked, pytest.mark.usefixtures("short_films")]


def _face(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(478, 3)) * 50


def _turn(*axis_angle: float) -> np.ndarray:
    return matrix_from_axis_angle(torch.tensor(axis_angle, dtype=torch.float64)).numpy()


def test_head_pose_size_and_identity_do_not_count_as_expression() -> None:
    at_rest, rotation = _face(), _turn(0.0, 0.4, 0.0)
    moved = measure_motion(0.8 * at_rest @ rotation.T + 5, at_rest)
    assert np.abs(moved.displacement).max() < 1e-9
    np.testing.assert_allclose(moved.rotation, rotation, atol=1e-9)
    assert angle_degrees(moved.rotation) == pytest.approx(np.degrees(0.4))
    opened = at_rest.copy()
    opened[14, 1] += 10  # the lower lip
    unit = np.linalg.norm(at_rest[33] - at_rest[263])
    same_on_a_larger_face = measure_motion(3 * opened, 3 * at_rest)
    assert np.linalg.norm(same_on_a_larger_face.displacement, axis=1).max() == pytest.approx(10 / unit)


def test_figures_of_perfect_still_and_opposite_avatars() -> None:
    at_rest = _face()
    motions = []
    for step in range(6):
        points = at_rest.copy()
        points[14] += (at_rest[14] - at_rest[13]) * 0.2 * step
        motions.append(measure_motion(points @ _turn(0.0, 0.1 * step, 0.0).T, at_rest))
    perfect = transfer_figures([(one, one) for one in motions])
    assert perfect["expression_error"] == 0
    assert perfect["head_rotation_error_degrees"] == pytest.approx(0, abs=1e-5)
    assert perfect["mouth_correlation"] == pytest.approx(1)
    assert perfect["eyes_correlation"] is None, "eyes that never move correlate with nothing"
    still = transfer_figures([(one, motions[0]) for one in motions])
    assert still["expression_error"] == pytest.approx(still["expression_error_still"])
    assert still["head_rotation_error_degrees"] == pytest.approx(still["head_rotation_error_still_degrees"])
    opposite = transfer_figures(list(zip(motions, motions[::-1], strict=True)))
    assert opposite["mouth_correlation"] == pytest.approx(-1)


class _MadeUpReader(contextlib.nullcontext):
    """Detector whose landmarks turn with the brightness of the picture. It finds no face in white pictures."""

    def __enter__(self) -> "_MadeUpReader":
        return self

    def read(self, image: np.ndarray) -> np.ndarray:
        face = _face() @ _turn(0.0, float(image.mean()) / 255, 0.0).T
        return face[None][: int(image.min() < 255)]


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return a run, and a sequence of another workspace with two cameras."""
    root = tmp_path_factory.mktemp("cross")
    experiment = make_experiment(timesteps=10)
    own = write_sequence(root / "anna", experiment, experiment.sequences[0])
    settings = plain_run(steps=5, checkpoint_every=5, split="none")
    write_run(root / "anna" / "runs" / "first", experiment, [own], settings)
    other = make_experiment(timesteps=10, seed=1)
    return own, write_sequence(root / "bert", other, two_cameras(other, "talk"))


def test_protocol_from_folders(folders: tuple[Path, Path], monkeypatch, capsys) -> None:
    monkeypatch.setattr(cross, "MeshReader", lambda *_, **__: _MadeUpReader())
    own, driver = folders
    anna, bert = own.parent.parent, driver.parent.parent
    assert main(["evaluate", str(anna), "--no-perceptual", "--drivers", str(bert), str(own)]) == 0
    assert "cross_reenactment (2 drivers, 20 frames): expression error" in capsys.readouterr().err
    entry = json.loads((anna / "runs/first/metrics.json").read_text())["protocols"]["cross_reenactment"]
    assert [one["driver"] for one in entry["drivers"]] == ["bert_talk", "anna_clip"]
    assert entry["faces_found"] == 1.0
    assert entry["head_rotation_error_degrees"] == pytest.approx(
        np.mean([one["head_rotation_error_degrees"] for one in entry["drivers"]])
    )
    assert probe_video(anna / "runs/first/videos/cross_reenactment_bert_talk.mp4").frames == 10
    page = (anna / "runs/first/report.html").read_text()
    assert "Cross-reenactment" in page
    assert page.count("<video") == 2
    # The driven avatar keeps its identity, and moves from its own neutral face.
    driven = load_driven(own.parent.parent / "runs" / "first", own, driver)
    assert len(driven.faces) == 10
    torch.testing.assert_close(driven.faces.identity, driven.avatar.subject.identity)
    assert driven.driver_camera == 0, "the front camera looks at the face"
    moved = (driven.faces.head_rotation - driven.avatar.subject.head_rotation).norm(dim=1)
    assert moved[driven.by_rest[0]] < moved[driven.by_rest[-1]]
    assert most_frontal_camera(driven.tracking.cameras[::-1], driven.avatar.subject) == 1


def test_drivers_that_cannot_drive(folders: tuple[Path, Path], tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(cross, "MeshReader", lambda *_, **__: _MadeUpReader())
    monkeypatch.setattr(cross.Driven, "driver_picture", lambda self, timestep: np.full((8, 8, 3), 255, np.uint8))
    own, driver = folders
    run = own.parent.parent / "runs" / "first"
    refuses("no face is found in the driver's pictures", cross_reenactment, run, own, [driver], 0)
    seldom = lambda self, timestep: np.full((8, 8, 3), 255 if timestep % 2 else 90, np.uint8)  # noqa: E731
    monkeypatch.setattr(cross.Driven, "driver_picture", seldom)
    entry = cross_reenactment(run, own, [driver], 0)[0]
    assert (entry["faces_found"], entry["frames"]) == (1.0, 5), "where the driver has no face, none can be missed"
    tracking = replace(make_experiment(timesteps=10).sequences[0].tracking, face_model_hash="other")
    write_tracking(tmp_path / "sequences" / "x" / "tracking", tracking)
    refuses("track the driver with the avatar's", cross_reenactment, run, own, [tmp_path / "sequences" / "x"], 0)
