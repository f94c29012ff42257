"""Side views, which no camera took, and the soft cut: opacities fade towards the neck cut."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from known import known
from mien import runtime
from mien.avatar.baking import make_portable
from mien.avatar.gaussian_avatars.avatar import GaussianAvatars
from mien.avatar.methods import method_named
from mien.avatar.settings import Progress
from mien.camera import camera_from_fov
from mien.cli import main
from mien.disk.workspace import open_workspace
from mien.face import FaceModel, FaceParams, load_face_model
from mien.formats.page import write_packed
from mien.gaussians import world_means
from mien.pipeline import draw as pictures
from mien.pipeline.draw import posed_softly
from mien.pipeline.export_run import RunContent
from mien.pipeline.picture_options import PictureOptions
from mien.render.mesh import rasterize_mesh
from mien.rotation import matrix_from_axis_angle
from mien.runtime.baked import MeshBound
from mien.tracking.neck_cut import NeckCut, NeckParts, fit_neck_cut
from mien.tracking.scoring import head_cutter
from mien.training import PRESETS, TrainSettings
from mien.training.footage.frames import Frame
from mien.training.settings import resolved
from mien.training.whole_head import soft_cut
from mien.training.whole_head.side_views import SideView, SideViews, side_views, turned_to_side
from mien.training.whole_head.unseen import fills_sides
from plain_settings import plain_gaussian_avatars
from shared_things import MadeOnce, toy_workspace
from test_methods import new_avatar
from toy_scene import surface_of, toy_camera

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
    torch.manual_seed(0)
    avatar = method_named("gaussian_avatars").avatar(PRESETS["paper"].config("gaussian_avatars"), model, _face(model))
    assert isinstance(avatar, GaussianAvatars)
    surface_of(avatar).fill_interior(
        torch.ones(len(model.faces), dtype=torch.bool), torch.full((len(model.faces), 3), color)
    )
    return avatar


def test_a_head_turns_about_its_own_axis_and_raised_expressions_stay_within_the_bounds(anny):
    face = _face(anny)
    face.head_rotation[:, 0] = 0.3
    turned, upright = turned_to_side(face, math.pi / 2)
    before, after = (matrix_from_axis_angle(one.head_rotation[0]) for one in (face, turned))
    torch.testing.assert_close(after[:, 1], before[:, 1])
    torch.testing.assert_close(upright.float(), before[:, 1])
    torch.testing.assert_close(after[:, 2], before[:, 0], atol=1e-6, rtol=0)
    assert turned.head_translation.equal(face.head_translation)
    views, rest = _views(anny), _face(anny).expression
    assert [step for step in range(17) if views.due(step)] == [0, 4, 8, 12, 16]
    assert not replace(views, weight=0.0).due(0)
    raised = [views.raised(rest, _random(seed)) for seed in (0, 1)]
    for one in raised:
        assert bool((one <= anny.expression_bounds[:, 1] + 1e-6).all())
        assert 1 <= int((one != rest).sum()) <= 6
    assert not raised[0].equal(raised[1])


def test_a_head_in_other_colors_than_the_mesh_costs_and_so_do_transparent_sides(anny):
    views, face, avatar = _views(anny), _face(anny), _opaque_avatar(anny, 0.5)
    other = _opaque_avatar(anny, 0.9)
    held = replace(face, head_translation=face.head_translation.clone().requires_grad_())
    _loss(views, other, held, 0).backward()
    assert float(known(other.store["sh_constant"].grad).abs().sum()) > 0
    assert held.head_translation.grad is None, "gradients do not reach the face"
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
    avatar.activations.seen = torch.ones_like(avatar.activations.seen[:1])
    views = replace(_views(anny), weight=0.0)
    turned, raised = (_loss(views, avatar, face, step).detach() for step in (0, 4))
    assert float(turned) == 0
    # The random numbers raise coefficients until activations have the length that they approach.
    assert 0 < float(raised) <= 8 * 3 * 1.1**2
    hair = ~views.compared[known(avatar.extras.surface).triangles()]
    assert 0.1 < float(hair.float().mean()) < 0.9
    kept = torch.where(hair[:, None, None], 0.0, avatar.store["offset_basis"])
    avatar.store.assign("offset_basis", kept)
    assert float(_loss(views, avatar, face, 4).detach()) == pytest.approx(float(raised))


def test_the_outline_has_the_hair_and_ends_at_the_cut_at_the_neck(anny):
    view, hairy = (_view(_views(anny, hair=hair), _face(anny), 0) for hair in (0.0, _HAIR))
    face, camera, alpha = view.face, view.camera, view.matte
    assert float(hairy.matte.float().sum()) > 1.05 * float(alpha.float().sum())
    vertices = anny(face)[0]
    head = rasterize_mesh(vertices, anny.faces[~anny.region_mask("neck")], camera).face_index >= 0
    assert bool((alpha[head] == 255).all())
    bare = np.where(rasterize_mesh(vertices, anny.faces, camera).face_index.numpy() >= 0, 255, 0).astype(np.uint8)
    expected = head_cutter(anny, NeckParts.of(anny), face)(bare, camera)
    assert alpha.equal(torch.from_numpy(expected))
    assert float(alpha.float().sum()) < 0.97 * 255 * (bare > 0).sum(), "the mesh goes on below the cut"
    shown = view.picture[alpha == 0]
    torch.testing.assert_close(shown.float() / 255, view.background.expand(len(shown), 3))


def test_sides_are_filled_by_themselves_if_one_camera_filmed():
    settings = PRESETS["standard"].settings_of("gaussian_avatars")
    assert settings.unseen == "auto"
    for cameras, filled in ((1, True), (3, False)):
        frames = [Frame(0, 0, camera) for camera in range(cameras)]
        assert fills_sides(frames, settings, bound=True) is filled
        assert fills_sides(frames, replace(settings, unseen="filled"), bound=False)
        assert not fills_sides(frames, replace(settings, unseen="trained"), bound=True)
        assert not fills_sides(frames, settings, bound=False), "headgas has nothing to fill"
    for filled, background, edges, coarse in ((True, "mixed", "cleaned", 0.4), (False, "white", "filmed", 0.0)):
        assert resolved(TrainSettings(), filled=filled).coarse == coarse
        assert resolved(TrainSettings(coarse=0.2), filled=filled).coarse == 0.2
        assert resolved(TrainSettings(background="auto"), filled=filled).background == background
        assert resolved(TrainSettings(background="white"), filled=filled).background == "white"
        assert resolved(TrainSettings(edges="auto"), filled=filled).edges == edges
        assert resolved(TrainSettings(edges="cleaned"), filled=filled).edges == "cleaned"


def test_transparent_pictures_warn_of_white_only_where_it_was(tmp_path, monkeypatch):
    said: list[str] = []
    monkeypatch.setattr(pictures, "say", said.append)
    bound = "gaussian_avatars"
    for method, background, unseen, white in (
        (bound, "auto", "auto", False), (bound, "auto", "trained", True), (bound, "white", "auto", True),
        (bound, "random", "trained", False), ("headgas", "auto", "auto", True),
    ):  # fmt: skip
        config = {"settings": {"background": background, "unseen": unseen}}
        monkeypatch.setattr(pictures, "read_run_config", lambda run_dir, config=config: config)
        said.clear()
        pictures.warn_of_white(PictureOptions(background="transparent"), tmp_path, new_avatar(method))
        assert bool(said) is white, (method, background, unseen)


model = pytest.fixture(scope="module")(lambda: load_face_model("anny"))


@pytest.fixture(scope="module")
def avatar(model: FaceModel) -> GaussianAvatars:
    face = replace(model.neutral(), head_translation=torch.tensor([[0, 0, -0.9]]))
    return GaussianAvatars(plain_gaussian_avatars(), model, face)


def cut_of(model: FaceModel, vertices: torch.Tensor | None = None) -> NeckCut:
    vertices = model.template if vertices is None else vertices
    return fit_neck_cut(NeckParts.of(model), vertices, torch.tensor([0.0, 1.0, 0.0]))


def opacities(portable: runtime.PortableAvatar) -> np.ndarray:
    assert isinstance(portable.baked, MeshBound)
    return 1 / (1 + np.exp(-portable.baked.attributes.opacity_logits.astype(np.float64)))


def test_what_is_far_from_the_cut_stays_and_the_end_of_the_neck_is_clear(model, avatar) -> None:
    before = make_portable(avatar, toy_camera(64), "soft")
    after = soft_cut.with_soft_cut(before, avatar)
    assert isinstance(before.baked, MeshBound)
    neck = model.region_mask("neck").numpy()[before.baked.face_index]
    was, now = opacities(before), opacities(after)
    np.testing.assert_array_equal(now[~neck], was[~neck])
    cut = cut_of(model, model(avatar.subject)[0])
    margins = cut.margins(world_means(avatar.pose(avatar.subject).gaussians.timestep(0)).detach()).numpy()
    between = (margins > 0) & (margins < soft_cut.SOFT_CUT_WIDTH) & neck
    far = neck & (margins < -soft_cut.SOFT_CUT_HEAD[1])
    assert far.any()
    assert (now[far] <= 1.01 * soft_cut.SOFT_CUT_LEAST).all()
    assert (now[between] <= was[between]).all()
    assert (now[between] < 0.9 * was[between]).any()
    # Pictures end as softly as files.
    soft, sharp = posed_softly(avatar)(avatar.subject), avatar.pose(avatar.subject).gaussians.timestep(0)
    np.testing.assert_allclose(soft.opacities.numpy(), now, atol=soft_cut.SOFT_CUT_LEAST + 1e-6)
    assert torch.equal(soft.means, sharp.means)
    assert float((soft.opacities / sharp.opacities.detach()).min()) < 0.01


def test_shares_grow_with_the_distance_from_the_cut(model: FaceModel) -> None:
    """What stands off the skin goes just above the cut alone: shards of a collar go, and hair at the neck stays."""
    cut = cut_of(model)
    origin, side, up = (torch.from_numpy(each).float() for each in (cut.origin, cut.axes[0], cut.axes[2]))
    points, far = origin + torch.linspace(-0.02, 0.05, 15)[:, None] * up, torch.full((1, 3), 10.0)
    shares = soft_cut.opacity_shares(points, cut, far, points)
    assert (shares.diff() >= 0).all()
    assert (float(shares[0]), float(shares[-1])) == (0.0, 1.0)
    assert ((shares > 0.1) & (shares < 0.9)).any()
    assert (soft_cut.opacity_shares(points, cut, points, points) == 1).all(), "what lies on the head is not cut off"
    gap, (low, high) = soft_cut.SOFT_CUT_OFF_SKIN[1] + 1e-3, soft_cut.SOFT_CUT_COLLAR
    skin = origin + torch.tensor([0.95 * low, 1.1 * high])[:, None] * up
    on_skin, off_skin = (soft_cut.opacity_shares(skin + away * side, cut, far, skin) for away in (0.0, gap))
    assert (on_skin > 0.7).all()
    assert off_skin[0] == 0
    assert off_skin[1] == on_skin[1] == 1


@pytest.mark.unchecked
def test_pages_and_files_have_the_soft_cut_unless_it_is_declined(tmp_path: Path, made_once: MadeOnce) -> None:
    """Whatever is made of a .mien file later ends as the file does."""
    workspace, packed = toy_workspace(made_once), []
    content = RunContent(open_workspace(workspace), "toy")
    for options, soft in (((), True), (("--sharp-cut",), False)):
        for ending in ("packed", "mien"):
            assert main(["export", str(workspace), "--out", str(tmp_path / f"a.{ending}"), *options]) == 0
        packed.append((tmp_path / "a.packed").read_bytes())
        write_packed(tmp_path / "direct.packed", content.portable(confidence=False, soft_cut=soft))
        assert packed[-1] == (tmp_path / "direct.packed").read_bytes()
        written, expected = runtime.load(tmp_path / "a.mien").portable, content.portable(soft_cut=soft)
        np.testing.assert_array_equal(opacities(written), opacities(expected))
    assert packed[0] != packed[1]
