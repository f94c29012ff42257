"""Faces fitted to pixels and outlines are better than landmarks alone. The native alignment agrees with PyTorch."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

import photometric_case as cases
from mien import _native
from mien.camera import Camera
from mien.render.mesh import Texture as MeshTexture
from mien.render.mesh import interpolate, rasterize_mesh, render_mesh, sample_texture, shade, vertex_normals
from mien.rotation import matrix_from_axis_angle
from mien.tracking import track, track_subject
from mien.tracking.fitting.fit import Subject
from mien.tracking.fitting.parameters import layout_of
from mien.tracking.fitting.views import Views, batch_of
from mien.tracking.pixels.outline import OutlineTerm, edge_distances, outline_term
from mien.tracking.pixels.pictures import Picture
from mien.tracking.pixels.shared import move_like_keyframes
from mien.tracking.pixels.surface import PosedSurface, surface_model
from mien.tracking.pixels.texture import (
    SkinTexture,
    SurfaceView,
    estimate_appearance,
    even_light,
    texture_space,
    unknown_texture,
)
from mien.tracking.report.residuals import residual_report
from mien.tracking.settings import PhotometricSettings, TrackingSettings
from mien.tracking.tracking import Tracking

LANDMARKS = TrackingSettings(focal=cases.FOCAL, schedule="landmarks")
FAST = replace(
    LANDMARKS, schedule="fast",
    photometric=PhotometricSettings(texture_size=128, keyframes=8, shared_steps=1),
)  # fmt: skip


case = pytest.fixture(scope="module")(lambda: cases.make_photometric_case())
by_landmarks = pytest.fixture(scope="module")(lambda case: track(case.capture, case.model, LANDMARKS))


def wobble(case: cases.PhotometricCase, tracking: Tracking) -> float:
    """Return the median deviation of landmarks from their mean error, in pixels."""
    points = case.model.landmark_positions(case.model(tracking.face), "mediapipe")
    error = tracking.cameras[0].project(points)[0] - case.landmarks
    return float((error - error.mean(0)).norm(dim=-1).median())


def turn_error(case: cases.PhotometricCase, tracking: Tracking) -> float:
    """Return the median deviation of the rotation from its mean error, in degrees."""
    turn = matrix_from_axis_angle(tracking.face.head_rotation) @ matrix_from_axis_angle(case.face.head_rotation).mT
    vector = torch.stack([turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]], dim=-1)
    return float((vector - vector.mean(0)).norm(dim=-1).median().rad2deg())


@pytest.mark.unchecked
def test_pixels_calm_what_landmarks_leave(case, by_landmarks, monkeypatch):
    runs = []
    for threads in ("1", "3"):
        monkeypatch.setenv("MIEN_THREADS", threads)
        runs.append(track(case.capture, case.model, FAST))
    cases.assert_alike(*runs)
    by_pixels = runs[0]
    assert wobble(case, by_pixels) < 0.5 * wobble(case, by_landmarks)
    assert turn_error(case, by_pixels) < 0.3
    errors = [float((one.face.expression - case.face.expression).abs().mean()) for one in (by_pixels, by_landmarks)]
    assert errors[0] < errors[1]
    assert by_landmarks.pixel_residuals is None
    assert by_pixels.pixel_residuals.isfinite().all()
    assert 0 < by_pixels.pixel_residuals.median() < 0.06


@pytest.mark.unchecked
def test_pictures_that_show_something_else_fall_back_to_landmarks_and_say_so(case, by_landmarks, capsys):
    images = np.array(case.capture.images)
    images[5] = np.random.default_rng(0).integers(0, 256, images[5].shape, np.uint8)
    mattes = np.array(case.capture.mattes)
    mattes[9] = 0
    found = track(replace(case.capture, images=images, mattes=mattes), case.model, FAST)
    assert found.pixel_residuals is not None
    without = found.pixel_residuals.isnan().all(1).nonzero()[:, 0].tolist()
    assert 9 in without
    assert len(without) <= 3
    printed = capsys.readouterr().err
    assert "fit to landmarks: 9" in printed or "5, 9" in printed
    report = residual_report(case.capture, found, case.model)
    assert report["landmarks_only_frames"] == without
    assert 5 in report["flagged_frames"] or 5 in without
    assert 2 not in report["flagged_frames"]
    kept = [case.model.landmark_positions(case.model(t.face[[5, 9]]), "mediapipe") for t in (found, by_landmarks)]
    assert (kept[0] - kept[1]).norm(dim=-1).median() < 0.003


@pytest.mark.unchecked
def test_sequences_of_one_subject_share_texture_and_identity(case):
    short = cases.make_photometric_case(timesteps=7)
    found = track_subject([case.capture, short.capture], case.model, FAST)
    assert [len(tracking.face) for tracking in found] == [16, 7]
    assert torch.equal(found[0].face.identity, found[1].face.identity)
    for own, tracking in zip((case, short), found, strict=True):
        assert wobble(own, tracking) < 0.2
        assert tracking.pixel_residuals is not None
        assert tracking.pixel_residuals.median() < 0.06


def test_derivatives_of_the_surface_are_those_of_the_face_model():
    model, generator = cases.make_textured_model(), torch.Generator().manual_seed(0)
    model = replace(model, pose_basis=0.002 * torch.randn(27, *model.template.shape, generator=generator))
    layout = layout_of(model)
    state = 0.3 * torch.rand(layout.size, generator=generator, dtype=torch.float64)
    state[3:6] = torch.tensor([0.02, 0.03, -0.8])
    state = torch.minimum(torch.maximum(state, layout.lower), layout.upper)
    identity = torch.randn(len(model.identity_basis), generator=generator, dtype=torch.float64)
    exact = replace(model, joint_identity_basis=0 * model.joint_identity_basis).to(torch.zeros(()).double())

    def vertices(both: torch.Tensor) -> torch.Tensor:
        return exact(layout.face_params(both[None, : layout.size], both[layout.size :]))[0]

    both, posed = torch.cat([state, identity]), surface_model(exact, layout).pose(state, identity, derive_identity=True)
    assert posed.jacobian is not None
    torch.testing.assert_close(posed.vertices.double(), vertices(both), atol=1e-6, rtol=0)
    assert posed.jacobian.shape[2] == len(both)
    for index, step in enumerate(1e-5 * torch.eye(len(both), dtype=torch.float64)):
        expected = (vertices(both + step) - vertices(both - step)) / 2e-5
        difference = (posed.jacobian[..., index] - expected).abs().max()
        assert difference < 2e-4 * expected.abs().max() + 1e-7, index


def term_of(case: cases.PhotometricCase) -> OutlineTerm:
    rows = torch.arange(len(case.face))
    views = Views(case.landmarks.double(), rows, torch.zeros_like(rows), torch.ones(len(rows), dtype=torch.float64))
    return outline_term(surface_model(case.model, layout_of(case.model)), case.capture, rows, views, 10.0)


@pytest.fixture(scope="module")
def short_case() -> cases.PhotometricCase:
    return cases.make_photometric_case(timesteps=8)


def equations_of(case: cases.PhotometricCase, term: OutlineTerm, shift: tuple[float, float] = (0, 0)):
    """Return the equations of the timesteps and of what they share, with the head shifted away from the truth."""
    layout, face = layout_of(case.model), case.face
    expression, joints = face.expression[:, layout.expression_index], face.joints.flatten(1)[:, layout.joint_index]
    state = torch.cat([face.head_rotation, face.head_translation, expression, joints], dim=1).double()
    state[:, 3:5] += torch.tensor(shift)
    subject = Subject(face.identity.double(), torch.zeros(478, 3).double())
    return term.joint_equations(state, torch.arange(len(state)), subject, batch_of((case.camera,)))


def test_the_true_outline_lies_where_the_matte_ends_and_pulls_a_shifted_head_back(short_case):
    for timestep, mesh in enumerate(short_case.model(short_case.face)):
        outline = term_of(short_case).outline(mesh, short_case.camera)
        distances = edge_distances(short_case.capture.mattes[timestep, 0], outline, 8.0)
        assert len(distances) > 20
        assert float(distances.nanmedian().abs()) < 0.3
        assert torch.allclose(outline.normals.norm(dim=1), torch.ones(len(outline.points)), atol=1e-5)
        outwards = ((outline.points - outline.points.mean(0)) * outline.normals).sum(1) > 0
        assert outwards.float().mean() > 0.9
        assert edge_distances(np.full((cases.SIZE, cases.SIZE), 255, np.uint8), outline, 8.0).isnan().all(), (
            "out of reach"
        )
    shift, term = (0.003, -0.002), term_of(short_case)  # 1.2 and 0.8 pixels
    frames, _ = equations_of(short_case, term, shift)
    step = -torch.linalg.solve(frames.hessian[:, 3:5, 3:5], frames.gradient[:, 3:5])
    assert float((torch.tensor(shift) + step).norm(dim=1).mean()) < 0.3 * float(torch.tensor(shift).norm())
    capture = replace(short_case.capture, mattes=np.full_like(short_case.capture.mattes, 255))
    frames, shared = equations_of(short_case, replace(term, capture=capture))
    assert not frames.hessian.any()
    assert not shared.gradient.any()


@pytest.mark.unchecked
def test_outlines_bring_the_focal_length_nearer_the_truth(short_case):
    def focal_error(weight: float) -> float:
        photometric = replace(FAST.photometric, texture_size=64, outline_weight=weight)
        settings = TrackingSettings(photometric=photometric)
        found = float(track(short_case.capture, short_case.model, settings).cameras[0].K[0, 0])
        return abs(np.log(found / float(short_case.camera.K[0, 0])))

    assert focal_error(40.0) < 0.8 * focal_error(0.0)


def test_timesteps_between_keyframes_move_as_these_do():
    random = torch.Generator().manual_seed(4)
    state = torch.randn(40, 9, generator=random, dtype=torch.float64)
    slopes = torch.randn(6, 6, generator=random, dtype=torch.float64)
    step = torch.cat([0.3 + 0.1 * state[:, :6] @ slopes, torch.ones(40, 3).double()], dim=1)
    keyframes = torch.arange(0, 40, 2)
    moved = move_like_keyframes(state, keyframes, step[keyframes])
    assert torch.equal(moved[:, 6:], state[:, 6:])
    wrong = (moved - state - step)[1::2, :6].norm(dim=1)
    assert float(wrong.mean()) < 0.2 * float((step - step.mean(0))[1::2, :6].norm(dim=1).mean())
    moved = move_like_keyframes(state, keyframes, torch.ones_like(state)[keyframes])
    torch.testing.assert_close(moved[:, :6], state[:, :6] + 1)


SIDE, SIGMA, OUTLIER, LEAST_COSINE = 72, 0.07, 2.0, 0.25
MODEL = cases.make_textured_model()
SPACE = texture_space(MODEL, 128)
K = torch.tensor([[110.0, 0, 36.5], [0, 108.0, 35.5], [0, 0, 1]])
CAMERA = Camera(K, torch.diag(torch.tensor([1.0, -1, -1, 1])), SIDE, SIDE)


def posed(shift=(0.004, 0.003, -0.6), yaw: float = 0.0, jacobian: Tensor | None = None) -> PosedSurface:
    turn = matrix_from_axis_angle(torch.tensor([0.0, yaw, 0.0]))
    vertices = (MODEL.template @ turn.T + torch.tensor(shift)).contiguous()
    return PosedSurface(vertices, vertex_normals(vertices, MODEL.faces), jacobian)


def drawn(surface: PosedSurface, skin: SkinTexture, light: Tensor) -> tuple[Tensor, Tensor]:
    """Return the picture of a surface, and where it covers whole pixels."""
    texture = MeshTexture(skin.albedo, SPACE.corners)
    image, alpha = render_mesh(surface.vertices, MODEL.faces, CAMERA, texture, light=light, supersample=3)
    return image, (alpha > 0.99).float()


def reference(seen: SurfaceView, skin: SkinTexture) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return cost, half gradient, half Hessian and residuals by PyTorch in float64, without a high-pass filter."""
    vertices, normals = seen.posed.vertices, seen.posed.normals
    fragments = rasterize_mesh(vertices, MODEL.faces, CAMERA)
    points = interpolate(fragments, vertices, MODEL.faces)
    directions = torch.nn.functional.normalize(interpolate(fragments, normals, MODEL.faces), dim=-1)
    towards = torch.nn.functional.normalize(CAMERA.position - points, dim=-1)
    uv = interpolate(fragments, SPACE.corners, MODEL.faces)
    trust = sample_texture(skin.trust[..., None], uv)
    albedo = sample_texture(skin.albedo * skin.trust[..., None], uv) / trust.clamp_min(1e-9)
    prediction = albedo * shade(directions, seen.light)
    weight = seen.picture.mask * trust[..., 0]
    counts = (fragments.face_index >= 0) & ((directions * towards).sum(-1) >= LEAST_COSINE) & (weight > 0)
    counts &= torch.cat([SPACE.used, torch.tensor([False])])[fragments.face_index.long()]
    counts[[0, -1]], counts[:, [0, -1]] = False, False
    residual = (seen.picture.image - prediction).double()
    square = (residual**2).sum(-1) / SIGMA**2
    fade = OUTLIER**2 / (OUTLIER**2 + square)
    total = weight[counts].double().sum()
    cost = (weight * square * fade)[counts].sum() / total
    image = seen.picture.image.double()
    by_x, by_y = torch.zeros_like(image), torch.zeros_like(image)
    by_x[:, 1:-1], by_y[1:-1] = (image[:, 2:] - image[:, :-2]) / 2, (image[2:] - image[:-2]) / 2
    assert seen.posed.jacobian is not None
    apart = 1e-4 * seen.posed.jacobian.permute(2, 0, 1).double()
    exact, ahead = CAMERA.to(apart), vertices.double()
    columns = [(exact.project(ahead + d)[0] - exact.project(ahead - d)[0]).float() / 2e-4 for d in apart]
    moved = torch.stack([interpolate(fragments, column.contiguous(), MODEL.faces) for column in columns], -1).double()
    by_parameter = by_x[..., None] * moved[..., None, 0, :] + by_y[..., None] * moved[..., None, 1, :]
    scale = (weight * fade**2 / SIGMA**2)[counts] / total
    by_parameter, left = by_parameter[counts], residual[counts]
    hessian = torch.einsum("n,nci,ncj->ij", scale, by_parameter, by_parameter)
    gradient = torch.einsum("n,nci,nc->i", scale, by_parameter, left)
    return cost, gradient, hessian, torch.where(counts[..., None], residual, torch.nan)


