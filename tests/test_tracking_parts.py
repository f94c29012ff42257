"""The parts of tracking are right: derivatives, solvers, weights, gaps."""

from dataclasses import replace

import pytest
import torch

from mien.tracking import SmoothnessSettings
from mien.tracking.fitting import (
    Bounds,
    NormalEquations,
    Smoothness,
    batch_of,
    layout_of,
    minimize_frames,
    smoothness_of,
    solve_chain,
)
from mien.tracking.landmarks import groups, reduce_face_model
from mien.tracking.landmarks.outcome import fill_gaps
from small_face_model import make_small_face_model
from tracking_case import still_camera


def _model_with_correctives():
    model = make_small_face_model()
    free = len(model.free_joint_names)
    random = torch.Generator().manual_seed(3)
    return replace(model, pose_basis=0.01 * torch.randn(9 * free, *model.template.shape, generator=random))


def _random_state(layout, count: int = 3) -> torch.Tensor:
    random = torch.Generator().manual_seed(4)
    state = 0.3 * torch.rand(count, layout.size, generator=random, dtype=torch.float64)
    state[:, 5] -= 0.8
    return state


def test_reduced_model_is_the_model():
    model = _model_with_correctives()
    layout = layout_of(model)
    reduced = reduce_face_model(model, layout)
    state, identity = _random_state(layout), torch.linspace(-1, 1, 6, dtype=torch.float64)
    camera = still_camera()
    full = reduced.face_model
    vertices = full(layout.face_params(state, identity))
    expected = camera.project(full.landmark_positions(vertices, "mediapipe"))[0]
    bias = torch.zeros(478, 3, dtype=torch.float64)
    projected = reduced.project(state, identity, bias, batch_of((camera,) * 3), torch.arange(3))
    torch.testing.assert_close(projected, expected, atol=1e-4, rtol=0)


@pytest.mark.parametrize("which", ["state", "identity", "bias", "focal"])
def test_derivatives_match_finite_differences(which):
    model = _model_with_correctives()
    layout = layout_of(model)
    reduced = reduce_face_model(model, layout)
    camera, row = still_camera(), torch.tensor([0, 2, 1, 2])  # one timestep was seen by two cameras
    at = {"state": _random_state(layout), "identity": torch.linspace(-1, 1, 6, dtype=torch.float64),
          "bias": torch.zeros(478, 3, dtype=torch.float64), "focal": torch.zeros(1, dtype=torch.float64)}  # fmt: skip

    def project(**changed):
        values = {**at, **changed}
        K = camera.K.clone()
        K[[0, 1], [0, 1]] *= values["focal"].exp()
        return reduced.project(
            values["state"], values["identity"], values["bias"], batch_of((replace(camera, K=K),) * 4), row
        )

    linear = reduced.linearize(
        at["state"], at["identity"], at["bias"], batch_of((camera,) * 4), row, with_identity=True
    )
    analytic = {"state": linear.by_frame, "identity": linear.by_identity, "bias": linear.by_bias,
                "focal": linear.by_log_focal[..., None]}[which]  # fmt: skip
    step = 1e-6
    shifts = step * torch.eye(at[which].shape[-1], dtype=torch.float64)
    numeric = [(project(**{which: at[which] + s}) - project(**{which: at[which] - s})) / (2 * step) for s in shifts]
    torch.testing.assert_close(analytic, torch.stack(numeric, dim=-1), atol=1e-5, rtol=1e-6)


def test_free_parameters():
    """Pinned expressions, the neck and the roll of eyes are not free, and eyes that diverge cost more."""
    layout = layout_of(make_small_face_model())
    assert layout.names[6:13] == tuple(f"move{index}" for index in range(7)), "the last expression is pinned"
    assert layout.names[13:] == ("left_eye_x", "left_eye_y", "right_eye_x", "right_eye_y"), "no neck, no roll of eyes"
    assert torch.linalg.eigvalsh(layout.precision[6:, 6:]).min() > 0
    # Eyes that look alike cost less than eyes that look apart.
    alike, apart = torch.zeros(2, layout.size, dtype=torch.float64)
    alike[[14, 16]], apart[14], apart[16] = 0.1, 0.1, -0.1
    assert alike @ layout.precision @ alike < apart @ layout.precision @ apart


def test_bounded_least_squares():
    """Least squares in a box keep the bounds and reach the minimum."""
    # |x - target|^2 in a box: the solution is the clipped target; in a tilted metric, the bound is still kept.
    target = torch.tensor([[2.0, 0.5], [-1.0, 0.2]], dtype=torch.float64)
    metric = torch.tensor([[2.0, 0.9], [0.9, 1.0]], dtype=torch.float64)

    def cost(state):
        return ((state - target) @ metric * (state - target)).sum(1)

    def equations(state):
        return NormalEquations(cost(state), (state - target) @ metric, metric.expand(2, 2, 2))

    box = Bounds(torch.zeros(2, dtype=torch.float64), torch.ones(2, dtype=torch.float64))
    found = minimize_frames(equations, cost, torch.full((2, 2), 0.5, dtype=torch.float64), box, 30)
    assert found[0, 0] == 1
    assert found[1, 0] == 0
    # With x clamped, y minimises on: y = target_y - (0.9 / 1.0) (x - target_x), clamped as well.
    torch.testing.assert_close(found[0, 1], torch.tensor(1.0, dtype=torch.float64))
    torch.testing.assert_close(found[1, 1], torch.tensor(0.0, dtype=torch.float64))


