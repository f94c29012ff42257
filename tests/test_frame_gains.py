"""Gains of timesteps in light that changes: found from training frames alone, learned, scored and aligned with."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from evaluation_case import make_experiment
from mien.avatar.schedules import Progress
from mien.capture import FrameQuality
from mien.evaluation.experiment import Experiment, avatar_image, target_image
from mien.evaluation.fitting import fit_face
from mien.evaluation.metrics import l1
from mien.render.rendering import Rendering
from mien.storage import read_tensors, write_tensors
from mien.training import AlignmentSettings, Sequence, TrainSettings, read_gains, train
from mien.training.adam import Adam
from mien.training.alignment import align_faces
from mien.training.footage import training_frames
from mien.training.frame_gains import FrameGains, frame_gains_part, lit
from plain_settings import plain_gaussian_avatars, plain_run
from refusals import refuses
from toy_scene import toy_sequence

SETTINGS = plain_run(steps=8, split="blocks", checkpoint_every=4, record_every=1)
BACKGROUND = torch.tensor([0.2, 0.5, 0.9])


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


def gains_of(sequence: Sequence, settings: TrainSettings = SETTINGS) -> FrameGains:
    return FrameGains([sequence], training_frames([sequence], settings), 5e-3, torch.zeros(()))


def drawing(light: np.ndarray) -> tuple[Rendering, torch.Tensor]:
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
    frames = training_frames([sequence], SETTINGS)
    wanted = truth / np.exp(np.log(truth[[frame.timestep for frame in frames]]).mean(0))
    for step in range(800):
        frame = frames[step * 7 % len(frames)]
        shown, picture = drawing(wanted[frame.timestep])
        seen = gains.seen_by(shown, BACKGROUND, frame)
        assert torch.equal(seen.image[0, 0], shown.image[0, 0]), "only the background is there"
        (seen.image - picture).abs().mean().backward()
        adam.step(gains.learned.parameter_groups(), Progress(step, 800, 0))
    known = [frame.timestep for frame in frames]
    np.testing.assert_allclose(gains.gains().detach()[known], wanted[known], rtol=0.03)


def test_pixels_of_held_out_timesteps_decide_nothing(tmp_path: Path):
    face_model, plain = toy_sequence(timesteps=50, size=16)
    sequence = in_light(plain, lamp(50))
    unknown = ~np.isin(np.arange(50), [frame.timestep for frame in training_frames([sequence], SETTINGS)])
    assert unknown.sum() == 10
    flash = np.where(unknown[:, None], 3.0, lamp(50))
    for name, one in (("a", sequence), ("b", in_light(plain, flash))):
        train([one], face_model, plain_gaussian_avatars(), SETTINGS, tmp_path / name)
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
    shown, picture = drawing(np.array([0.5, 1.0, 2.0]))
    assert torch.allclose(lit(shown, BACKGROUND, torch.tensor([0.5, 1.0, 2.0])).image, picture, atol=1e-6)


@pytest.mark.parametrize(
    ("factor", "light", "cameras", "has"),
    [(2.0, "auto", 1, True), (1.2, "auto", 1, False), (2.0, "steady", 1, False), (1.2, "changing", 1, True),
     (2.0, "auto", 2, False)],
)  # fmt: skip
def test_gains_are_there_where_the_light_changes(factor, light, cameras, has):
    one = in_light(toy_sequence(timesteps=20, size=16)[1], np.linspace(1 / factor, 1, 20)[:, None].repeat(3, 1))
    frames = training_frames([one], replace(SETTINGS, split="none"))
    sequence = replace(one, capture=replace(one.capture, camera_ids=tuple("ab"[:cameras])))
    part = frame_gains_part([sequence], frames, replace(SETTINGS, light=light), torch.zeros(()))
    assert (part is not None) == has


def test_a_run_in_steady_light_keeps_no_gains(tmp_path: Path):
    face_model, one = toy_sequence(timesteps=5, size=16)
    settings = replace(SETTINGS, split="none")
    for name, light in (("auto", "auto"), ("steady", "steady")):
        train([one], face_model, plain_gaussian_avatars(), replace(settings, light=light), tmp_path / name)
    names = [f"{name}/checkpoints/step_0000008.safetensors" for name in ("auto", "steady")]
    first, second = (read_tensors(tmp_path / name) for name in names)
    assert first.keys() == second.keys()
    assert first["avatar.store.trained.means"].equal(second["avatar.store.trained.means"])
    assert read_gains(tmp_path / "auto", [5]) == []


@pytest.mark.parametrize("found", [torch.ones(4, 3), torch.full((5, 3), float("nan")), torch.zeros(5, 3)])
def test_damaged_gains_are_refused(found: torch.Tensor, tmp_path: Path):
    write_tensors(tmp_path / "gains.safetensors", {"gains": found})
    refuses(r"gains.safetensors: does not hold gains of 5 timesteps", read_gains, tmp_path, [5])


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
