"""Strands of hair on the back of a head that no picture shows."""

import torch

from mien.avatar import SurfacePrior, method_named
from mien.avatar.gaussian_avatars.hair_strands import strand_gaussians
from mien.avatar.ops.triangle_frames import frames_to_world, triangle_frames
from mien.face import FaceModel
from mien.face.head_parts import head_parts
from mien.rotation import matrix_from_quaternion
from mien.training import PRESETS
from sh_colors import rgb_from_sh
from toy_scene import surface_of

_HEIGHT = 0.02


def _back(model: FaceModel) -> torch.Tensor:
    """The scalp behind the ears, where the surface is steep."""
    middles = model.template[model.faces].mean(1)
    return head_parts(model).scalp & (middles[:, 2] < -0.05)


def _strands(model: FaceModel, height: float = _HEIGHT, color: float = 0.4) -> dict[str, torch.Tensor]:
    count = len(model.faces)
    heights, colors = torch.full((count,), height), torch.full((count, 3), color)
    return strand_gaussians(model.template, model.faces, _back(model), heights, colors)


def _in_the_head(model: FaceModel, strands: dict[str, torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
    frames = triangle_frames(model.template, model.faces)
    values = (strands[name] for name in ("face_index", "means", "quats", "log_scales"))
    means, quats, _ = frames_to_world(frames, *values)
    return means, matrix_from_quaternion(quats)[..., 0]


def test_strands_cover_the_chosen_triangles_by_area(anny):
    strands = _strands(anny)
    counts = torch.bincount(strands["face_index"], minlength=len(anny.faces)).double()
    assert not counts[~_back(anny)].any()
    a, b, c = (anny.template[anny.faces[:, corner].long()].double() for corner in range(3))
    expected = 150_000 * 0.5 * torch.linalg.cross(b - a, c - a).norm(dim=1) * _back(anny)
    assert float((counts - expected).abs().max()) <= 1
    assert len(strands["means"]) > 1000


def test_strands_lie_just_below_the_top_of_the_hair(anny):
    strands = _strands(anny)
    size = triangle_frames(anny.template, anny.faces).k[strands["face_index"]]
    above = strands["means"][:, 1] * size
    assert float(above.min()) > _HEIGHT - 0.0031
    assert float(above.max()) <= _HEIGHT + 1e-6


def test_strands_point_down_in_the_surface(anny):
    strands = _strands(anny)
    _, along = _in_the_head(anny, strands)
    normals = triangle_frames(anny.template, anny.faces).R[strands["face_index"]][..., 1]
    assert float((along * normals).sum(-1).abs().max()) < 1e-4
    assert float(along[:, 1].median()) < -0.8
    assert float(along[:, 0].abs().median()) < 0.4


def test_strands_differ_in_brightness_and_not_in_tint_or_between_calls(anny):
    strands = _strands(anny)
    colors = rgb_from_sh(strands["sh_constant"][:, 0])
    assert abs(float(colors.mean()) - 0.4) < 0.01
    assert 0.06 < float(colors[:, 0].std()) < 0.1
    torch.testing.assert_close(colors[:, 0], colors[:, 2])
    again = _strands(anny)
    assert all(strands[name].equal(again[name]) for name in strands)


def test_a_closed_head_has_strands_that_keep_their_colors(anny):
    face, count = anny.neutral(1), len(anny.faces)
    avatar = method_named("gaussian_avatars").avatar(PRESETS["standard"].config("gaussian_avatars"), anny, face)
    store = avatar.gaussian_store()
    bald = len(store)
    chosen, color = _back(anny), torch.full((count, 3), 0.4)
    hair, doubt = torch.full((count,), _HEIGHT), chosen.float()
    surface_of(avatar).close(SurfacePrior(hair, colors=color, doubt=doubt, filled_in=chosen, strands=chosen))
    own = len(_strands(anny)["means"])
    assert len(store) == bald + own
    before = store["sh_constant"][bald:].detach().clone()
    for _ in range(20):
        surface_of(avatar).keep_to(SurfacePrior(hair, colors=color, doubt=doubt, filled_in=chosen, strands=chosen))
    assert store["sh_constant"][bald:].equal(before)


def test_no_chosen_triangle_gives_no_strand(anny):
    count = len(anny.faces)
    none = strand_gaussians(
        anny.template, anny.faces, torch.zeros(count, dtype=torch.bool), torch.zeros(count), torch.zeros(count, 3)
    )
    assert all(len(values) == 0 for values in none.values())
