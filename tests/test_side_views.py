"""Side views: pictures that no camera took, of a head from the side and of raised expressions."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from mien.avatar import GaussianAvatars, Progress, method_named
from mien.camera import camera_from_fov
from mien.commands.picture import PictureOptions
from mien.commands.stages import pictures
from mien.face import FaceModel, FaceParams
from mien.render.mesh import rasterize_mesh
from mien.rotation import matrix_from_axis_angle
from mien.tracking import NeckParts, head_cutter
from mien.training import PRESETS, TrainSettings
from mien.training.footage.frames import Frame, resolved
from mien.training.whole_head.side_views import SideView, SideViews, side_views, turned_to_side
from mien.training.whole_head.unseen import fills_sides
from plain_settings import plain_gaussian_avatars
from test_methods import new_avatar
from toy_scene import surface_of

_PROGRESS = Progress(0, 100, 0, 1.0, 1)
_HAIR = 0.02


def _camera():
    return camera_from_fov(0.5, 128, 128, torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])))


def _face(model: FaceModel):
    face = model.neutral(1)
    face.head_translation[:, 2] = -0.8
    return face


def _views(model: FaceModel, color: float = 0.5, hair: float = 0.0) -> SideViews:
    count = len(model.faces)
    return side_views(model, 0.1, torch.full((count, 3), color), torch.full((count,), hair))


def _random(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def _view(views: SideViews, face: FaceParams, step: int) -> SideView:
    return views.drawn(face, _camera(), step, _random())()


def _loss(views: SideViews, avatar: GaussianAvatars, face: FaceParams, step: int) -> torch.Tensor:
    return views.loss(avatar, _view(views, face, step), _PROGRESS)


def _opaque_avatar(model: FaceModel, color: float) -> GaussianAvatars:
    """One flat opaque Gaussian of one colour on each triangle."""
    torch.manual_seed(0)
    avatar = method_named("gaussian_avatars").avatar(PRESETS["paper"].config("gaussian_avatars"), model, _face(model))
    assert isinstance(avatar, GaussianAvatars)
    surface_of(avatar).fill_interior(
        torch.ones(len(model.faces), dtype=torch.bool), 0.97, torch.full((len(model.faces), 3), color)
    )
    return avatar


def test_a_head_turns_about_its_own_upright_axis(anny):
    face = _face(anny)
    face.head_rotation[:, 0] = 0.3
    turned = turned_to_side(face, math.pi / 2)
    before, after = (matrix_from_axis_angle(one.head_rotation[0]) for one in (face, turned))
    torch.testing.assert_close(after[:, 1], before[:, 1])
    torch.testing.assert_close(after[:, 2], before[:, 0], atol=1e-6, rtol=0)
    assert turned.head_translation.equal(face.head_translation)


def test_a_head_in_other_colors_than_the_mesh_costs_and_so_do_transparent_sides(anny):
    views, face, avatar = _views(anny), _face(anny), _opaque_avatar(anny, 0.5)
    other = _opaque_avatar(anny, 0.9)
    costs = {step: float(_loss(views, avatar, face, step).detach()) for step in (0, 4)}
    for step, most in ((0, 0.7), (4, 0.3)):  # From aside, the neck below the cut costs too.
        assert costs[step] < most * float(_loss(views, other, face, step).detach())
    avatar.store.assign("opacity_logits", torch.full_like(avatar.store["opacity_logits"], -4.0))
    assert float(_loss(views, avatar, face, 0).detach()) > 3 * costs[0]


def test_changes_beside_the_mesh_cost_in_raised_expressions_only(anny):
    """By 8 times the method's own penalty, whatever the weight of the picture. Hair is free."""
    face = _face(anny)
    avatar = GaussianAvatars(plain_gaussian_avatars(expression_rank=2, expression_weight=3.0), anny, face)
    avatar.store.assign("offset_basis", torch.ones_like(avatar.store["offset_basis"]))
    avatar.activations.directions.fill_(1.0)
    avatar.activations.seen = torch.full((1, 2), 0.5**0.5)
    views = replace(_views(anny), weight=0.0)
    turned, raised = (_loss(views, avatar, face, step).detach() for step in (0, 4))
    assert float(turned) == 0
    # The random numbers raise coefficients until the activations, 2 alike, have the length that they approach.
    assert 0 < float(raised) <= 8 * 3 * 2 * 1.1**2
    surface = avatar.surface()
    assert surface is not None
    hair = ~views.compared[surface.triangles()]
    assert 0.1 < float(hair.float().mean()) < 0.9
    kept = torch.where(hair[:, None, None], 0.0, avatar.store["offset_basis"])
    avatar.store.assign("offset_basis", kept)
    assert float(_loss(views, avatar, face, 4).detach()) == pytest.approx(float(raised))


