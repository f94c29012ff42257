"""Make an experiment in which the truth is an avatar's own rendering of a small head, and write it to disk."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from mien.avatar import Avatar
from mien.avatar.methods import DEFAULT_METHOD, METHODS
from mien.avatar.settings import FaceTuning
from mien.camera import Camera, camera_from_fov
from mien.capture import write_capture
from mien.capture.capture import Capture
from mien.capture.store import read_capture_hash
from mien.evaluation.experiment import Experiment
from mien.face import FaceParams
from mien.gaussians import sh_from_rgb
from mien.media.pictures import to_uint8
from mien.render import rasterize
from mien.render.camera_paths import orbit
from mien.tracking import write_tracking
from mien.tracking.scoring import Scoring
from mien.tracking.scoring_files import write_scoring
from mien.tracking.tracking import Tracking
from mien.training import TrainSettings, read_sequence, train
from mien.training.footage.frames import Frame, held_out
from mien.training.footage.sequence import Sequence
from mien.training.settings import Split
from plain_settings import plain_config
from small_face_model import make_small_face_model

SIZE = 72


def make_experiment(timesteps: int = 50, split: Split = "blocks", seed: int = 0) -> Experiment:
    """Return an experiment with a head that turns and moves its face. Every pixel that the avatar covers is scored."""
    torch.manual_seed(seed)
    face_model = make_small_face_model()
    face = _motion(face_model.neutral(timesteps))
    avatar = METHODS[DEFAULT_METHOD].avatar(plain_config(DEFAULT_METHOD), face_model, face)
    _paint(avatar)
    camera = camera_from_fov(0.6, SIZE, SIZE, torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])))
    sequence = drawn_sequence(avatar, face, camera)
    test = held_out(timesteps, split).tolist()
    frames = [Frame(0, t, 0) for t in range(timesteps)]
    crops = np.tile(np.array([16, 8, 40, 56], np.int64), (timesteps, 1, 1))
    return Experiment(
        avatar=avatar, sequences=(sequence,), faces=(face,), face_source="as_tracked",
        scorings=(Scoring(sequence.scoring, crops),),
        training_frames=tuple(f for f in frames if not test[f.timestep]),
        held_out_frames=tuple(f for f in frames if test[f.timestep]),
        split=split, edges="filmed",  # they hold no background
    )  # fmt: skip


def _motion(face: FaceParams) -> FaceParams:
    along = torch.linspace(0, 6.0, len(face))
    still = torch.zeros_like(along)
    return replace(
        face, expression=0.5 + 0.5 * torch.sin(along[:, None] + torch.arange(face.expression.shape[1])),
        head_rotation=torch.stack([0.1 * along.cos(), 0.4 * along.sin(), still], dim=-1),
        head_translation=torch.stack([0.01 * along.sin(), still, still - 0.5], dim=-1),
    )  # fmt: skip


def _paint(avatar: Avatar) -> None:
    """Make the Gaussians opaque and small, with colours that depend on the place on the head."""
    model, store = avatar.face_model, avatar.store
    middle = model.template[model.faces].mean(1)
    rgb = (middle / middle.abs().max() * 0.5 + 0.5).clamp(0.05, 0.95)
    with torch.no_grad():
        store["opacity_logits"].fill_(4.0)
        # Gaussians are thin along the triangle's normal, so that the outline is the mesh's.
        store["log_scales"].copy_(torch.tensor([-1.1, -4.0, -1.1]))
        store["sh_constant"].copy_(sh_from_rgb(rgb)[:, None])


def drawn_sequence(avatar: Avatar, face: FaceParams, *cameras: Camera, name: str = "clip") -> Sequence:
    """Return the pictures of an avatar as a sequence with exact tracking."""
    images = np.zeros((len(face), len(cameras), SIZE, SIZE, 3), np.uint8)
    alphas = np.zeros(images.shape[:-1], np.uint8)
    with torch.no_grad():
        for t, c in np.ndindex(images.shape[:2]):
            rendering = rasterize(avatar.pose(face[t]).gaussians.timestep(0), cameras[c], torch.zeros(3))
            alphas[t, c] = (rendering.alpha * 255).round().numpy()
            images[t, c] = to_uint8(rendering.image / rendering.alpha.clamp_min(1e-3)[..., None])
    capture = Capture(
        name=name, camera_ids=("0",) if len(cameras) == 1 else ("front", "side"), fps=25.0,
        timestamps=np.arange(len(face)) / 25.0, images=images, mattes=alphas,
        landmarks=np.zeros((*images.shape[:2], 478, 2), np.float32), valid=np.ones(images.shape[:2], bool),
        principal_point=np.full((len(cameras), 2), SIZE / 2), source={"file": f"{name}.mp4"},
    )  # fmt: skip
    tracking = Tracking(
        face_model="small", face_model_hash=avatar.face_model.content_hash, face=face, cameras=cameras,
        valid=torch.ones(len(face), dtype=torch.bool),
        neck_lines=torch.tensor([0.0, -1.0, 1000.0]).repeat(len(face), len(cameras), 1),
        residuals=torch.linspace(0.5, 2.0, len(face))[:, None].repeat(1, len(cameras)),
    )  # fmt: skip
    return Sequence(name, capture, tracking, alphas)


def two_cameras(experiment: Experiment, name: str) -> Sequence:
    """Return the experiment's sequence under another name, with a second camera that looks from the side."""
    (first,) = experiment.sequences[0].tracking.cameras
    side = orbit(first, torch.tensor([0.0, 0.0, -0.5]), 0.5)
    return drawn_sequence(experiment.avatar, experiment.faces[0], first, side, name=name)


def write_sequence(root: Path, experiment: Experiment, sequence: Sequence) -> Path:
    folder = root / "sequences" / sequence.name
    crops = np.repeat(experiment.scorings[0].crops, len(sequence.capture.camera_ids), axis=1)
    write_capture(folder / "capture", sequence.capture)
    write_tracking(folder / "tracking", sequence.tracking)
    scoring = replace(experiment.scorings[0], masks=sequence.scoring, crops=crops)
    write_scoring(folder / "scoring", scoring, read_capture_hash(folder / "capture"))
    return folder


def write_run(run_dir: Path, experiment: Experiment, folders: list[Path], settings: TrainSettings) -> None:
    config = plain_config(DEFAULT_METHOD, face_tuning=FaceTuning(enabled=False))
    train([read_sequence(folder) for folder in folders], experiment.avatar.face_model, config, settings, run_dir)
