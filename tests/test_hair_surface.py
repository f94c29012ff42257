"""The surface of hair rises and sinks as a whole where that lowers the loss. Limits and side views follow it."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from mien.avatar import SurfacePrior, method_named
from mien.avatar.gaussian_avatars.avatar import GaussianAvatars
from mien.face import FaceModel
from mien.face.head_parts import head_parts
from mien.face.mirror import triangle_geometry
from mien.training import PRESETS, Sequence, train
from mien.training.footage.frames import training_frames
from mien.training.parts import Preparation
from mien.training.trainer import start
from mien.training.whole_head.hair_surface import HairSurface, hair_surface
from mien.training.whole_head.part import prepare_whole_head
from plain_settings import plain_run
from toy_scene import surface_of, toy_sequence
from training_progress import stopped_at

_HAIR, _RATE = 0.02, 1e-3
CONFIG = PRESETS["draft"].config("gaussian_avatars")
SETTINGS = plain_run(steps=32, split="none", unseen="filled", checkpoint_every=12, record_every=8, side_weight=0.0)


def _avatar(model: FaceModel) -> GaussianAvatars:
    torch.manual_seed(0)
    avatar = method_named("gaussian_avatars").avatar(CONFIG, model, model.neutral(1))
    assert isinstance(avatar, GaussianAvatars)
    return avatar


def _prior(model: FaceModel) -> SurfacePrior:
    """Hair everywhere on the scalp. The back of the head is made up."""
    scalp = head_parts(model).scalp
    back = scalp & (model.template[model.faces].mean(1)[:, 2] < 0)
    colors = torch.full((len(model.faces), 3), 0.3)
    return SurfacePrior(_HAIR * scalp.float(), colors=colors, doubt=back.float(), filled_in=back)


def _surface(avatar: GaussianAvatars, prior: SurfacePrior) -> HairSurface:
    surface = hair_surface(avatar, prior)
    assert surface is not None
    return surface


def _pull(avatar: GaussianAvatars, surface: HairSurface, slope: float, rounds: int = 1) -> None:
    """Corrections by a loss that grows by `slope` with each metre that any Gaussian rises."""
    for _ in range(rounds):
        means = avatar.store["means"]
        means.grad = torch.zeros_like(means)
        means.grad[:, 1] = slope * surface_of(avatar).sizes[avatar.store["face_index"]]
        surface.collect(surface_of(avatar), 0.1)
        surface.correct(surface_of(avatar), 0.1, _RATE)


def test_the_gradient_of_the_height_is_that_of_the_posed_gaussians(anny):
    """A loss that is the centres' place along the normals has a slope of 1 a metre for each Gaussian."""
    avatar = _avatar(anny)
    face = anny.neutral(1)
    normals = triangle_geometry(anny.head_vertices(avatar.subject)[0], anny.faces)[2]
    means = avatar.pose(avatar.subject).gaussians.means.reshape(-1, 3)
    assert len(face) == 1
    (means * normals).sum().backward()
    gradient = surface_of(avatar).height_gradient()
    assert gradient is not None
    big = surface_of(avatar).sizes > 1e-3
    torch.testing.assert_close(gradient[big], torch.ones_like(gradient)[big], rtol=0.01, atol=0.01)


@pytest.mark.parametrize("slope", [1.0, -1.0])
def test_hair_moves_against_the_slope(anny, slope):
    avatar, prior = _avatar(anny), _prior(anny)
    surface = _surface(avatar, prior)
    before = avatar.store["means"].detach()[:, 1].clone()
    _pull(avatar, surface, slope, rounds=5)
    shift, scalp = surface.shift, head_parts(anny).scalp
    assert not shift[~scalp].any()
    front = scalp & ~(prior.filled_in if prior.filled_in is not None else scalp)
    assert (shift[front] * slope < -0.5 * _RATE).all()
    assert float((shift[front] * slope).median()) < -3 * _RATE
    moved = (avatar.store["means"].detach()[:, 1] - before) * surface_of(avatar).sizes
    torch.testing.assert_close(moved, shift, atol=1e-6, rtol=1e-4)
    torch.testing.assert_close(surface.prior().hair, (prior.hair + shift).clamp_min(0))
    # What no picture shows follows only what is beside it.
    behind = anny.template[anny.faces].mean(1)[:, 2]
    far, near = scalp & (behind < -0.06), scalp & (behind < -0.002) & (behind > -0.008)
    assert near.any()
    assert (shift[near] * slope < 0).all()
    assert not shift[far].any()


def test_pictures_that_disagree_move_little(anny):
    avatar, prior = _avatar(anny), _prior(anny)
    surface = _surface(avatar, prior)
    for turn in range(40):
        _pull(avatar, surface, 1.0 if turn % 2 else -1.0)
    assert float(surface.shift.abs().max()) < 3 * _RATE


def test_hair_sinks_to_the_skin_and_no_deeper(anny):
    avatar, prior = _avatar(anny), _prior(anny)
    surface = _surface(avatar, prior)
    _pull(avatar, surface, 1.0, rounds=60)
    assert float(surface.shift.min()) == pytest.approx(-_HAIR - 0.004, abs=1e-6)
    assert float(surface.prior().hair.min()) == 0


def test_outside_of_its_time_nothing_moves(anny):
    avatar, surface = _avatar(anny), _surface(_avatar(anny), _prior(anny))
    means = avatar.store["means"]
    for fraction, rate in ((0.01, _RATE), (0.7, _RATE), (0.2, 0.0)):
        means.grad = torch.ones_like(means)
        surface.collect(surface_of(avatar), 0.1)
        surface.correct(surface_of(avatar), fraction, rate)
        assert not surface.shift.any()
        assert not surface.state["gradient"].any()


def _toy_with_scalp() -> tuple[FaceModel, Sequence]:
    model, sequence = toy_sequence(timesteps=5, size=32)
    scalp = (model.template[model.faces].mean(1)[:, 1] > 0.04).long()
    return replace(model, region_names=("skin", "scalp"), face_regions=scalp), sequence


def test_limits_and_side_views_follow_the_hair():
    model, sequence = _toy_with_scalp()
    settings = replace(SETTINGS, side_weight=0.1)
    avatar = start([sequence], model, CONFIG, settings).avatar
    faces, frames = [sequence.tracking.face], training_frames([sequence], settings)
    make = prepare_whole_head(Preparation(avatar, model, [sequence], faces, frames, settings, torch.zeros(())))
    assert make is not None
    head = make()
    assert head.hair is not None
    assert head.side_views is not None
    height = head.side_views.height
    state = head.part().state()
    head.part().load_state(state | {"shift": state["shift"] + 0.01})
    scalp = head_parts(model).scalp
    torch.testing.assert_close(head.unseen.prior.hair[scalp], head.hair.start.hair[scalp] + 0.01)
    assert float(head.side_views.height.max()) > float(height.max())


@pytest.mark.unchecked
def test_a_filled_run_resumes_to_the_same_bytes(tmp_path: Path) -> None:
    """Half of a run and its continuation, with hair that moves in between."""
    model, sequence = _toy_with_scalp()

    def run(name: str, *progress: Any, **changes: Any) -> list[bytes]:
        train([sequence], model, CONFIG, replace(SETTINGS, **changes), tmp_path / name, *progress)
        return [
            (tmp_path / name / file).read_bytes() for file in ("avatar/avatar.safetensors", "face_track.safetensors")
        ]

    whole = run("whole")
    with pytest.raises(KeyboardInterrupt):
        run("halves", stopped_at(10))
    assert run("halves") == whole
    assert run("still", hair_rate=0.0)[0] != whole[0]
