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

_SKIN, _HAIR, _SHIRT = (0.8, 0.6, 0.5), (0.2, 0.12, 0.08), (0.1, 0.7, 0.2)


@pytest.fixture(scope="module")
def flame(anny, tmp_path_factory) -> FaceModel:
    path = write_npz(tmp_path_factory.mktemp("flame") / "head.npz", flame_like(anny))
    return replace(flame_face_model(read_flame(path), "head"), landmarks=exact_landmarks(anny))


def _middles(model: FaceModel) -> torch.Tensor:
    return model.template[model.faces].mean(1)


def _painted(model: FaceModel) -> torch.Tensor:
    """The colours of a person with brown hair and a light skin."""
    colors = torch.tensor(_SKIN).repeat(len(model.faces), 1)
    colors[head_parts(model).scalp] = torch.tensor(_HAIR)
    return colors


# The mirror map -------------------------------------------------------------------------------------------------------


def test_mirror_images_of_a_symmetric_mesh_are_an_involution(anny):
    images = mirror_triangles(anny)
    assert (images >= 0).float().mean() > 0.99
    has = (images >= 0).nonzero()[:, 0]
    back = images[images[has]]
    assert (back == has).float().mean() > 0.99
    reflected = _middles(anny) * torch.tensor([-1.0, 1.0, 1.0])
    assert (reflected[has] - _middles(anny)[images[has]]).norm(dim=1).median() < 1e-4


def test_mirror_images_stay_in_their_region_and_change_sides(anny):
    images = mirror_triangles(anny)
    has = images >= 0
    assert torch.equal(anny.face_regions[images[has]], anny.face_regions[has])
    aside = has & (_middles(anny)[:, 0] > 0.01)
    assert (_middles(anny)[images[aside], 0] < 0).all()


def test_mirror_images_of_another_topology_and_of_a_mesh_that_is_not_quite_symmetric(flame):
    random = torch.Generator().manual_seed(1)
    bent = replace(flame, template=flame.template + 3e-4 * torch.randn(flame.template.shape, generator=random))
    for model in (flame, bent):
        images = mirror_triangles(model)
        assert (images >= 0).float().mean() > 0.9


def test_a_triangle_without_a_counterpart_has_no_mirror_image(anny):
    middles = _middles(anny)
    left = middles[:, 0] > 0.03
    half = replace(anny, faces=anny.faces[left], uv_faces=anny.uv_faces[left], face_regions=anny.face_regions[left])
    assert (mirror_triangles(half) == -1).all()


# Completion -----------------------------------------------------------------------------------------------------------


def test_seen_colors_are_untouched(anny):
    random = torch.Generator().manual_seed(2)
    colors = torch.rand(len(anny.faces), 3, generator=random)
    seen = (torch.rand(len(anny.faces), generator=random) > 0.5).float()
    light = torch.randn(9, 3, generator=random)
    for given in (None, light):
        completed = complete_colors(anny, anny.template, seen, colors, light=given)
        assert torch.equal(completed[seen == 1], colors[seen == 1])


def test_an_unseen_side_gets_the_mirror_images_colors(anny):
    """A mole on one cheek appears on the other, which the camera did not see."""
    colors = _painted(anny)
    middles = _middles(anny)
    away = (middles - torch.tensor([0.045, -0.03, 0.08])).norm(dim=1)
    mole = head_parts(anny).face & (away < away[head_parts(anny).face].kthvalue(12).values)
    assert mole.sum() > 5
    colors[mole] = torch.tensor([0.4, 0.25, 0.2])
    seen = (middles[:, 0] > -0.01).float()
    completed = complete_colors(anny, anny.template, seen, torch.where(seen[:, None] > 0, colors, 0.5))
    images = mirror_triangles(anny)[mole]
    assert (completed[images] - colors[mole]).abs().max() < 0.02


def test_no_border_shows_if_one_side_is_lit_less(anny):
    """The left is brighter than the right. Where neither side is on the midline, the step between both is small."""
    middles = _middles(anny)
    face = head_parts(anny).face
    lit = torch.tensor(_SKIN) * (1 + 3 * middles[:, :1].clamp(-0.07, 0.07))
    seen = (middles[:, 0] > -0.03).float()
    completed = complete_colors(anny, anny.template, seen, torch.where(seen[:, None] > 0, lit, 0.5))
    border = face & (middles[:, 0] < -0.03) & (middles[:, 0] > -0.04)
    assert (completed - lit)[border].abs().mean() < 0.03
    mirrored_only = (lit[mirror_triangles(anny)] - lit)[border].abs().mean()
    assert mirrored_only > 0.1


