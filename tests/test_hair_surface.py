"""The surface of hair follows the loss, hidden Gaussians close it, and what no picture shows gets sane colours."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from flame_like import exact_landmarks, flame_like, write_npz
from known import known
from mien.avatar.bound_surface import SurfacePrior
from mien.avatar.gaussian_avatars.avatar import GaussianAvatars
from mien.avatar.methods import method_named
from mien.avatar.ops.triangle_frames import triangle_ellipses
from mien.camera import Camera, camera_from_fov
from mien.face import FaceModel, FaceParams
from mien.face.head_parts import head_parts
from mien.face.mirror import mirror_triangles
from mien.face.models.flame import flame_face_model, read_flame
from mien.gaussians import sh_from_rgb
from mien.render import rasterize
from mien.tracking.landmarks.regions import with_regions_by_landmarks
from mien.training import PRESETS, train
from mien.training.footage.coverage import triangle_views
from mien.training.footage.frames import Footage, training_frames
from mien.training.footage.sequence import Sequence
from mien.training.trainer import start
from mien.training.whole_head.completion import complete_colors, vertex_means
from mien.training.whole_head.contribution import contributions, prune_hidden
from mien.training.whole_head.hair_surface import HairSurface, hair_surface
from mien.training.whole_head.head import prepare_whole_head
from mien.training.whole_head.unseen import Unseen
from plain_settings import plain_run
from test_training_batch import RESULTS
from toy_scene import rgb_from_sh, surface_of, toy_sequence
from train_toy import stopped_at

_HAIR, _RATE = 0.02, 1e-3
CONFIG = PRESETS["draft"].config("gaussian_avatars")
SETTINGS = plain_run(steps=32, split="none", unseen="filled", checkpoint_every=12, record_every=8, side_weight=0.0)


def _avatar(model: FaceModel) -> GaussianAvatars:
    torch.manual_seed(0)
    avatar = method_named("gaussian_avatars").avatar(CONFIG, model, model.neutral(1))
    assert isinstance(avatar, GaussianAvatars)
    return avatar


def _with_surface(model: FaceModel) -> tuple[GaussianAvatars, SurfacePrior, HairSurface]:
    """Hair everywhere on the scalp. The back of the head is made up."""
    scalp, avatar = head_parts(model).scalp, _avatar(model)
    back = scalp & (model.template[model.faces].mean(1)[:, 2] < 0)
    colors = torch.full((len(model.faces), 3), 0.3)
    prior = SurfacePrior(_HAIR * scalp.float(), colors=colors, doubt=back.float(), filled_in=back)
    return avatar, prior, known(hair_surface(avatar, prior))


def _pull(avatar: GaussianAvatars, surface: HairSurface, slope: float, rounds: int = 1) -> None:
    """Corrections by a loss that grows by `slope` with each metre that any Gaussian rises."""
    for _ in range(rounds):
        means = avatar.store["means"]
        means.grad = torch.zeros_like(means)
        means.grad[:, 1] = slope * surface_of(avatar).sizes[avatar.store["face_index"]]
        surface.collect(surface_of(avatar), 0.1)
        surface.correct(surface_of(avatar), 0.1, _RATE)


@pytest.mark.parametrize("slope", [1.0, -1.0])
def test_hair_moves_against_the_slope(anny, slope):
    avatar, prior, surface = _with_surface(anny)
    before = avatar.store["means"].detach()[:, 1].clone()
    _pull(avatar, surface, slope, rounds=5)
    shift, scalp = surface.shift, head_parts(anny).scalp
    assert not shift[~scalp].any()
    front = scalp & ~known(prior.filled_in)
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


def test_pictures_that_disagree_move_little_and_hair_sinks_to_the_skin(anny):
    avatar, _, surface = _with_surface(anny)
    means = avatar.store["means"]
    for fraction, rate in ((0.01, _RATE), (0.7, _RATE), (0.2, 0.0)):  # outside of its time, nothing moves
        means.grad = torch.ones_like(means)
        surface.collect(surface_of(avatar), 0.1)
        surface.correct(surface_of(avatar), fraction, rate)
        assert not surface.shift.any()
        assert not surface.state["gradient"].any()
    for turn in range(40):
        _pull(avatar, surface, 1.0 if turn % 2 else -1.0)
    assert float(surface.shift.abs().max()) < 3 * _RATE
    _pull(avatar, surface, 1.0, rounds=60)
    assert float(surface.shift.min()) == pytest.approx(-_HAIR - 0.004, abs=1e-6)
    assert float(surface.prior().hair.min()) == 0


def _toy_with_scalp() -> tuple[FaceModel, Sequence]:
    model, sequence = toy_sequence(timesteps=5, size=32)
    scalp = (model.template[model.faces].mean(1)[:, 1] > 0.04).long()
    return replace(model, region_names=("skin", "scalp"), face_regions=scalp), sequence


def test_limits_and_side_views_follow_the_hair():
    model, sequence = _toy_with_scalp()
    settings = replace(SETTINGS, side_weight=0.1)
    avatar = start([sequence], model, CONFIG, settings).avatar
    footage = Footage(model, [sequence], [sequence.tracking.face], training_frames([sequence], settings))
    head = known(prepare_whole_head(avatar, footage, settings))(torch.zeros(()))
    height, scalp, state = known(head.side_views).height, head_parts(model).scalp, head.state()
    head.load_state(state | {"shift": state["shift"] + 0.01})
    torch.testing.assert_close(known(head.unseen).prior.hair[scalp], known(head.hair).start.hair[scalp] + 0.01)
    assert float(known(head.side_views).height.max()) > float(height.max())


@pytest.mark.unchecked
def test_a_filled_run_resumes_to_the_same_bytes(tmp_path: Path) -> None:
    model, sequence = _toy_with_scalp()

    def run(name: str, *progress: Any, **changes: Any) -> list[bytes]:
        train([sequence], model, CONFIG, replace(SETTINGS, **changes), tmp_path / name, *progress)
        return [(tmp_path / name / file).read_bytes() for file in RESULTS]

    whole = run("whole")
    pytest.raises(KeyboardInterrupt, run, "halves", stopped_at(10))
    assert run("halves") == whole
    assert run("still", hair_rate=0.0)[0] != whole[0]


_COLOR = 0.3


def _closed_avatar(model: FaceModel) -> tuple[GaussianAvatars, tuple[FaceParams, Camera], torch.Tensor]:
    """An avatar, the view from its front, and the triangles at the back of its head."""
    torch.manual_seed(0)
    face = model.neutral(1)
    face.head_translation[:, 2] = -0.8
    config = PRESETS["draft"].config("gaussian_avatars")
    avatar = method_named("gaussian_avatars").avatar(config, model, face)
    assert isinstance(avatar, GaussianAvatars)
    every = torch.ones(len(model.faces), dtype=torch.bool)
    surface_of(avatar).fill_interior(every, torch.full((len(model.faces), 3), 0.6))
    away = triangle_views(model.template, model.faces, torch.tensor([0.0, 0.0, 0.8])) < -0.5
    camera = camera_from_fov(0.5, 128, 128, torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])))
    return avatar, (face, camera), head_parts(model).scalp & away


def _seen_from_the_front(model: FaceModel, filled_in: torch.Tensor | None = None) -> Unseen:
    parts, none = head_parts(model), torch.zeros(len(model.faces), dtype=torch.bool)
    filled_in = none if filled_in is None else filled_in
    prior = SurfacePrior(
        0.01 * parts.scalp.float(), colors=torch.full((len(none), 3), _COLOR), filled_in=filled_in,
        closed=filled_in | parts.interior,
    )  # fmt: skip
    return Unseen(None, prior)


def test_contributions_are_the_shares_of_the_picture(anny, monkeypatch):
    avatar, (face, camera), back = _closed_avatar(anny)
    found = contributions(avatar, [(face, camera)])
    with torch.no_grad():
        alpha = rasterize(avatar.pose(face).gaussians.timestep(0), camera, torch.zeros(3)).alpha
    assert float(found.sum()) == pytest.approx(float(alpha.sum()), rel=1e-4)
    assert (found >= 0).all()
    behind = replace(face, head_rotation=torch.tensor([[0.0, torch.pi, 0.0]]))
    monkeypatch.setenv("MIEN_THREADS", "1")
    both = contributions(avatar, [(face, camera), (behind, camera)])
    monkeypatch.setenv("MIEN_THREADS", "2")
    assert torch.equal(contributions(avatar, [(behind, camera), (face, camera)]), both)
    assert float(both[back].mean()) > 0.5
    assert (both >= found).all()


def test_of_hidden_copies_one_stays_and_none_below_what_is_shown(anny):
    """A third Gaussian on each hidden triangle, and a second one on triangles that are shown."""
    avatar, view, back = _closed_avatar(anny)
    back &= contributions(avatar, [view]) < 0.03
    rows, n = back.nonzero()[:, 0], len(avatar.store)
    avatar.store.append(rows)
    avatar.store.append(rows)
    removed = prune_hidden(avatar, surface_of(avatar), _seen_from_the_front(anny), [view], close=True)
    assert len(removed) == n + 2 * len(rows)
    left = avatar.store["face_index"][~removed].bincount(minlength=len(anny.faces))
    assert (left == 1).all(), "no triangle is left without a Gaussian, and none has two"
    assert len(rows) > 50
    avatar, view, _ = _closed_avatar(anny)
    rows, n = (anny.region_mask("nose") & (contributions(avatar, [view]) > 0.2)).nonzero()[:, 0], len(avatar.store)
    assert len(rows) > 20
    avatar.store.append(rows)
    avatar.store["means"].detach()[n:, 1] -= 0.01 / surface_of(avatar).sizes[rows]
    removed = prune_hidden(avatar, surface_of(avatar), _seen_from_the_front(anny), [view], close=True)
    assert not removed[rows].any()
    assert float(removed[n:].float().mean()) > 0.8


@pytest.mark.parametrize("close", [True, False])
def test_what_stays_becomes_a_surface_in_completed_colors(anny, close):
    avatar, view, back = _closed_avatar(anny)
    store, unseen = avatar.store, _seen_from_the_front(anny)
    store.assign("opacity_logits", torch.where(back, -3.0, 4.0))
    store.assign("offset_basis", torch.ones_like(store["offset_basis"]))
    prune_hidden(avatar, surface_of(avatar), unseen, [view], close=close)
    torch.testing.assert_close(rgb_from_sh(store["sh_constant"][back, 0]), torch.full((int(back.sum()), 3), _COLOR))
    height = store["means"].detach()[:, 1] * surface_of(avatar).sizes
    if not close:
        assert (store["opacity_logits"].detach()[back] == -3.0).all()
        assert not height[back].any()
        return
    assert (store["opacity_logits"].detach()[back].sigmoid() > 0.9).all()
    shapes = triangle_ellipses(anny.head_vertices(avatar.subject)[0], anny.faces)[1]
    wide = store["log_scales"].detach()[back] - shapes[back]
    torch.testing.assert_close(wide[:, 1], torch.zeros(int(back.sum())))
    assert (wide[:, [0, 2]] > 0).all(), "hair is a shell around the head"
    torch.testing.assert_close(height[back], unseen.prior.fill_height[back])
    assert not store["offset_basis"][back].any()


def test_made_up_sides_and_the_mouth_are_left_alone(anny):
    avatar, view, back = _closed_avatar(anny)
    alone = back | head_parts(anny).interior
    avatar.store.append(alone.nonzero()[:, 0])
    removed = prune_hidden(avatar, surface_of(avatar), _seen_from_the_front(anny, back), [view], close=True)
    own = alone[avatar.store["face_index"]]
    assert not removed[own].any()
    colors = avatar.store["sh_constant"].detach()[own]
    assert torch.equal(colors, sh_from_rgb(torch.full_like(colors, 0.6)))


_SKIN, _BROWN, _SHIRT = torch.tensor([[0.8, 0.6, 0.5], [0.2, 0.12, 0.08], [0.1, 0.7, 0.2]])


@pytest.fixture(scope="module")
def flame(anny, tmp_path_factory) -> FaceModel:
    path = write_npz(tmp_path_factory.mktemp("flame") / "head.npz", flame_like(anny))
    return replace(flame_face_model(read_flame(path), "head"), landmarks=exact_landmarks(anny))


def _middles(model: FaceModel) -> torch.Tensor:
    return model.template[model.faces].mean(1)


def _painted(model: FaceModel) -> torch.Tensor:
    """The colours of a person with brown hair and a light skin."""
    return torch.where(head_parts(model).scalp[:, None], _BROWN, _SKIN)


def _completed(model: FaceModel, seen: torch.Tensor, colors: torch.Tensor, unseen: float = 0.5) -> torch.Tensor:
    return complete_colors(model, model.template, seen.float(), torch.where(seen[:, None] > 0, colors, unseen))


def test_mirror_images_lie_on_the_other_side_in_the_same_region(anny, flame):
    images, middles = mirror_triangles(anny), _middles(anny)
    assert (images >= 0).float().mean() > 0.99
    has = (images >= 0).nonzero()[:, 0]
    assert (images[images[has]] == has).float().mean() > 0.99, "an involution"
    reflected = middles * torch.tensor([-1.0, 1.0, 1.0])
    assert (reflected[has] - middles[images[has]]).norm(dim=1).median() < 1e-4
    assert torch.equal(anny.face_regions[images[has]], anny.face_regions[has])
    random = torch.Generator().manual_seed(1)
    bent = replace(flame, template=flame.template + 3e-4 * torch.randn(flame.template.shape, generator=random))
    for model in (flame, bent):
        assert (mirror_triangles(model) >= 0).float().mean() > 0.9
    left = middles[:, 0] > 0.03
    half = replace(anny, faces=anny.faces[left], uv_faces=anny.uv_faces[left], face_regions=anny.face_regions[left])
    assert (mirror_triangles(half) == -1).all()


def test_an_unseen_side_gets_the_mirror_images_colors_without_a_border(anny):
    """A mole on one cheek appears on the other, which the camera did not see."""
    colors, middles, face = _painted(anny), _middles(anny), head_parts(anny).face
    away = (middles - torch.tensor([0.045, -0.03, 0.08])).norm(dim=1)
    mole = face & (away < away[face].kthvalue(12).values)
    assert mole.sum() > 5
    colors[mole] = torch.tensor([0.4, 0.25, 0.2])
    completed = _completed(anny, middles[:, 0] > -0.01, colors)
    assert (completed[mirror_triangles(anny)[mole]] - colors[mole]).abs().max() < 0.02
    # The left is brighter than the right. Where neither side is on the midline, the step between both is small.
    middles = _middles(anny)
    lit = _SKIN * (1 + 3 * middles[:, :1].clamp(-0.07, 0.07))
    completed = _completed(anny, middles[:, 0] > -0.03, lit)
    border = head_parts(anny).face & (middles[:, 0] < -0.03) & (middles[:, 0] > -0.04)
    assert (completed - lit)[border].abs().mean() < 0.03
    assert (lit[mirror_triangles(anny)] - lit)[border].abs().mean() > 0.1


@pytest.mark.parametrize("source", ["anny", "flame", "flame with regions"])
def test_hair_skin_and_neck_from_a_front_view(source, anny, flame):
    """The back of the head takes hair's colour and not skin's, the neck takes skin's and not the collar's."""
    model = anny if source == "anny" else flame if source == "flame" else with_regions_by_landmarks(flame)
    parts, middles, colors = head_parts(model), _middles(model), _painted(model)
    colors[parts.neck & (middles[:, 1] < -0.15)] = _SHIRT
    seen = middles[:, 2] > 0.03
    assert (parts.scalp & seen).any()
    completed = _completed(model, seen, colors, unseen=0.9)
    back = parts.scalp & ~seen
    assert back.sum() > 100
    assert (completed[back] - _BROWN).abs().max() < 0.05
    assert (completed[parts.neck & ~seen & (middles[:, 1] > -0.12)] - _SKIN).abs().mean() < 0.05


def test_everything_unseen_is_filled_and_damage_does_not_spread(anny):
    colors = _painted(anny)
    seen = (_middles(anny)[:, 2] > 0.05).float()
    colors[seen == 0] = torch.nan
    colors[7], seen[7] = torch.nan, 1.0
    colors[8], seen[8] = torch.inf, 0.5
    seen[9] = torch.nan
    completed = complete_colors(anny, anny.template, seen, colors)
    assert ((completed >= 0) & (completed <= 1)).all()
    sound = (seen == 1) & (torch.arange(len(seen)) != 7)
    assert torch.equal(completed[sound], colors[sound])
    assert _completed(anny, torch.zeros(len(seen)), _painted(anny)).isfinite().all(), "nothing seen at all"


def test_a_mouth_that_was_not_seen_is_dark_with_light_teeth(anny):
    parts, middles = head_parts(anny), _middles(anny)
    completed = _completed(anny, (middles[:, 2] > 0.03) & ~parts.interior, _painted(anny))
    luminance = completed.mean(1)
    front = luminance[parts.teeth & (middles[:, 2] > 0.09)].mean()
    assert front > 0.45
    assert luminance[parts.mouth].max() < 0.3
    assert luminance[parts.mouth & (middles[:, 2] < 0.04)].max() < 0.08
    assert luminance[parts.teeth & (middles[:, 2] < 0.06)].mean() < 0.5 * front
    tongue = completed[parts.tongue]
    assert (tongue[:, 0] > 1.3 * tongue[:, 1]).all()


def test_vertices_get_the_mean_of_their_triangles(anny):
    colors = _painted(anny)
    vertices = vertex_means(anny, colors)
    assert torch.allclose(vertices[anny.faces[head_parts(anny).face]].amax(), _SKIN[0])
    assert vertices.isfinite().all()
    around = (anny.faces == anny.faces[100, 0]).any(1)
    assert torch.allclose(vertices[anny.faces[100, 0]], colors[around].mean(0), atol=1e-6)
