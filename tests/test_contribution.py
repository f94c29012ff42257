"""Gaussians that hardly add to any training picture are removed, or become a closed surface again."""

from dataclasses import replace

import pytest
import torch

from mien.avatar import SurfacePrior, method_named
from mien.avatar.gaussian_avatars.avatar import GaussianAvatars
from mien.avatar.ops.triangle_frames import triangle_ellipses
from mien.camera import Camera, camera_from_fov
from mien.face import FaceModel, FaceParams
from mien.face.head_parts import head_parts
from mien.gaussians import sh_from_rgb
from mien.render import rasterize
from mien.training import PRESETS
from mien.training.footage.coverage import triangle_views
from mien.training.whole_head.contribution import contributions, prune_hidden
from mien.training.whole_head.unseen import Unseen
from sh_colors import rgb_from_sh
from toy_scene import surface_of

_COLOR = 0.3


def _view(model: FaceModel) -> tuple[FaceParams, Camera]:
    face = model.neutral(1)
    face.head_translation[:, 2] = -0.8
    return face, camera_from_fov(0.5, 128, 128, torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])))


def _closed_avatar(model: FaceModel) -> GaussianAvatars:
    torch.manual_seed(0)
    config = PRESETS["draft"].config("gaussian_avatars")
    avatar = method_named("gaussian_avatars").avatar(config, model, _view(model)[0])
    assert isinstance(avatar, GaussianAvatars)
    every = torch.ones(len(model.faces), dtype=torch.bool)
    surface_of(avatar).fill_interior(every, 0.97, torch.full((len(model.faces), 3), 0.6))
    return avatar


def _unseen(model: FaceModel, filled_in: torch.Tensor) -> Unseen:
    parts = head_parts(model)
    prior = SurfacePrior(
        0.01 * parts.scalp.float(), colors=torch.full((len(model.faces), 3), _COLOR), filled_in=filled_in,
        closed=filled_in | parts.interior,
    )  # fmt: skip
    return Unseen(None, prior)


def _none(model: FaceModel) -> torch.Tensor:
    return torch.zeros(len(model.faces), dtype=torch.bool)


def _back(model: FaceModel) -> torch.Tensor:
    """Triangles at the back of the head."""
    away = triangle_views(model.template, model.faces, torch.tensor([0.0, 0.0, 0.8])) < -0.5
    return head_parts(model).scalp & away


def test_contributions_are_the_shares_of_the_picture(anny):
    avatar, view = _closed_avatar(anny), _view(anny)
    found = contributions(avatar, [view])
    with torch.no_grad():
        alpha = rasterize(avatar.pose(view[0]).gaussians.timestep(0), view[1], torch.zeros(3)).alpha
    assert float(found.sum()) == pytest.approx(float(alpha.sum()), rel=1e-4)
    assert (found >= 0).all()


def test_the_back_of_a_head_adds_nothing_from_the_front(anny):
    avatar, view, back = _closed_avatar(anny), _view(anny), _back(anny)
    front = anny.region_mask("nose") & (triangle_views(anny(view[0])[0], anny.faces, view[1].position) > 0.5)
    found = contributions(avatar, [view])
    assert float(found[back].median()) < 0.03
    assert float(found[front].mean()) > 0.05
    behind = replace(view[0], head_rotation=torch.tensor([[0.0, torch.pi, 0.0]]))
    both = contributions(avatar, [view, (behind, view[1])])
    assert float(both[back].mean()) > 0.5
    assert (both >= found).all()


def test_of_hidden_copies_one_stays(anny):
    """A third Gaussian on each hidden triangle, and a second one on triangles that are shown."""
    avatar, view, back = _closed_avatar(anny), _view(anny), _back(anny)
    back &= contributions(avatar, [view]) < 0.03
    rows, n = back.nonzero()[:, 0], len(avatar.store)
    avatar.store.append(rows)
    avatar.store.append(rows)
    removed = prune_hidden(avatar, _unseen(anny, _none(anny)), [view], close=True)
    bound, stay = avatar.store["face_index"], (~removed).long()
    assert len(removed) == n + 2 * len(rows)
    left = torch.zeros(len(anny.faces), dtype=torch.long).index_add(0, bound, stay)
    assert (left == 1).all(), "no triangle is left without a Gaussian, and none has two"
    assert int(removed.sum()) == 2 * len(rows) > 100


def test_hidden_copies_below_what_is_shown_go(anny):
    avatar, view = _closed_avatar(anny), _view(anny)
    found = contributions(avatar, [view])
    rows = (anny.region_mask("nose") & (found > 0.2)).nonzero()[:, 0]
    assert len(rows) > 20
    n = len(avatar.store)
    avatar.store.append(rows)
    means = avatar.store["means"].detach()
    means[n:, 1] -= 0.01 / surface_of(avatar).sizes[rows]
    removed = prune_hidden(avatar, _unseen(anny, _none(anny)), [view], close=True)
    assert not removed[rows].any()
    assert float(removed[n:].float().mean()) > 0.8


@pytest.mark.parametrize("close", [True, False])
def test_what_stays_becomes_a_surface_in_completed_colors(anny, close):
    avatar, view, back = _closed_avatar(anny), _view(anny), _back(anny)
    store, unseen = avatar.store, _unseen(anny, _none(anny))
    store.assign("opacity_logits", torch.full_like(store["opacity_logits"], -1.0))
    store.assign("opacity_logits", torch.where(back, -3.0, 4.0))
    store.assign("offset_basis", torch.ones_like(store["offset_basis"]))
    prune_hidden(avatar, unseen, [view], close=close)
    torch.testing.assert_close(rgb_from_sh(store["sh_constant"][back, 0]), torch.full((int(back.sum()), 3), _COLOR))
    shapes = triangle_ellipses(anny.head_vertices(avatar.subject)[0], anny.faces)[1]
    height = store["means"].detach()[:, 1] * surface_of(avatar).sizes
    if close:
        assert (store["opacity_logits"].detach()[back].sigmoid() > 0.9).all()
        wide = store["log_scales"].detach()[back] - shapes[back]
        torch.testing.assert_close(wide[:, 1], torch.zeros(int(back.sum())))
        assert (wide[:, [0, 2]] > 0).all(), "hair is a shell around the head"
        torch.testing.assert_close(height[back], unseen.prior.fill_height[back])
        assert not store["offset_basis"][back].any()
    else:
        assert (store["opacity_logits"].detach()[back] == -3.0).all()
        assert not height[back].any()


def test_made_up_sides_and_the_mouth_are_left_alone(anny):
    avatar, view, back = _closed_avatar(anny), _view(anny), _back(anny)
    inside = head_parts(anny).interior
    rows = (back | inside).nonzero()[:, 0]
    avatar.store.append(rows)
    before = avatar.store["sh_constant"].detach().clone()
    removed = prune_hidden(avatar, _unseen(anny, back), [view], close=True)
    own = (back | inside)[avatar.store["face_index"]]
    assert not removed[own].any()
    assert torch.equal(avatar.store["sh_constant"].detach()[own], before[own])
    assert torch.equal(before[own][0, 0], sh_from_rgb(torch.full((3,), 0.6)))
