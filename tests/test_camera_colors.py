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


def colors_of(sequence: Sequence, settings: TrainSettings) -> CameraColors:
    return CameraColors([sequence], training_frames([sequence], settings), settings, torch.zeros(()))


def drawing(size: int = 8) -> Rendering:
    """Return a rendering over a grey background, with nothing in its left half."""
    random = torch.Generator().manual_seed(0)
    alpha = torch.rand(size, size, generator=random)
    alpha[:, : size // 2] = 0
    color = torch.rand(size, size, 3, generator=random)
    image = alpha[..., None] * color + (1 - alpha[..., None]) * torch.tensor([0.2, 0.5, 0.9])
    return Rendering(image, alpha, torch.zeros(1, dtype=torch.int32), torch.zeros(1, 2))


@pytest.mark.unchecked
@pytest.mark.parametrize("right", ["first", "mean"])
def test_the_gains_are_learned_and_the_background_stays(rig, right: str):
    settings = replace(SETTINGS, camera_colors=right, camera_color_rate=0.02)
    colors, shown, background = colors_of(rig[1], settings), drawing(), torch.tensor([0.2, 0.5, 0.9])
    foreground = shown.image - (1 - shown.alpha[..., None]) * background
    wanted = GAINS if right == "first" else GAINS / GAINS.mean(0)
    adam = Adam()
    for step in range(900):
        camera = step % 3
        truth = foreground * wanted[camera] + (1 - shown.alpha[..., None]) * background
        seen = colors.seen_by(shown, background, Frame(0, 0, camera))
        assert torch.equal(seen.image[:, :4], shown.image[:, :4]), "only the background is there"
        (seen.image - truth).abs().mean().backward()
        adam.step(colors.parameter_groups(), Progress(step, 900, 0))
    changes = colors.changes().detach()
    torch.testing.assert_close(changes[:, :, :3], torch.diag_embed(wanted - 1), atol=0.03, rtol=0)
    assert changes[:, :, 3].abs().max() < 0.02
    if right == "first":
        assert not changes[0].any(), "the first camera is right"
    else:
        assert changes.mean(0).abs().max() < 1e-6


def test_each_camera_has_one_map_in_all_sequences(rig):
    other = replace(
        rig[1], name="other", capture=replace(rig[1].capture, camera_ids=("c", "d", "a")),
    )  # fmt: skip
    sequences = [rig[1], other]
    settings = replace(SETTINGS, held_out_cameras=("b",))
    colors = CameraColors(sequences, training_frames(sequences, settings), settings, torch.zeros(()))
    assert colors.ids == ("a", "c", "d")
    with torch.no_grad():
        for name, tensor in colors.state().items():
            if name == "changes":
                tensor[1, 0, 3] = 0.25
    shown, background = drawing(), torch.tensor([0.2, 0.5, 0.9])
    places = (Frame(0, 0, 0), Frame(0, 0, 2), Frame(1, 0, 0), Frame(1, 0, 1), Frame(1, 0, 2))
    lifted = [
        float((colors.seen_by(shown, background, place).image.detach() - shown.image).max()) > 0.1 for place in places
    ]
    assert lifted == [False, True, True, False, False]


def test_one_camera_is_refused_before_anything_is_written(rig, tmp_path: Path):
    settings = replace(SETTINGS, held_out_cameras=("b", "c"))
    with pytest.raises(UserError, match=r"--training.camera-colors first: compares cameras, .* on a alone"):
        train([rig[1]], rig[0], plain_gaussian_avatars(), settings, tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.unchecked
def test_a_stopped_run_resumes_with_its_colors(rig, tmp_path: Path):
    """The same bytes result with and without a stop, and the colours have moved."""
    face_model, sequence = rig
    train([sequence], face_model, plain_gaussian_avatars(), SETTINGS, tmp_path / "whole")
    stopped = tmp_path / "stopped"
    train([sequence], face_model, plain_gaussian_avatars(), SETTINGS, stopped)
    checkpoint_files(stopped / "checkpoints")[-1].unlink()
    (stopped / "training.json").unlink()
    train([sequence], face_model, plain_gaussian_avatars(), SETTINGS, stopped)
    last = [checkpoint_files(folder / "checkpoints")[-1].name for folder in (tmp_path / "whole", stopped)]
    assert last[0] == last[1] == "step_0000008.safetensors"
    first, second = (read_tensors(folder / "checkpoints" / last[0]) for folder in (tmp_path / "whole", stopped))
    for name in ("colors.changes", "colors.changes.first", "colors.changes.second", "colors.changes.step"):
        assert torch.equal(first[name], second[name]), name
    assert first["colors.changes"].abs().max() > 1e-3
    assert torch.equal(first["avatar.store.trained.means"], second["avatar.store.trained.means"])


def test_without_the_option_nothing_is_stored(rig, tmp_path: Path):
    settings = replace(SETTINGS, camera_colors="none")
    parts = start([rig[1]], rig[0], plain_gaussian_avatars(), settings).parts
    assert "colors" not in [part.name for part in parts]
    train([rig[1]], rig[0], plain_gaussian_avatars(), settings, tmp_path / "run")
    names = read_tensors(checkpoint_files(tmp_path / "run" / "checkpoints")[-1]).keys()
    assert not [name for name in names if name.startswith("colors")]
