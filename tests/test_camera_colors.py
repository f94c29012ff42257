"""Colours that training sees: transforms of cameras, and the person's own at soft edges of the matte."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import train_toy
from mien.avatar.schedules import Progress
from mien.errors import UserError
from mien.face import FaceModel
from mien.render.rendering import Rendering
from mien.storage import read_tensors
from mien.training import Sequence, TrainSettings, train
from mien.training.adam import Adam
from mien.training.camera_colors import CameraColors
from mien.training.checkpoint import checkpoint_files
from mien.training.footage.foreground import foreground_colors, soft_colors, soft_pixels
from mien.training.footage.frames import Frame, training_frames
from mien.training.footage.sequence import Targets, composite
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
    images = np.concatenate([np.clip(capture.images * gain + 0.5, 0, 255) for gain in GAINS.numpy()], 1).astype(
        np.uint8
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
        adam.step(colors.learned.parameter_groups(), Progress(step, 900, 0))
    changes = colors.changes().detach()
    torch.testing.assert_close(changes[:, :, :3], torch.diag_embed(wanted - 1), atol=0.03, rtol=0)
    assert changes[:, :, 3].abs().max() < 0.02
    none, most = (changes[0], 0) if right == "first" else (changes.mean(0), 1e-6)
    assert none.abs().max() <= most


def test_each_camera_has_one_map_in_all_sequences(rig):
    other = replace(rig[1], name="other", capture=replace(rig[1].capture, camera_ids=("c", "d", "a")))
    colors, shown = colors_of(replace(SETTINGS, held_out_cameras=("b",)), rig[1], other), drawing()
    assert colors.ids == ("a", "c", "d")
    with torch.no_grad():
        colors.learned.state()["changes"][1, 0, 3] = 0.25
    places = (Frame(0, 0, 0), Frame(0, 0, 2), Frame(1, 0, 0), Frame(1, 0, 1), Frame(1, 0, 2))
    seen = [colors.seen_by(shown, BACKGROUND, place).image.detach() for place in places]
    assert [float((one - shown.image).max()) > 0.1 for one in seen] == [False, True, True, False, False]


def test_one_camera_is_refused_before_anything_is_written(rig, tmp_path: Path):
    settings = replace(SETTINGS, held_out_cameras=("b", "c"))
    with pytest.raises(UserError, match=r"--training.camera-colors first: compares cameras, .* on a alone"):
        train([rig[1]], rig[0], plain_gaussian_avatars(), settings, tmp_path / "run")
    assert not (tmp_path / "run").exists()
    # Without the option nothing is stored.
    parts = start([rig[1]], rig[0], plain_gaussian_avatars(), replace(SETTINGS, camera_colors="none")).parts
    assert "colors" not in [part.name for part in parts]


@pytest.mark.unchecked
def test_a_stopped_run_resumes_with_its_colors(rig, tmp_path: Path):
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


WALL = np.array([210.0, 220.0, 235.0])


def _filmed(side: int = 480, red: float = 150.0, band: slice = slice(None)) -> tuple[np.ndarray, np.ndarray]:
    """A disc with a soft rim of 8 pixels and a darker lower half, before a light wall; and its matte."""
    rows, columns = np.mgrid[:side, :side][:, band] - side / 2
    alpha = np.clip((0.3 * side - np.hypot(rows, columns)) / 8 + 0.5, 0, 1)
    matte = np.rint(alpha * 255).astype(np.uint8)
    share = matte[..., None] / 255.0
    return np.rint(share * _person(side, red)[band] + (1 - share) * WALL).astype(np.uint8), matte


def _person(side: int, red: float = 150.0) -> np.ndarray:
    return np.array([red, 90.0, 60.0]) - np.where(np.arange(side) > side / 2, 20.0, 0.0)[:, None, None]


def test_soft_edges_have_the_color_of_the_person_in_large_pictures_as_well() -> None:
    image, matte = _filmed()
    found = foreground_colors(image, matte)
    share, soft = matte[..., None] / 255.0, (matte > 0) & (matte < 252)
    for background in (0.0, 255.0):
        true = share * _person(480) + (1 - share) * background
        filmed, cleaned = (share * colors + (1 - share) * background for colors in (image, found))
        before, after = (np.abs(picture - true)[soft].mean() for picture in (filmed, cleaned))
        assert before > 10
        assert after < 0.15 * before
    # A window of 273 pixels holds a sum of colours that 32 bits do not.
    image, matte = _filmed(3000, 250.0, slice(1300, 1700))
    part = (slice(100, 300), slice(2300, 2500))
    share, soft = matte[part][..., None] / 255.0, soft_pixels(matte[part])
    error = np.abs(foreground_colors(image, matte)[part] - _person(3000, 250.0)[1400:1600]) * share
    assert error[soft].mean() < 3


@pytest.mark.parametrize("size", [(60, 44), (90, 300)])
def test_estimates_at_soft_pixels_alone_are_those_of_whole_pictures(size: tuple[int, int]) -> None:
    """Noise, with every kind of opacity beside every other, and with empty borders."""
    random = np.random.default_rng(3)
    image = random.integers(0, 256, (*size, 3)).astype(np.uint8)
    matte = random.choice(np.array([0, 1, 60, 128, 251, 252, 254, 255], np.uint8), size)
    matte[:7], matte[:, -5:], matte[20:40, 8:30] = 0, 255, 0
    expected, (place, colors) = foreground_colors(image, matte), soft_colors(image, matte)
    assert not foreground_colors(image, np.zeros_like(matte)).any()
    assert np.array_equal(place, np.flatnonzero(soft_pixels(matte)))
    assert np.array_equal(colors, expected.reshape(-1, 3)[place])


def counted(monkeypatch) -> list[int]:
    """Return a list that grows with each picture that training cleans."""
    cleaned: list[int] = []
    seam = "mien.training.footage.sequence.soft_colors"
    monkeypatch.setattr(seam, lambda *pictures: cleaned.append(1) or soft_colors(*pictures))
    return cleaned


def test_training_pictures_are_cleaned_with_the_capture_s_matte(monkeypatch) -> None:
    """The cut at the neck is no edge of the person; the scored mask only says what is shown."""
    _, sequence = toy_sequence(2, 32)
    cut = np.array(sequence.scoring)
    cut[:, :, 18:] //= 2
    sequence = replace(sequence, scoring=cut)
    background = np.array([10, 20, 30], np.uint8)
    image, matte = (np.array(part[1, 0]) for part in (sequence.capture.images, sequence.capture.mattes))
    assert soft_pixels(matte).any()
    expected = composite(foreground_colors(image, matte), cut[1, 0], background)
    cleaned = counted(monkeypatch)
    for keep in (True, False):
        targets = Targets(sequence, 0, cleaned=True)
        cleaned.clear()
        for _ in range(2):
            assert np.array_equal(targets.target(1, 0, background, keep=keep).picture.numpy(), expected)
        other = targets.target(1, 0, 255 - background, keep=keep).picture.numpy()
        assert np.array_equal(other, composite(foreground_colors(image, matte), cut[1, 0], 255 - background))
        assert len(cleaned) == (2 if keep else 1), "once for each kept picture, or once for all backgrounds"
    plain = Targets(sequence, 0).target(1, 0, background, keep=False).picture.numpy()
    assert np.array_equal(plain, composite(image, cut[1, 0], background))


@pytest.mark.unchecked
@pytest.mark.parametrize("edges", ["filmed", "cleaned"])
def test_training_reads_the_setting(edges, tmp_path: Path, monkeypatch) -> None:
    face_model, sequence = toy_sequence(6, 32)
    asked = counted(monkeypatch)
    train([sequence], face_model, train_toy.CONFIG, replace(train_toy.SETTINGS, edges=edges), tmp_path)
    assert bool(asked) == (edges == "cleaned")
