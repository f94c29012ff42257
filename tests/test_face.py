"""The anny head moves as an anatomist would expect, and is repaired where its source is weak."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from mien.camera import camera_from_fov
from mien.face import FaceModel, FaceParams, load_face_model
from mien.face.models import anny_identity
from mien.face.models.anny_identity import principal_components
from mien.render.mesh import rasterize_mesh
from mien.rotation import matrix_from_axis_angle, rigid_transform
from mien.tracking.neck_line import bottom_vertices

# Float32 positions of a head are exact to about 1e-8 m; several sums make it 1e-6.
TOLERANCE = 2e-6


model = pytest.fixture(scope="module")(lambda: load_face_model("anny"))


def posed(model: FaceModel, identity: Tensor | None = None, **values: float | tuple[float, float, float]) -> FaceParams:
    """Return a face with these expressions (a number each) and joints (an axis-angle each), by name."""
    face = model.neutral()
    for name, value in values.items():
        if isinstance(value, tuple):
            face.joints[0, model.free_joint_names.index(name)] = torch.tensor(value)
        else:
            face.expression[0, model.expression_names.index(name)] = value
    return face if identity is None else replace(face, identity=identity)


def vertices_of(model: FaceModel, *regions: str) -> Tensor:
    return torch.unique(model.faces[model.region_mask(*regions)])


def joint_vertices(model: FaceModel, joint: str) -> Tensor:
    return (model.skinning_weights[:, model.joint_names.index(joint)] > 0.5).nonzero()[:, 0]


def rigid_residual(source: Tensor, target: Tensor) -> float:
    a, b = source - source.mean(0), target - target.mean(0)
    u, _, vt = torch.linalg.svd(a.double().T @ b.double())
    sign = torch.diag(torch.tensor([1.0, 1.0, torch.det(u @ vt).sign().item()], dtype=torch.float64))
    return float((a.double() @ (u @ sign @ vt) - b).norm(dim=1).max())


def someone(model: FaceModel, seed: int = 0) -> Tensor:
    return torch.randn(model.identity_basis.shape[0], generator=torch.Generator().manual_seed(seed))


def test_shapes_sizes_and_windings_are_the_documented_ones(model):
    v = len(model.template)
    assert 4000 < v < 5000
    assert 8000 < len(model.faces) < 9500
    assert len(model.expression_names) == 52
    assert 60 <= len(model.identity_basis) <= 100
    assert set(model.face_regions.tolist()) == set(range(len(model.region_names)))
    assert model.free_joint_names == ("neck", "left_eye", "right_eye")
    torch.testing.assert_close(model.skinning_weights.sum(1), torch.ones(v), atol=1e-5, rtol=0)
    assert (model.skinning_weights >= 0).all()
    assert (model.expression_bounds[:, 0] <= model.expression_bounds[:, 1]).all()
    assert 0 <= model.uv.min() < model.uv.max() <= 1
    assert len(torch.unique(model.faces)) == v
    # The head frame begins between the ears, and the mean head is symmetric.
    left, right = (model.joint_template[model.joint_names.index(f"{side}_eye")] for side in ("left", "right"))
    torch.testing.assert_close((left + right) / 2, torch.tensor([0, 0, 0.08]), atol=TOLERANCE, rtol=0)
    assert 0.055 < left[0] - right[0] < 0.07
    template = model.template.double()  # in float32, differences of nearly equal points are noise
    assert torch.cdist(template * torch.tensor([-1.0, 1.0, 1.0]), template).min(1).values.max() < 1e-5
    corners = model.template[model.faces]
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    for joint in ("left_eye", "right_eye"):
        ball = torch.isin(model.faces, joint_vertices(model, joint)).all(1)
        outward = corners[ball].mean(1) - model.joint_template[model.joint_names.index(joint)]
        assert ((normals[ball] * outward).sum(1) > 0).all()
    scalp = model.region_mask("scalp")
    # The folds behind the ears may look inwards.
    assert ((normals[scalp] * corners[scalp].mean(1)).sum(1) > 0).float().mean() > 0.97
    # The texture is not mirrored either, and does not overlap.
    a, b, c = model.uv[model.uv_faces].unbind(1)
    doubled_areas = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    assert (doubled_areas > 0).float().mean() > 0.995
    lips, brows = (model.uv[model.uv_faces[model.region_mask(name)]] for name in ("lips", "brows"))
    assert brows[..., 1].min() > lips[..., 1].max()


def test_lower_teeth_follow_the_jaw_rigidly_and_the_tongue_lies_below_the_upper_ones(model):
    identity = someone(model)
    rest, opened = (model(posed(model, identity, jawOpen=value))[0] for value in (0.0, 1.0))
    teeth = vertices_of(model, "teeth")
    lower = teeth[torch.isin(teeth, joint_vertices(model, "jaw"))]
    upper = teeth[~torch.isin(teeth, lower)]
    assert len(lower) == len(upper) == 68
    assert rigid_residual(rest[lower], opened[lower]) < TOLERANCE
    torch.testing.assert_close(opened[upper], rest[upper], atol=TOLERANCE, rtol=0)
    # Opening wide lowers the front teeth by about 3 cm, and the lower lip with them.
    front = lower[rest[lower][:, 2].argmax()]
    assert -0.040 < (opened - rest)[front, 1] < -0.015
    lips = vertices_of(model, "lips")
    lowest = lips[rest[lips][:, 1].argmin()]
    assert ((opened - rest)[front] - (opened - rest)[lowest]).norm() < 0.012
    # Expressions alone move the jaw, and no other joint.
    jaw = model.joint_names.index("jaw")
    assert not model.joint_free[jaw]
    amounts = model.joint_rotation_basis.abs().sum((1, 2)) + model.joint_translation_basis.abs().sum((1, 2))
    moving = {name for name, amount in zip(model.expression_names, amounts, strict=True) if amount > 0}
    assert moving == {"jawOpen", "jawForward", "jawLeft", "jawRight"}
    assert not model.joint_rotation_basis[:, torch.arange(len(model.joint_names)) != jaw].any()
    teeth = vertices_of(model, "teeth")
    upper = model.template[teeth[model.skinning_weights[teeth, model.joint_names.index("jaw")] < 0.5]]
    tongue = model.template[vertices_of(model, "tongue")]
    assert tongue[:, 1].max() < upper[:, 1].min()
    assert tongue[:, 2].max() < upper[:, 2].max() - 0.008
    # The collar has no steps: each vertex lies between its two neighbours. A step would be a corner.
    points = model.template[bottom_vertices(model)]
    distance = torch.cdist(points, points).fill_diagonal_(torch.inf)
    first, second = (points[index] for index in distance.topk(2, largest=False).indices.T)
    assert torch.nn.functional.cosine_similarity(first - points, second - points, dim=1).max() < -0.9
    assert points[:, 0].abs().max() < 0.11


@pytest.mark.parametrize("side", ["left_eye", "right_eye"])
def test_an_eye_turns_about_its_own_center(model, side):
    identity = 1.5 * someone(model, seed=3)
    rest, turned = model(posed(model, identity))[0], model(posed(model, identity, **{side: (0.1, 0.4, 0.0)}))[0]
    ball = joint_vertices(model, side)
    # The pivot's basis is rounded to a micrometre, 80 times over.
    torch.testing.assert_close(turned[ball].mean(0), rest[ball].mean(0), atol=1e-5, rtol=0)
    assert rigid_residual(rest[ball], turned[ball]) < TOLERANCE
    irises = vertices_of(model, "irises")
    # A positive turn about +y looks to the subject's left, one about +x down.
    moved = (turned - rest)[irises[torch.isin(irises, ball)]].mean(0)
    assert moved[0] > 0.004
    assert moved[1] < -0.001
    others = torch.ones(len(rest), dtype=torch.bool)
    others[ball] = False
    assert (turned - rest)[others].norm(dim=1).max() < 0.004
    far = others & ((rest - rest[ball].mean(0)).norm(dim=1) > 0.06)
    torch.testing.assert_close(turned[far], rest[far], atol=TOLERANCE, rtol=0)


def test_lids_follow_the_gaze_and_a_full_blink_closes_the_eye_and_no_more(model):
    ahead, down, up = (model(posed(model, left_eye=(a, 0.0, 0.0), right_eye=(a, 0.0, 0.0)))[0] for a in (0, 0.3, -0.3))
    lids = vertices_of(model, "eyelids")
    upper = lids[(ahead[lids][:, 1] > 0.003) & (ahead[lids][:, 2] > 0.085)]
    assert (down - ahead)[upper, 1].mean() < -0.0015
    assert (up - ahead)[upper, 1].mean() > 0.0005
    looks = [i for i, name in enumerate(model.expression_names) if name.startswith("eyeLook")]
    assert not model.expression_basis[looks].any()
    pinned = [i for i, name in enumerate(model.expression_names) if name.startswith(("mouthClose", "tongueOut"))]
    assert not model.expression_bounds[looks + pinned].any()
    assert model.expression_bounds[model.expression_names.index("eyeWideLeft"), 1] == 1.5
    # The neck moves its base, and not the face.
    rest, bent = model(posed(model))[0], model(posed(model, neck=(0.3, 0.0, 0.0)))[0]
    edges = torch.cat([model.faces[:, [0, 1]], model.faces[:, [1, 2]], model.faces[:, [2, 0]]]).sort(1).values
    unique, counts = torch.unique(edges, dim=0, return_counts=True)
    border = torch.unique(unique[counts == 1])
    base = border[rest[border][:, 1] < -0.1]
    assert len(base) > 30
    assert model.skinning_weights[:, model.joint_names.index("neck")][base].min() > 0.98
    assert rigid_residual(rest[base], bent[base]) < 1e-4
    face = vertices_of(model, "lips", "eyes", "nose", "ears", "teeth", "tongue")
    torch.testing.assert_close(bent[face], rest[face], atol=TOLERANCE, rtol=0)
    ahead, nearly, full = (model(posed(model, eyeBlinkLeft=amount, eyeBlinkRight=amount))[0] for amount in (0, 0.85, 1))
    opened = _seen_of_eyes(model, ahead)
    assert opened > 5000
    assert 0.01 * opened < _seen_of_eyes(model, nearly) < 0.1 * opened
    assert _seen_of_eyes(model, full) < 0.001 * opened
    marks = model.landmark_positions(full, "mediapipe")
    upper, lower = marks[[387, 386, 385, 160, 159, 158], 1], marks[[373, 374, 380, 144, 145, 153], 1]
    assert (upper - lower).min() > -0.0006  # they do not run through each other


def test_landmarks_lie_on_the_right_places(model):
    for marks in model.landmarks.values():
        assert (marks.barycentric >= 0).all()
        torch.testing.assert_close(marks.barycentric.sum(1), torch.ones(len(marks.faces)), atol=2e-4, rtol=0)
    mediapipe = model.landmarks["mediapipe"]
    on_eyes = model.region_mask("eyes", "irises")[mediapipe.faces]
    assert on_eyes.nonzero()[:, 0].tolist() == list(range(468, 478))
    points = model.landmark_positions(model.template, "mediapipe")
    # MediaPipe: 468 and 473 are the centres of the subject's right and left iris.
    for center, side in ((468, "right"), (473, "left")):
        eye = model.joint_template[model.joint_names.index(f"{side}_eye")]
        assert (points[center] - eye)[:2].norm() < 0.002
        rims = (points[center + 1 : center + 5] - points[center]).norm(dim=1)
        assert 0.004 < rims.min() < rims.max() < 0.008
    assert model.region_mask("lips")[mediapipe.faces[[0, 17, 13, 14, 61, 291]]].sum() >= 4
    assert points[:, 2].min() > 0
    distance = torch.cdist(points * torch.tensor([-1.0, 1.0, 1.0]), points).min(1).values
    assert distance.median() < 0.001
    assert distance.max() < 0.005


def _seen_of_eyes(model: FaceModel, vertices: Tensor) -> int:
    """Count the pixels of 0.15 mm that show an eye."""
    view = rigid_transform(torch.diag(torch.tensor([1.0, -1.0, -1.0])), torch.tensor([0.0, 0.0, 0.7]))
    found = rasterize_mesh(vertices, model.faces, camera_from_fov(0.18, 768, 768, view)).face_index
    eyes = model.region_mask("eyes", "irises").nonzero()[:, 0]
    return int(torch.isin(found, eyes.to(found.dtype)).sum())


DIRECTIONS = 4


@pytest.fixture
def points(monkeypatch):
    """Return a symmetric cloud whose vertex i mirrors onto i ^ 1."""
    monkeypatch.setattr(anny_identity, "ANNY_COMPONENTS", 2 * DIRECTIONS)
    half = np.random.default_rng(0).normal(size=(20, 3)) * 0.05
    return np.stack([half, half * [-1, 1, 1]], axis=1).reshape(-1, 3)


def people_from(points: np.ndarray, move: bool) -> np.ndarray:
    random = np.random.default_rng(1)
    basis = random.normal(size=(DIRECTIONS, *points.shape)) * np.array([4e-3, 3e-3, 2e-3, 1e-3])[:, None, None]
    people = points * (1 + 0.04 * random.normal(size=(300, 1, 1)))
    people = people + np.tensordot(random.normal(size=(300, DIRECTIONS)), basis, axes=1)
    if not move:
        return people
    about_y = 0.05 * random.normal(size=(300, 1)) * [0.0, 1.0, 0.0]
    turns = matrix_from_axis_angle(torch.from_numpy(about_y)).numpy()
    return people @ turns + 0.1 * random.normal(size=(300, 1, 3))


def fit(points, move):
    even = np.ones(len(points))
    return principal_components(people_from(points, move), np.arange(len(points)) ^ 1, even, even)


def test_rigid_motion_does_not_count_and_scale_does(points):
    (_, still), (mean, moved) = fit(points, move=False), fit(points, move=True)
    np.testing.assert_allclose(np.linalg.norm(moved), np.linalg.norm(still), rtol=0.05)
    growth = (points / np.linalg.norm(points)).ravel()
    assert np.linalg.norm(still.reshape(len(still), -1) @ growth) > 0.8 * 0.04 * np.linalg.norm(points)
    np.testing.assert_allclose(mean[np.arange(len(points)) ^ 1] * [-1, 1, 1], mean, atol=1e-6)
    # Coefficients have unit variance.
    (mean, basis), people = fit(points, move=False), people_from(points, move=False)
    everyone = np.concatenate([people, people[:, np.arange(len(points)) ^ 1] * [-1, 1, 1]])
    everyone = anny_identity.align(everyone, mean, np.ones(len(points)))
    flat, varied = basis.reshape(len(basis), -1), (everyone - mean).reshape(len(everyone), -1)
    coefficients = varied @ np.linalg.pinv(flat)
    np.testing.assert_allclose(coefficients.std(0), 1, atol=0.02)
    np.testing.assert_allclose(np.corrcoef(coefficients.T), np.eye(len(flat)), atol=0.05)
    assert (varied - coefficients @ flat).var() < 0.05 * varied.var(), "they explain the people"