@pytest.mark.parametrize("timesteps", [3, 8, 9])
def test_chain_solver_matches_the_dense_solution(timesteps):
    random = torch.Generator().manual_seed(timesteps)
    p = 3
    root = torch.randn(timesteps, p, p, generator=random, dtype=torch.float64)
    hessian = root @ root.mT + torch.eye(p, dtype=torch.float64)
    gradient = torch.randn(timesteps, p, generator=random, dtype=torch.float64)
    state = torch.randn(timesteps, p, generator=random, dtype=torch.float64)
    linked = torch.ones(timesteps, dtype=torch.bool)
    linked[[0, -1]] = False
    smoothness = Smoothness(torch.tensor([0.0, 1.0, 30.0], dtype=torch.float64), linked)
    held = torch.zeros(timesteps, p, dtype=torch.bool)
    held[1, 2] = True
    step = solve_chain(NormalEquations(gradient[:, 0], gradient, hessian), smoothness, state, held)

    weights = smoothness.weights(state)
    second = torch.zeros(timesteps, timesteps, dtype=torch.float64)
    for t in range(1, timesteps - 1):
        second[t, t - 1 : t + 2] = torch.tensor([1.0, -2.0, 1.0])
    dense = torch.block_diag(*hessian)
    for column in range(p):
        dense[column::p, column::p] += second.T @ torch.diag(weights[:, column]) @ second
    moving = ~held.flatten()
    expected = torch.zeros(timesteps * p, dtype=torch.float64)
    full_gradient = (gradient + smoothness.gradient(state)).flatten()
    expected[moving] = -torch.linalg.solve(dense[moving][:, moving], full_gradient[moving])
    torch.testing.assert_close(step.flatten(), expected)


def test_smoothness_gradient_is_that_of_its_cost():
    state = torch.randn(7, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).requires_grad_()
    linked = torch.tensor([False, True, True, False, True, True, False])
    smoothness = Smoothness(torch.tensor([1.0, 50.0], dtype=torch.float64), linked)
    smoothness.cost(state).backward()
    torch.testing.assert_close(2 * smoothness.gradient(state.detach()), state.grad)


def test_missing_frames_cut_the_chain():
    valid = torch.tensor([True, True, True, False, True, True, True, True])
    smoothness = smoothness_of(layout_of(make_small_face_model()), valid, 25.0, SmoothnessSettings())
    assert smoothness.linked.tolist() == [False, True, False, False, True, True, False]


def test_eyelids_are_not_smoothed():
    model = make_small_face_model()
    names = ("eyeBlinkLeft", *model.expression_names[1:])
    layout = layout_of(replace(model, expression_names=names))
    precision = smoothness_of(layout, torch.ones(5, dtype=torch.bool), 25.0, SmoothnessSettings()).precision
    assert precision[6] == 0
    assert precision[7] > 0
    assert (precision[layout.joint_columns] == 0).all(), "eyes jump"


def test_gaps_at_the_ends_repeat_the_nearest():
    face = make_small_face_model().neutral(2)
    face = replace(face, head_translation=torch.tensor([[0.0, 0, -1], [1.0, 0, -1]]))
    valid = torch.tensor([False, True, False, False, True, False])
    filled = fill_gaps(face, valid)
    torch.testing.assert_close(filled.head_translation[:, 0], torch.tensor([0, 0, 1 / 3, 2 / 3, 1, 1]))


def test_landmark_groups_are_mediapipes():
    connections = pytest.importorskip("mediapipe.python.solutions.face_mesh_connections")

    def points(name: str) -> set[int]:
        return {index for edge in getattr(connections, name) for index in edge}

    assert set(groups.OVAL) == points("FACEMESH_FACE_OVAL")
    assert set(groups.LIPS) == points("FACEMESH_LIPS")
    assert set(groups.LEFT_EYELIDS) == points("FACEMESH_LEFT_EYE")
    assert set(groups.RIGHT_EYELIDS) == points("FACEMESH_RIGHT_EYE")
    assert set(groups.BROWS) == points("FACEMESH_LEFT_EYEBROW") | points("FACEMESH_RIGHT_EYEBROW")
    assert set(groups.NOSE) == points("FACEMESH_NOSE")
    assert set(groups.LEFT_IRIS[1:]) == points("FACEMESH_LEFT_IRIS")
    assert set(groups.RIGHT_IRIS[1:]) == points("FACEMESH_RIGHT_IRIS")
    assert groups.landmark_weights().mean() == pytest.approx(1)
