"""The anny head moves as an anatomist would expect."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from mien.face import FaceModel, FaceParams, load_face_model

PARTITION_TOLERANCE = 1e-5
# Float32 positions of a head are exact to about 1e-8 m; several sums make it 1e-6.
TOLERANCE = 2e-6


@pytest.fixture(scope="module")
def model() -> FaceModel:
    return load_face_model("anny")


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


def test_contract(model):
    """The head has the documented shapes and sizes."""
    v, f, e, k = len(model.template), len(model.faces), len(model.expression_names), len(model.joint_names)
    assert 4000 < v < 5000
    assert 8000 < f < 9500
    assert e == 52
    assert model.expression_basis.shape == (e, v, 3)
    assert 60 <= model.identity_basis.shape[0] <= 100
    assert model.face_regions.shape == (f,)
    assert set(model.face_regions.tolist()) == set(range(len(model.region_names)))
    assert model.joint_identity_basis.shape == (model.identity_basis.shape[0], k, 3)
    assert model.pose_basis is not None
    assert model.pose_basis.shape[0] == 9 * len(model.free_joint_names)
    assert model.free_joint_names == ("neck", "left_eye", "right_eye")
    torch.testing.assert_close(model.skinning_weights.sum(1), torch.ones(v), atol=PARTITION_TOLERANCE, rtol=0)
    assert (model.skinning_weights >= 0).all()
    assert (model.expression_bounds[:, 0] <= model.expression_bounds[:, 1]).all()
    assert model.uv.min() >= 0
    assert model.uv.max() <= 1
    assert len(torch.unique(model.faces)) == v


def test_head_frame(model):
    """The head frame has its origin between the ears, with +x left, +y up and +z ahead."""
    left, right = (model.joint_template[model.joint_names.index(f"{side}_eye")] for side in ("left", "right"))
    torch.testing.assert_close((left + right) / 2, torch.tensor([0, 0, 0.08]), atol=TOLERANCE, rtol=0)
    assert 0.055 < left[0] - right[0] < 0.07
    assert model.template[vertices_of(model, "nose")][:, 2].max() > 0.1
    assert model.template[vertices_of(model, "scalp")][:, 1].max() > 0.1
    assert model.template[vertices_of(model, "neck")][:, 1].min() < -0.13


def test_faces_are_counter_clockwise_seen_from_outside(model):
    corners = model.template[model.faces]
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    for joint in ("left_eye", "right_eye"):
        ball = torch.isin(model.faces, joint_vertices(model, joint)).all(1)
        outward = corners[ball].mean(1) - model.joint_template[model.joint_names.index(joint)]
        assert ((normals[ball] * outward).sum(1) > 0).all()
    scalp = model.region_mask("scalp")
    # The folds behind the ears may look inwards.
    assert ((normals[scalp] * corners[scalp].mean(1)).sum(1) > 0).float().mean() > 0.97


def test_texture_is_not_mirrored_and_does_not_overlap(model):
    a, b, c = model.uv[model.uv_faces].unbind(1)
    doubled_areas = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    assert (doubled_areas > 0).float().mean() > 0.995
    lips = model.uv[torch.unique(model.uv_faces[model.region_mask("lips")])]
    brows = model.uv[torch.unique(model.uv_faces[model.region_mask("brows")])]
    assert brows[:, 1].min() > lips[:, 1].max()


def test_mean_head_is_symmetric(model):
    template = model.template.double()  # in float32, differences of nearly equal points are noise
    mirrored = template * torch.tensor([-1.0, 1.0, 1.0])
    assert torch.cdist(mirrored, template).min(1).values.max() < 1e-5


def test_lower_teeth_follow_the_jaw_rigidly(model):
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


def test_the_jaw_has_no_free_parameter(model):
    jaw = model.joint_names.index("jaw")
    assert not model.joint_free[jaw]
    moving = {
        name
        for index, name in enumerate(model.expression_names)
        if (model.joint_rotation_basis[index].abs().sum() + model.joint_translation_basis[index].abs().sum()) > 0
    }
    assert moving == {"jawOpen", "jawForward", "jawLeft", "jawRight"}
    others = model.joint_rotation_basis[:, [i for i in range(len(model.joint_names)) if i != jaw]]
    assert not others.any()


@pytest.mark.parametrize("side", ["left_eye", "right_eye"])
def test_an_eye_turns_about_its_own_center(model, side):
    identity = 1.5 * someone(model, seed=3)
    rest, turned = model(posed(model, identity))[0], model(posed(model, identity, **{side: (0.1, 0.4, 0.0)}))[0]
    ball = joint_vertices(model, side)
    # The pivot's basis is rounded to a micrometre, 80 times over.
    torch.testing.assert_close(turned[ball].mean(0), rest[ball].mean(0), atol=1e-5, rtol=0)
    assert rigid_residual(rest[ball], turned[ball]) < TOLERANCE
    irises = vertices_of(model, "irises")
    iris = irises[torch.isin(irises, ball)]
    # A positive turn about +y looks to the subject's left, one about +x down.
    moved = (turned - rest)[iris].mean(0)
    assert moved[0] > 0.004
    assert moved[1] < -0.001
    others = torch.ones(len(rest), dtype=torch.bool)
    others[ball] = False
    assert (turned - rest)[others].norm(dim=1).max() < 0.004
    around = (rest - rest[ball].mean(0)).norm(dim=1)
    far = others & (around > 0.06)
    torch.testing.assert_close(turned[far], rest[far], atol=TOLERANCE, rtol=0)


def test_lids_follow_the_gaze_and_no_expression_does_it_twice(model):
    lids = vertices_of(model, "eyelids")
    ahead = model(posed(model))[0]
    down, up = (model(posed(model, left_eye=(a, 0.0, 0.0), right_eye=(a, 0.0, 0.0)))[0] for a in (0.3, -0.3))
    upper = lids[(ahead[lids][:, 1] > 0.003) & (ahead[lids][:, 2] > 0.085)]
    assert (down - ahead)[upper, 1].mean() < -0.0015
    assert (up - ahead)[upper, 1].mean() > 0.0005
    for index, name in enumerate(model.expression_names):
        if name.startswith("eyeLook"):
            assert not model.expression_basis[index].any()
            assert torch.equal(model.expression_bounds[index], torch.zeros(2))


def test_pinned_expressions(model):
    """Pinned expressions are bounded to 0."""
    for name in ("mouthClose", "tongueOut"):
        assert torch.equal(model.expression_bounds[model.expression_names.index(name)], torch.zeros(2))
    assert model.expression_bounds[model.expression_names.index("eyeWideLeft"), 1] == 1.5


def test_the_neck_moves_its_base_and_not_the_face(model):
    rest, bent = model(posed(model))[0], model(posed(model, neck=(0.3, 0.0, 0.0)))[0]
    edges = torch.cat([model.faces[:, [0, 1]], model.faces[:, [1, 2]], model.faces[:, [2, 0]]]).sort(1).values
    unique, counts = torch.unique(edges, dim=0, return_counts=True)
    border = torch.unique(unique[counts == 1])
    base = border[rest[border][:, 1] < -0.1]
    assert len(base) > 30
    weight = model.skinning_weights[:, model.joint_names.index("neck")]
    assert weight[base].min() > 0.98
    assert rigid_residual(rest[base], bent[base]) < 1e-4
    face = vertices_of(model, "lips", "eyes", "nose", "ears", "teeth", "tongue")
    torch.testing.assert_close(bent[face], rest[face], atol=TOLERANCE, rtol=0)


def test_extreme_identities_stay_heads(model):
    for component in range(10):
        for value in (-2.5, 2.5):
            identity = torch.zeros(len(model.identity_basis))
            identity[component] = value
            rest = model(posed(model, identity))[0]
            transforms = model.joint_transforms(posed(model, identity))
            torch.testing.assert_close(transforms[0], torch.eye(4).expand(5, 4, 4), atol=TOLERANCE, rtol=0)
            for side in ("left_eye", "right_eye"):
                ball = joint_vertices(model, side)
                radii = (rest[ball] - rest[ball].mean(0)).norm(dim=1)
                assert radii.min() > 0.009
                assert radii.max() < 0.02
            assert 0.2 < rest[:, 1].max() - rest[vertices_of(model, "neck")][:, 1].min() < 0.5


def test_landmarks_lie_on_the_right_places(model):
    assert {name: len(marks.faces) for name, marks in model.landmarks.items()} == {"mediapipe": 478, "ibug68": 68}
    for marks in model.landmarks.values():
        assert (marks.barycentric >= 0).all()
        torch.testing.assert_close(marks.barycentric.sum(1), torch.ones(len(marks.faces)), atol=2e-4, rtol=0)
    mediapipe = model.landmarks["mediapipe"]
    on_eyes = model.region_mask("eyes", "irises")[mediapipe.faces]
    assert on_eyes[468:].all()
    assert not on_eyes[:468].any()
    points = model.landmark_positions(model.template, "mediapipe")
    eye = {side: model.joint_template[model.joint_names.index(f"{side}_eye")] for side in ("left", "right")}
    # MediaPipe: 468 and 473 are the centres of the subject's right and left iris.
    assert (points[468] - eye["right"])[:2].norm() < 0.002
    assert (points[473] - eye["left"])[:2].norm() < 0.002
    rims = torch.cat([points[469:473] - points[468], points[474:478] - points[473]]).norm(dim=1)
    assert rims.min() > 0.004
    assert rims.max() < 0.008
    assert model.region_mask("lips")[mediapipe.faces[[0, 17, 13, 14, 61, 291]]].sum() >= 4
    assert points[1, 2] > points[:, 2].quantile(0.9)
    assert points[:, 2].min() > 0


def test_landmarks_are_symmetric(model):
    points = model.landmark_positions(model.template, "mediapipe")
    mirrored = points * torch.tensor([-1.0, 1.0, 1.0])
    distance = torch.cdist(mirrored, points).min(1).values
    assert distance.median() < 0.001
    assert distance.max() < 0.005


def test_forward_is_differentiable_and_rigid_in_the_head_pose(model):
    face = posed(model, someone(model), jawOpen=0.3, left_eye=(0.1, 0.0, 0.0))
    pose = replace(
        face, head_rotation=torch.tensor([[0.1, 0.5, -0.2]]), head_translation=torch.tensor([[0.1, 0.2, 3.0]])
    )
    assert rigid_residual(model(face)[0], model(pose)[0]) < 1e-6
    leaves = {name: tensor.clone().requires_grad_() for name, tensor in pose.tensors().items()}
    model(FaceParams(**leaves)).square().sum().backward()
    for leaf in leaves.values():
        assert leaf.grad is not None
        assert torch.isfinite(leaf.grad).all()
        assert leaf.grad.any()
