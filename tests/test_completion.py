"""Triangles that no picture shows get sane colours: mirrored, spread over their own part, or those of a mouth."""

from dataclasses import replace

import pytest
import torch

from flame_like import exact_landmarks, flame_like, write_npz
from mien.face import FaceModel, mirror_triangles
from mien.face.flame import flame_face_model, read_flame
from mien.face.head_parts import head_parts
from mien.face.mirror import triangle_geometry
from mien.render.mesh import shade
from mien.tracking.landmarks import with_regions_by_landmarks
from mien.training.whole_head.completion import complete_colors, vertex_means

_SKIN, _HAIR, _SHIRT = torch.tensor([[0.8, 0.6, 0.5], [0.2, 0.12, 0.08], [0.1, 0.7, 0.2]])


@pytest.fixture(scope="module")
def flame(anny, tmp_path_factory) -> FaceModel:
    path = write_npz(tmp_path_factory.mktemp("flame") / "head.npz", flame_like(anny))
    return replace(flame_face_model(read_flame(path), "head"), landmarks=exact_landmarks(anny))


def _middles(model: FaceModel) -> torch.Tensor:
    return model.template[model.faces].mean(1)


def _painted(model: FaceModel) -> torch.Tensor:
    """The colours of a person with brown hair and a light skin."""
    return torch.where(head_parts(model).scalp[:, None], _HAIR, _SKIN)


def _completed(model: FaceModel, seen: torch.Tensor, colors: torch.Tensor, unseen: float = 0.5) -> torch.Tensor:
    """The colours that are completed from those of the triangles that are seen."""
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


def test_an_unseen_side_gets_the_mirror_images_colors(anny):
    """A mole on one cheek appears on the other, which the camera did not see."""
    colors, middles, face = _painted(anny), _middles(anny), head_parts(anny).face
    away = (middles - torch.tensor([0.045, -0.03, 0.08])).norm(dim=1)
    mole = face & (away < away[face].kthvalue(12).values)
    assert mole.sum() > 5
    colors[mole] = torch.tensor([0.4, 0.25, 0.2])
    completed = _completed(anny, middles[:, 0] > -0.01, colors)
    assert (completed[mirror_triangles(anny)[mole]] - colors[mole]).abs().max() < 0.02


def test_no_border_shows_if_one_side_is_lit_less(anny):
    """The left is brighter than the right. Where neither side is on the midline, the step between both is small."""
    middles = _middles(anny)
    lit = _SKIN * (1 + 3 * middles[:, :1].clamp(-0.07, 0.07))
    completed = _completed(anny, middles[:, 0] > -0.03, lit)
    border = head_parts(anny).face & (middles[:, 0] < -0.03) & (middles[:, 0] > -0.04)
    assert (completed - lit)[border].abs().mean() < 0.03
    mirrored_only = (lit[mirror_triangles(anny)] - lit)[border].abs().mean()
    assert mirrored_only > 0.1


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
    assert (completed[back] - _HAIR).abs().max() < 0.05
    nape = parts.neck & ~seen & (middles[:, 1] > -0.12)
    assert (completed[nape] - _SKIN).abs().mean() < 0.05


def test_everything_unseen_is_filled_and_damage_does_not_spread(anny):
    colors = _painted(anny)
    seen = (_middles(anny)[:, 2] > 0.05).float()
    colors[seen == 0] = torch.nan
    colors[7], seen[7] = torch.nan, 1.0
    colors[8], seen[8] = torch.inf, 0.5
    seen[9] = torch.nan
    light = torch.randn(9, 3, generator=torch.Generator().manual_seed(2))
    for known in (None, light):
        completed = complete_colors(anny, anny.template, seen, colors, texture=1.0, light=known)
        assert ((completed >= 0) & (completed <= 1)).all()
        sound = (seen == 1) & (torch.arange(len(seen)) != 7)
        assert torch.equal(completed[sound], colors[sound])
    assert _completed(anny, torch.zeros(len(seen)), _painted(anny)).isfinite().all(), "nothing seen at all"


def test_light_is_taken_out_before_mirroring_and_put_back(anny):
    """A head of one colour in a lamp from its left: the side that is not seen is as dark as the lamp leaves it."""
    light, seen = torch.zeros(9, 3), _middles(anny)[:, 0] > 0
    light[0] = 3.2
    normals = triangle_geometry(anny.template, anny.faces)[2]
    for strength in (1.2, -1.2):
        light[3] = strength
        shading = shade(normals, light)
        if shading[seen].mean() > shading[~seen].mean():
            break
    truth = (_SKIN * shading.clamp_min(0.1)).clamp(0, 1)
    given = torch.where(seen[:, None], truth, 0.5)
    found = [complete_colors(anny, anny.template, seen.float(), given, light=known) for known in (None, light)]
    error = [(each - truth)[head_parts(anny).face & ~seen].abs().mean() for each in found]
    assert error[1] < 0.5 * error[0]


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
