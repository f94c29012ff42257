"""Hair that hangs beside the neck in the pictures hangs behind it as well."""

import pytest
import torch

from mien.camera import camera_from_fov
from mien.face import FaceModel
from mien.face.head_parts import head_parts
from mien.face.mirror import triangle_geometry
from mien.tracking import NeckParts, fit_neck_cut
from mien.tracking.neck_cut import above_neck_cut
from mien.training.whole_head.back_hair import back_hair

_HAIR = 0.02


def _beside(model: FaceModel, *, low: float = -1.0, left: float = 0.05, right: float = 0.05) -> torch.Tensor:
    """Heights beside skin and neck as `hanging_hair` measures them, from the scalp down to a level."""
    middles, parts = model.template[model.faces].mean(1), head_parts(model)
    hanging = torch.where(middles[:, 0] > 0, left, right)
    return torch.where((parts.skin | parts.neck) & (middles[:, 1] > low), hanging, 0.0)


def _back_hair(model: FaceModel, hanging: torch.Tensor, hair: float = _HAIR) -> torch.Tensor:
    return back_hair(model, model.template, hair * head_parts(model).scalp.float(), hanging)


def test_long_hair_falls_from_the_widest_part_of_the_head(anny):
    middles, _, normals = triangle_geometry(anny.template, anny.faces)
    found = _back_hair(anny, _beside(anny))
    nape = (found > 0) & (normals[:, 2] < -0.8) & (middles[:, 0].abs() < 0.02)
    assert int(nape.sum()) > 10
    scalp = middles[head_parts(anny).scalp]
    axis = (scalp[:, 2].min() + scalp[:, 2].max()) / 2
    back = axis - (scalp[:, 2].min() - _HAIR)
    behind = axis - (middles + found[:, None] * normals)[nape, 2]
    level = middles[nape, 1] > middles[nape, 1].median()
    assert (behind[level] - back).abs().median() < 0.006


def test_nothing_hangs_in_front(anny):
    normals = triangle_geometry(anny.template, anny.faces)[2]
    found = _back_hair(anny, _beside(anny))
    assert not found[normals[:, 2] >= 0].any()
    assert not found[head_parts(anny).face].any()


@pytest.mark.parametrize(
    "hanging",
    [{"left": 0.0, "right": 0.0}, {"left": 0.05, "right": 0.005}, {"low": 1.0}],
    ids=["short hair", "one side", "nothing"],
)
def test_hair_that_does_not_hang_at_both_sides_has_no_back_hair(anny, hanging):
    assert not _back_hair(anny, _beside(anny, **hanging)).any()


def test_a_collar_below_a_bare_neck_is_no_hair(anny):
    """Shoulders stand out beside the lowest part of the neck, with nothing between them and the scalp."""
    middles = anny.template[anny.faces].mean(1)
    collar = torch.where(middles[:, 1] < -0.11, _beside(anny), 0.0)
    assert not _back_hair(anny, collar).any()


def test_hair_hangs_as_far_down_as_at_the_sides(anny):
    middles = anny.template[anny.faces].mean(1)
    shorter, longer = (_back_hair(anny, _beside(anny, low=low)) for low in (-0.09, -1.0))
    assert float(middles[longer > 0][:, 1].min()) < float(middles[shorter > 0][:, 1].min()) - 0.01


def test_no_hair_hangs_below_the_cut(anny):
    found = _back_hair(anny, _beside(anny))
    middles, _, normals = triangle_geometry(anny.template, anny.faces)
    cut = fit_neck_cut(NeckParts.of(anny), anny.template, torch.tensor([0.0, 1.0, 0.0]))
    assert (cut.margins((middles + found[:, None] * normals)[found > 0]) > 0).all()


def test_margins_are_those_of_pictures(anny):
    """A camera sees what is cut off where the margin of the points nearest to the neck's axis is negative."""
    cut = fit_neck_cut(NeckParts.of(anny), anny.template, torch.tensor([0.0, 1.0, 0.0]))
    camera = camera_from_fov(0.5, 128, 128, torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])))
    camera.viewmat[2, 3] = 1.0
    origin = torch.from_numpy(cut.origin).float()
    for offset in ([0.09, 0.02, 0.0], [0.09, 0.12, 0.0], [0.07, -0.02, 0.0]):
        point = (origin + torch.tensor(offset))[None]
        column, row = camera.project(point)[0][0].floor().int().tolist()
        assert (float(cut.margins(point)) > 0) == (above_neck_cut(cut, camera)[row, column] > 0.5)


def test_a_bald_head_has_no_back_hair(anny):
    assert not _back_hair(anny, _beside(anny), hair=0.0).any()
