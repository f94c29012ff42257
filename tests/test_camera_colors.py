"""Colour transforms of cameras: they learn how cameras differ, change no background, and resume with the run."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mien.avatar.schedules import Progress
from mien.errors import UserError
from mien.face import FaceModel
from mien.render.rendering import Rendering
from mien.storage import read_tensors
from mien.training import Sequence, TrainSettings, train
from mien.training.adam import Adam
from mien.training.camera_colors import CameraColors
from mien.training.checkpoint import checkpoint_files
from mien.training.footage.frames import Frame, training_frames
from mien.training.trainer import start
from plain_settings import plain_gaussian_avatars, plain_run
from toy_scene import toy_sequence

SETTINGS = plain_run(steps=8, split="none", camera_colors="first", checkpoint_every=4, record_every=1)
GAINS = torch.tensor([[1.0, 1.0, 1.0], [0.8, 1.0, 1.1], [1.2, 0.9, 1.0]])


@pytest.fixture(scope="module")
def rig() -> tuple[FaceModel, Sequence]:
    """Return the toy sequence as three cameras in one place, whose pictures differ by gains."""
    face_model, one = toy_sequence(timesteps=4, size=32)
    capture = one.capture
    images = np.concatenate(
        [np.clip(capture.images * gain.numpy() + 0.5, 0, 255).astype(np.uint8) for gain in GAINS], 1
    )
    capture = replace(
        capture, camera_ids=("a", "b", "c"), images=images, mattes=capture.mattes.repeat(3, 1),
        landmarks=capture.landmarks.repeat(3, 1), valid=capture.valid.repeat(3, 1),
        principal_point=capture.principal_point.repeat(3, 0), calibration=one.tracking.cameras * 3,
    )  # fmt: skip
    tracking = replace(
        one.tracking, cameras=one.tracking.cameras * 3, neck_lines=one.tracking.neck_lines.repeat(1, 3, 1),
        residuals=one.tracking.residuals.repeat(1, 3),
    )  # fmt: skip
    return face_model, Sequence("toy", capture, tracking, one.scoring.repeat(3, 1))


def colors_of(settings: TrainSettings, *sequences: Sequence) -> CameraColors:
    return CameraColors(sequences, training_frames(sequences, settings), settings, torch.zeros(()))


BACKGROUND = torch.tensor([0.2, 0.5, 0.9])


def drawing(size: int = 8) -> Rendering:
    """Return a rendering over a background, with nothing in its left half."""
    random = torch.Generator().manual_seed(0)
    alpha = torch.rand(size, size, generator=random)
    alpha[:, : size // 2] = 0
    image = alpha[..., None] * torch.rand(size, size, 3, generator=random) + (1 - alpha[..., None]) * BACKGROUND
    return Rendering(image, alpha, torch.zeros(1, dtype=torch.int32), torch.zeros(1, 2))


@pytest.mark.unchecked
@pytest.mark.parametrize("right", ["first", "mean"])
def test_the_gains_are_learned_and_the_background_stays(rig, right: str):
    colors = colors_of(replace(SETTINGS, camera_colors=right, camera_color_rate=0.02), rig[1])
    shown, adam = drawing(), Adam()
    behind = (1 - shown.alpha[..., None]) * BACKGROUND
    wanted = GAINS if right == "first" else GAINS / GAINS.mean(0)
    for step in range(900):
        seen = colors.seen_by(shown, BACKGROUND, Frame(0, 0, step % 3))
        assert torch.equal(seen.image[:, :4], shown.image[:, :4]), "only the background is there"
        (seen.image - (shown.image - behind) * wanted[step % 3] - behind).abs().mean().backward()
        adam.step(colors.parameter_groups(), Progress(step, 900, 0))
    changes = colors.changes().detach()
    torch.testing.assert_close(changes[:, :, :3], torch.diag_embed(wanted - 1), atol=0.03, rtol=0)
    assert changes[:, :, 3].abs().max() < 0.02
    assert (changes[0] if right == "first" else changes.mean(0)).abs().max() < (1e-9 if right == "first" else 1e-6)


def test_each_camera_has_one_map_in_all_sequences(rig):
    other = replace(rig[1], name="other", capture=replace(rig[1].capture, camera_ids=("c", "d", "a")))
    colors, shown = colors_of(replace(SETTINGS, held_out_cameras=("b",)), rig[1], other), drawing()
    assert colors.ids == ("a", "c", "d")
    with torch.no_grad():
        colors.state()["changes"][1, 0, 3] = 0.25
    places = (Frame(0, 0, 0), Frame(0, 0, 2), Frame(1, 0, 0), Frame(1, 0, 1), Frame(1, 0, 2))
    seen = [colors.seen_by(shown, BACKGROUND, place).image.detach() for place in places]
    assert [float((one - shown.image).max()) > 0.1 for one in seen] == [False, True, True, False, False]


def test_one_camera_is_refused_before_anything_is_written(rig, tmp_path: Path):
    settings = replace(SETTINGS, held_out_cameras=("b", "c"))
    with pytest.raises(UserError, match=r"--training.camera-colors first: compares cameras, .* on a alone"):
        train([rig[1]], rig[0], plain_gaussian_avatars(), settings, tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.unchecked
def test_a_stopped_run_resumes_with_its_colors(rig, tmp_path: Path):
    """The same bytes result with and without a stop, and the colours have moved."""
    whole, stopped = tmp_path / "whole", tmp_path / "stopped"
    for folder in (whole, stopped):
        train([rig[1]], rig[0], plain_gaussian_avatars(), SETTINGS, folder)
    checkpoint_files(stopped / "checkpoints")[-1].unlink()
    (stopped / "training.json").unlink()
    train([rig[1]], rig[0], plain_gaussian_avatars(), SETTINGS, stopped)
    first, second = (read_tensors(each / "checkpoints/step_0000008.safetensors") for each in (whole, stopped))
    changes = [f"colors.changes{part}" for part in ("", ".first", ".second", ".step")]
    for name in (*changes, "avatar.store.trained.means"):
        assert torch.equal(first[name], second[name]), name
    assert first["colors.changes"].abs().max() > 1e-3


def test_without_the_option_nothing_is_stored(rig):
    parts = start([rig[1]], rig[0], plain_gaussian_avatars(), replace(SETTINGS, camera_colors="none")).parts
    assert "colors" not in [part.name for part in parts]