def test_gradients_reach_gaussians_and_not_the_face(anny):
    avatar, face = _opaque_avatar(anny, 0.9), _face(anny)
    face = replace(face, head_translation=face.head_translation.requires_grad_())
    _loss(_views(anny), avatar, face, 0).backward()
    gradient = avatar.store["sh_constant"].grad
    assert gradient is not None
    assert float(gradient.abs().sum()) > 0
    assert face.head_translation.grad is None


def test_raised_expressions_stay_within_the_bounds_and_change_with_the_random_numbers(anny):
    views, rest = _views(anny), _face(anny).expression
    assert [step for step in range(17) if views.due(step)] == [0, 4, 8, 12, 16]
    assert not replace(views, weight=0.0).due(0)
    raised = [views.raised(rest, _random(seed)) for seed in (0, 1)]
    for one in raised:
        assert bool((one <= anny.expression_bounds[:, 1] + 1e-6).all())
        assert 1 <= int((one != rest).sum()) <= 6
    assert not raised[0].equal(raised[1])


def test_the_outline_has_the_hair(anny):
    views = [_view(_views(anny, hair=hair), _face(anny), 0) for hair in (0.0, _HAIR)]
    alphas = [view.alpha for view in views]
    head_faces = anny.faces[~anny.region_mask("neck")]
    head = rasterize_mesh(anny(views[0].plan.face)[0], head_faces, views[0].plan.camera).face_index >= 0
    assert bool((alphas[0][head] == 1).all())
    assert float(alphas[1].sum()) > 1.05 * float(alphas[0].sum())


def test_the_outline_ends_at_the_cut_at_the_neck(anny):
    view = _view(_views(anny), _face(anny), 0)
    face, camera, picture, alpha = view.plan.face, view.plan.camera, view.picture, view.alpha
    bare = np.where(rasterize_mesh(anny(face)[0], anny.faces, camera).face_index.numpy() >= 0, 255, 0).astype(np.uint8)
    expected = head_cutter(anny, NeckParts.of(anny), face)(bare, camera)
    assert alpha.equal(torch.from_numpy(expected).float() / 255)
    assert float(alpha.sum()) < 0.97 * (bare > 0).sum(), "the mesh goes on below the cut"
    torch.testing.assert_close(picture[alpha == 0], view.plan.background.expand(int((alpha == 0).sum()), 3))


@pytest.mark.parametrize(("cameras", "filled"), [(1, True), (3, False)])
def test_sides_are_filled_by_themselves_if_one_camera_filmed(cameras, filled):
    frames = [Frame(0, 0, camera) for camera in range(cameras)]
    settings = PRESETS["standard"].settings_of("gaussian_avatars")
    assert settings.unseen == "auto"
    assert fills_sides(frames, settings, bound=True) is filled
    assert fills_sides(frames, replace(settings, unseen="filled"), bound=False)
    assert not fills_sides(frames, replace(settings, unseen="trained"), bound=True)
    assert not fills_sides(frames, settings, bound=False), "headgas has nothing to fill"


def test_background_and_edges_follow_the_sides() -> None:
    for filled, background, edges in ((True, "mixed", "cleaned"), (False, "white", "filmed")):
        assert resolved(TrainSettings(background="auto"), filled=filled).background == background
        assert resolved(TrainSettings(background="white"), filled=filled).background == "white"
        assert resolved(TrainSettings(edges="auto"), filled=filled).edges == edges
        assert resolved(TrainSettings(edges="cleaned"), filled=filled).edges == "cleaned"


def test_transparent_pictures_warn_of_white_only_where_it_was(tmp_path, monkeypatch):
    said: list[str] = []
    monkeypatch.setattr(pictures, "say", said.append)
    for method, background, unseen, white in (
        ("gaussian_avatars", "auto", "auto", False),
        ("gaussian_avatars", "auto", "trained", True),
        ("gaussian_avatars", "white", "auto", True),
        ("gaussian_avatars", "random", "trained", False),
        ("headgas", "auto", "auto", True),
    ):
        config = {"settings": {"background": background, "unseen": unseen}}
        monkeypatch.setattr(pictures, "read_run_config", lambda run_dir, config=config: config)
        said.clear()
        pictures.warn_of_white(PictureOptions(background="transparent"), tmp_path, new_avatar(method))
        assert bool(said) is white, (method, background, unseen)