@pytest.mark.parametrize("source", ["anny", "flame", "flame with regions"])
def test_hair_skin_and_neck_from_a_front_view(source, anny, flame):
    """The back of the head takes hair's colour and not skin's, the neck takes skin's and not the collar's."""
    model = anny if source == "anny" else flame if source == "flame" else with_regions_by_landmarks(flame)
    parts, middles, colors = head_parts(model), _middles(model), _painted(model)
    colors[parts.neck & (middles[:, 1] < -0.15)] = torch.tensor(_SHIRT)
    seen = (middles[:, 2] > 0.03).float()
    assert (parts.scalp & (seen == 1)).any()
    completed = complete_colors(model, model.template, seen, torch.where(seen[:, None] > 0, colors, 0.9))
    back = parts.scalp & (seen == 0)
    assert back.sum() > 100
    assert (completed[back] - torch.tensor(_HAIR)).abs().max() < 0.05
    nape = parts.neck & (seen == 0) & (middles[:, 1] > -0.12)
    assert (completed[nape] - torch.tensor(_SKIN)).abs().mean() < 0.05


def test_everything_unseen_is_filled_and_damage_does_not_spread(anny):
    colors = _painted(anny)
    seen = (_middles(anny)[:, 2] > 0.05).float()
    colors[seen == 0] = torch.nan
    colors[7], seen[7] = torch.nan, 1.0
    colors[8], seen[8] = torch.inf, 0.5
    seen[9] = torch.nan
    completed = complete_colors(anny, anny.template, seen, colors, texture=1.0)
    assert completed.isfinite().all()
    assert (completed >= 0).all()
    assert (completed <= 1).all()
    sound = (seen == 1) & (torch.arange(len(seen)) != 7)
    assert torch.equal(completed[sound], colors[sound])


def test_nothing_seen_at_all_is_still_filled(anny):
    completed = complete_colors(
        anny, anny.template, torch.zeros(len(anny.faces)), torch.full((len(anny.faces), 3), 0.5)
    )
    assert completed.isfinite().all()


def test_light_is_taken_out_before_mirroring_and_put_back(anny):
    """A head of one colour in a lamp from its left: the side that is not seen is as dark as the lamp leaves it."""
    light = torch.zeros(9, 3)
    light[0], light[3] = 3.2, 1.2
    shading = shade(triangle_geometry(anny.template, anny.faces)[2], light)
    if float(shading[_middles(anny)[:, 0] > 0.05].mean()) < float(shading[_middles(anny)[:, 0] < -0.05].mean()):
        light[3] = -light[3]
        shading = shade(triangle_geometry(anny.template, anny.faces)[2], light)
    truth = (torch.tensor(_SKIN) * shading.clamp_min(0.1)).clamp(0, 1)
    seen = (_middles(anny)[:, 0] > 0).float()
    outside = head_parts(anny).face & (seen == 0)
    given = torch.where(seen[:, None] > 0, truth, 0.5)
    error = [
        (complete_colors(anny, anny.template, seen, given, light=known) - truth)[outside].abs().mean()
        for known in (None, light)
    ]
    assert error[1] < 0.5 * error[0]


def test_a_mouth_that_was_not_seen_is_dark_with_light_teeth(anny):
    parts, middles = head_parts(anny), _middles(anny)
    seen = ((middles[:, 2] > 0.03) & ~parts.interior).float()
    completed = complete_colors(anny, anny.template, seen, _painted(anny))
    luminance = completed.mean(1)
    front = middles[:, 2] > 0.09
    assert luminance[parts.teeth & front].mean() > 0.45
    assert luminance[parts.mouth].max() < 0.3
    assert luminance[parts.mouth & (middles[:, 2] < 0.04)].max() < 0.08
    teeth_in_depth = parts.teeth & (middles[:, 2] < 0.06)
    assert luminance[teeth_in_depth].mean() < 0.5 * luminance[parts.teeth & front].mean()
    tongue = completed[parts.tongue]
    assert (tongue[:, 0] > 1.3 * tongue[:, 1]).all()


def test_vertices_get_the_mean_of_their_triangles(anny):
    colors = _painted(anny)
    vertices = vertex_means(anny, colors)
    inside = head_parts(anny).face
    assert torch.allclose(vertices[anny.faces[inside]].amax(), torch.tensor(_SKIN[0]))
    assert vertices.isfinite().all()
    around = (anny.faces == anny.faces[100, 0]).any(1)
    assert torch.allclose(vertices[anny.faces[100, 0]], colors[around].mean(0), atol=1e-6)