LIGHT = even_light()
LIGHT[1:4] = torch.tensor([[0.5, 0.4, 0.3], [0.6, 0.6, 0.7], [-0.4, -0.3, 0.2]])
SKIN = SkinTexture(cases.smooth_noise(128, 128, 3.0), (SPACE.fragments.face_index >= 0).float(), SIGMA)


def test_cost_gradient_and_hessian_are_those_of_the_pixels():
    mask = torch.rand(SIDE, SIDE, generator=torch.Generator().manual_seed(4)).clamp_min(0.2)
    mask[:, :20] = 0
    jacobian = torch.randn(len(MODEL.template), 3, 5, generator=torch.Generator().manual_seed(2))
    seen = SurfaceView(posed(jacobian=jacobian), Picture(CAMERA, cases.smooth_noise(SIDE, SIDE, 2.0, 5), mask), LIGHT)
    gradient, hessian, residual = torch.empty(5), torch.empty(5, 5), torch.empty(SIDE, SIDE, 3)
    surface = _native.AlignSurface(
        SPACE.faces, SPACE.corners, SPACE.used.to(torch.uint8), SKIN.albedo, SKIN.trust, SIGMA, OUTLIER, LEAST_COSINE
    )
    derivatives = _native.AlignDerivatives(jacobian, hessian, gradient)
    cost, weight = _native.align_mesh(surface, seen.arrays(), 0, derivatives, residual, None)
    expected_cost, expected_gradient, expected_hessian, expected_residual = reference(seen, SKIN)
    assert weight > 100
    torch.testing.assert_close(residual.double(), expected_residual, atol=2e-5, rtol=0, equal_nan=True)
    assert cost == pytest.approx(float(expected_cost), rel=1e-4)
    for found, expected in ((gradient, expected_gradient), (hessian, expected_hessian)):
        torch.testing.assert_close(found.double(), expected, rtol=1e-3, atol=1e-4 * float(expected.abs().max()))


