"""The boxes of eyes and mouth enclose what the camera sees of them, and are missing where it sees nothing."""

import math
from dataclasses import replace

import pytest
import torch

from mien.camera import Camera, camera_from_fov
from mien.face import FaceModel, part_boxes
from mien.rotation import matrix_from_axis_angle
from small_face_model import make_small_face_model

CAMERA = camera_from_fov(0.5, 200, 160, torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])))


@pytest.fixture(scope="module")
def face_model() -> FaceModel:
    """Return the small head with lips: its triangles in front, 3 to 6 cm below the middle."""
    model = make_small_face_model()
    middle = model.template[model.faces].mean(1)
    regions = model.face_regions.clone()
    regions[(middle[:, 2] > 0.06) & (middle[:, 1] < -0.03) & (middle[:, 1] > -0.06)] = 2
    return replace(model, region_names=("skin", "eyes", "lips"), face_regions=regions)


def placed(face_model: FaceModel, yaw: float = 0.0, shift: tuple[float, float, float] = (0, 0, -0.6)) -> torch.Tensor:
    turn = matrix_from_axis_angle(torch.tensor([0.0, yaw, 0.0]))
    return face_model.template @ turn.T + torch.tensor(shift)


@pytest.mark.parametrize(("part", "region"), [("eyes", "eyes"), ("mouth", "lips")])
def test_boxes_enclose_the_regions_with_a_margin(face_model: FaceModel, part: str, region: str) -> None:
    vertices = placed(face_model)
    points, _ = CAMERA.project(vertices[face_model.faces[face_model.region_mask(region)].unique()])
    left, top, width, height = part_boxes(face_model, vertices, CAMERA)[part]
    seen_width = float(points[:, 0].max() - points[:, 0].min())
    assert 1.2 * seen_width < width < 1.5 * seen_width
    assert left < float(points[:, 0].min()) - 0.1 * seen_width
    assert top < float(points[:, 1].min()) - 0.1 * seen_width
    assert top + height > float(points[:, 1].max()) + 0.1 * seen_width


def test_parts_that_face_away_or_are_outside_are_missing(face_model: FaceModel) -> None:
    assert part_boxes(face_model, placed(face_model, yaw=0.8), CAMERA).keys() == {"eyes", "mouth"}
    assert part_boxes(face_model, placed(face_model, yaw=math.pi / 2), CAMERA) == {}
    assert part_boxes(face_model, placed(face_model, yaw=math.pi), CAMERA) == {}
    assert part_boxes(face_model, placed(face_model, shift=(0, 0, 0.6)), CAMERA) == {}, "behind the camera"
    assert part_boxes(face_model, placed(face_model, shift=(0.3, 0, -0.6)), CAMERA) == {}, "beside the picture"
    assert part_boxes(face_model, placed(face_model, shift=(0, 0, -9)), CAMERA) == {}, "too far away"


def test_boxes_are_cut_at_the_border(face_model: FaceModel) -> None:
    boxes = part_boxes(face_model, placed(face_model, shift=(0.14, 0, -0.6)), CAMERA)
    left, _, width, _ = boxes["mouth"]
    assert left + width == CAMERA.width


def test_a_model_without_regions_has_no_parts(face_model: FaceModel) -> None:
    plain = replace(face_model, region_names=("skin", "a", "b"))
    assert part_boxes(plain, placed(plain), CAMERA) == {}


def test_boxes_grow_with_the_picture(face_model: FaceModel) -> None:
    large: Camera = CAMERA.resized(2 * CAMERA.width, 2 * CAMERA.height)
    small = part_boxes(face_model, placed(face_model), CAMERA)
    for name, box in part_boxes(face_model, placed(face_model), large).items():
        assert all(abs(2 * a - b) <= 2 for a, b in zip(small[name], box, strict=True))
