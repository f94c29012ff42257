"""Colours that training sees: of cameras, of timesteps in light that changes, and at soft edges of the matte."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import train_toy
from evaluation_case import make_experiment
from mien.avatar.settings import Progress
from mien.capture.quality import FrameQuality
from mien.disk.files import read_tensors, write_tensors
from mien.errors import UserError
from mien.evaluation.experiment import Experiment, avatar_image, target_image
from mien.evaluation.metrics import l1
from mien.evaluation.protocols import fit_face
from mien.face import FaceModel
from mien.gaussians import Rendering
from mien.training import TrainSettings, train
from mien.training.adam import Adam
from mien.training.alignment import align_faces
from mien.training.checkpoint import checkpoint_files
from mien.training.colors import CameraColors, FrameGains, frame_gains, lit, read_gains
from mien.training.footage.foreground import foreground_colors, soft_colors
from mien.training.footage.frames import Frame, training_frames
from mien.training.footage.sequence import Sequence, Targets, composite
from mien.training.settings import AlignmentSettings
from mien.training.trainer import start
from plain_settings import plain_gaussian_avatars, plain_run
from refusals import refuses
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
def test_the_gains_are_learned_and_the_background_stays(rig, right: str, monkeypatch):
    monkeypatch.setattr("mien.training.colors.COLOR_RATE", 0.02)
    colors = colors_of(replace(SETTINGS, camera_colors=right), rig[1])
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
    state = start([rig[1]], rig[0], plain_gaussian_avatars(), replace(SETTINGS, camera_colors="none"))
    assert state.camera_colors is None


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
    share, soft = matte[part][..., None] / 255.0, (matte[part] > 0) & (matte[part] < 252)
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
    assert np.array_equal(place, np.flatnonzero((matte > 0) & (matte < 252)))
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
    assert ((matte > 0) & (matte < 252)).any()
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


IN_BLOCKS = plain_run(steps=8, split="blocks", checkpoint_every=4, record_every=1)


def lamp(timesteps: int, color: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> np.ndarray:
    """Gains [t, 3] of light that swells and fades, by a factor of 2 and a little more in one colour."""
    wave = 0.5 * np.log(2) * np.sin(np.arange(timesteps) * 2 * np.pi / 50)
    return np.exp(wave[:, None] * np.array(color))


def in_light(sequence: Sequence, gains: np.ndarray) -> Sequence:
    """The sequence as it is filmed in light that changes, at 25 frames a second, with the brightness of its faces."""
    capture = sequence.capture
    images = np.rint(np.clip(0.4 * capture.images * gains[:, None, None, None], 0, 255)).astype(np.uint8)
    brightness = (0.3 * gains.mean(1, keepdims=True)).repeat(images.shape[1], 1).astype(np.float32)
    quality = FrameQuality(np.ones_like(brightness), brightness, np.zeros_like(brightness))
    times = np.arange(capture.timesteps) / 25
    return replace(sequence, capture=replace(capture, images=images, quality=quality, timestamps=times, fps=25.0))


def gains_of(sequence: Sequence, settings: TrainSettings = IN_BLOCKS) -> FrameGains:
    return FrameGains([sequence], training_frames([sequence], settings), torch.zeros(()))


def lit_drawing(light: np.ndarray) -> tuple[Rendering, torch.Tensor]:
    """A rendering with alpha, and its picture in some light."""
    alpha = torch.linspace(0, 1, 64).reshape(8, 8)
    behind = (1 - alpha[..., None]) * BACKGROUND
    own = alpha[..., None] * torch.linspace(0.3, 0.6, 192).reshape(8, 8, 3)
    shown = Rendering(own + behind, alpha, torch.zeros(1, dtype=torch.int32), torch.zeros(1, 2))
    return shown, own * torch.from_numpy(light).float() + behind


@pytest.mark.unchecked
def test_gains_are_learned_in_each_colour_and_the_background_stays():
    truth = lamp(50, (1.0, 1.1, 0.8))
    sequence = in_light(toy_sequence(timesteps=50, size=16)[1], truth)
    gains, adam = gains_of(sequence), Adam()
    frames = training_frames([sequence], IN_BLOCKS)
    wanted = truth / np.exp(np.log(truth[[frame.timestep for frame in frames]]).mean(0))
    for step in range(800):
        frame = frames[step * 7 % len(frames)]
        shown, picture = lit_drawing(wanted[frame.timestep])
        seen = gains.seen_by(shown, BACKGROUND, frame)
        assert torch.equal(seen.image[0, 0], shown.image[0, 0]), "only the background is there"
        (seen.image - picture).abs().mean().backward()
        adam.step(gains.learned.parameter_groups(), Progress(step, 800, 0))
    known = [frame.timestep for frame in frames]
    np.testing.assert_allclose(gains.gains().detach()[known], wanted[known], rtol=0.03)


def test_pixels_of_held_out_timesteps_decide_nothing(tmp_path: Path):
    face_model, plain = toy_sequence(timesteps=50, size=16)
    sequence = in_light(plain, lamp(50))
    unknown = ~np.isin(np.arange(50), [frame.timestep for frame in training_frames([sequence], IN_BLOCKS)])
    assert unknown.sum() == 10
    flash = np.where(unknown[:, None], 3.0, lamp(50))
    for name, one in (("a", sequence), ("b", in_light(plain, flash))):
        train([one], face_model, plain_gaussian_avatars(), IN_BLOCKS, tmp_path / name)
    for file in ("gains.safetensors", "avatar/avatar.safetensors"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()
    (gains,) = read_gains(tmp_path / "a", [50])
    np.testing.assert_allclose(gains[:40].log().mean(), 0, atol=1e-5)
    assert gains[40:].equal(gains[39:40].expand(10, 3)), "the light of the last timestep that is trained on"


def test_a_gain_keeps_the_background_and_gaps_are_filled_in_time():
    sequence = in_light(toy_sequence(timesteps=50, size=16)[1], np.exp(0.02 * np.arange(50.0))[:, None].repeat(3, 1))
    valid = sequence.capture.valid.copy()
    valid[20:30] = False
    gains = gains_of(replace(sequence, capture=replace(sequence.capture, valid=valid))).gains().detach()
    steps = gains[18:32, 0].log().diff()
    np.testing.assert_allclose(steps, steps.mean(), atol=5e-3)
    shown, picture = lit_drawing(np.array([0.5, 1.0, 2.0]))
    assert torch.allclose(lit(shown, BACKGROUND, torch.tensor([0.5, 1.0, 2.0])).image, picture, atol=1e-6)


@pytest.mark.parametrize(
    ("factor", "light", "cameras", "has"),
    [(2.0, "auto", 1, True), (1.2, "auto", 1, False), (2.0, "steady", 1, False), (1.2, "changing", 1, True),
     (2.0, "auto", 2, False)],
)  # fmt: skip
def test_gains_are_there_where_the_light_changes(factor, light, cameras, has):
    one = in_light(toy_sequence(timesteps=20, size=16)[1], np.linspace(1 / factor, 1, 20)[:, None].repeat(3, 1))
    frames = training_frames([one], replace(IN_BLOCKS, split="none"))
    sequence = replace(one, capture=replace(one.capture, camera_ids=tuple("ab"[:cameras])))
    gains = frame_gains([sequence], frames, replace(IN_BLOCKS, light=light), torch.zeros(()))
    assert (gains is not None) == has


def test_a_run_in_steady_light_keeps_no_gains(tmp_path: Path):
    face_model, one = toy_sequence(timesteps=5, size=16)
    settings = replace(IN_BLOCKS, split="none")
    for name, light in (("auto", "auto"), ("steady", "steady")):
        train([one], face_model, plain_gaussian_avatars(), replace(settings, light=light), tmp_path / name)
    names = [f"{name}/checkpoints/step_0000008.safetensors" for name in ("auto", "steady")]
    first, second = (read_tensors(tmp_path / name) for name in names)
    assert first.keys() == second.keys()
    assert first["avatar.store.trained.means"].equal(second["avatar.store.trained.means"])
    assert read_gains(tmp_path / "auto", [5]) == []


def test_gains_of_other_timesteps_are_refused(tmp_path: Path):
    write_tensors(tmp_path / "gains.safetensors", {"gains": torch.ones(4, 3)})
    refuses("gains.safetensors: incomplete or damaged", read_gains, tmp_path, [5])


def relit(experiment: Experiment, gain: torch.Tensor) -> Experiment:
    """The experiment, filmed in other light: the pictures are the avatar's own times a gain."""
    whole = experiment.sequences[0]
    images = np.rint(np.clip(whole.capture.images * gain.numpy(), 0, 255)).astype(np.uint8)
    sequence = replace(whole, capture=replace(whole.capture, images=images))
    return replace(experiment, sequences=(sequence,), gains=(gain.expand(whole.capture.timesteps, 3),))


@pytest.mark.unchecked
def test_scores_and_alignment_draw_in_the_light_of_the_frame():
    gain = torch.tensor([0.5, 0.7, 0.9])
    experiment = relit(make_experiment(10), gain)
    frame, truth = experiment.held_out_frames[0], experiment.faces[0]
    for background in ((255, 255, 255), (26, 32, 80)):
        target = target_image(experiment, frame, background)
        assert l1(avatar_image(experiment, frame, background=background), target) < 0.01
        assert l1(avatar_image(replace(experiment, gains=()), frame, background=background), target) > 0.03
    known, how = list(experiment.training_frames), AlignmentSettings(resolution=72, iterations=5)
    for found in (
        align_faces(experiment.avatar, experiment.sequences, [truth], known, how, gains=experiment.gains)[0],
        fit_face(experiment, [frame], 5),
    ):
        own = found[frame.timestep] if len(found) > 1 else found
        assert (own.head_rotation - truth[frame.timestep].head_rotation).abs().max() < 0.01