def test_high_pass_leaves_out_a_smooth_light_but_not_texture():
    (image, mask), surface = drawn(posed(), SKIN, even_light()), SPACE.native(SKIN, 5.0)
    ramp = torch.linspace(0.0, 0.3, SIDE)[None, :, None]
    for picture, least, most in ((image + ramp, 0, 0.05), (image.roll(3, dims=1), 0.3, 9)):
        seen = SurfaceView(posed(), Picture(CAMERA, picture.contiguous(), mask), even_light()).arrays()
        plain, high_passed = (_native.align_mesh(surface, seen, r, None, None, None)[0] for r in (0, 6))
        assert least * plain < high_passed < most * plain


def _pictures_under_light(light: Tensor) -> list[SurfaceView]:
    surfaces = [posed((0.0, 0.0, -0.5), yaw) for yaw in (0.0, 0.7, -0.7, 0.35, -0.35)]
    pictures = [drawn(surface, SKIN, light) for surface in surfaces]
    return [SurfaceView(surface, Picture(CAMERA, image.contiguous(), mask), even_light())
            for surface, (image, mask) in zip(surfaces, pictures, strict=True)]  # fmt: skip


def test_albedo_times_light_gives_the_pictures_back():
    views = _pictures_under_light(LIGHT)
    found, (light,) = estimate_appearance(SPACE, [views], unknown_texture(128), 3.0, 0)
    surface = SPACE.native(found, 5.0)
    for seen in views:
        residual = torch.empty(SIDE, SIDE, 3)
        _native.align_mesh(surface, SurfaceView(seen.posed, seen.picture, light).arrays(), 0, None, residual, None)
        known = residual[~residual.isnan().any(-1)]
        assert len(known) > 300
        assert known.abs().median() < 0.01
    found, _ = estimate_appearance(SPACE, [_pictures_under_light(even_light())], unknown_texture(128), 3.0, 0)
    behind = SPACE.fragments.face_index[:, 64:] >= 0
    assert float(found.trust[:, 64:][behind].mean()) < 0.2
    assert float(found.trust[48:80, 24:40].min()) > 0.5
    assert (found.albedo - SKIN.albedo)[48:80, 24:40].abs().median() < 0.05
