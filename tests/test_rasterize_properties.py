"""The native rasterizer agrees with the float64 reference on random scenes of any size, count, shape and oddity."""

import pytest
import torch
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from torch import Tensor

from instruction_sets import by_threads
from known import known
from mien.camera import Camera
from mien.gaussians import Gaussians
from mien.render import Rendering, rasterize
from rasterize_scenes import Scene, assert_matches_reference, random_scene, relative_error

ODDITIES: dict[str, dict[str, list[float] | float]] = {
    "zero quaternion": {"quats": 0.0}, "short quaternion": {"quats": [0.01, 0.003, -0.002, 0.004]},
    "no extent": {"scales": 0.0}, "needle": {"scales": [0.3, 1e-5, 1e-5]}, "disc": {"scales": [0.2, 0.2, 0.0]},
    "huge": {"scales": [2.0, 3.0, 1.0], "opacities": 0.2}, "transparent": {"opacities": 0.0},
    "opaque": {"opacities": 1.0}, "behind the camera": {"means": [0.0, 0.0, -0.5]},
    "on the camera": {"means": [0.0, 0.0, 0.0]}, "touching the camera": {"means": [0.0, 0.0, 0.0101]},
    "far outside": {"means": [50.0, 0.0, 0.3]}, "far away": {"means": [0.0, 0.0, 1e4]},
}  # fmt: skip
"""What is odd about a Gaussian. Means are in the camera's frame."""


def make_odd(scene: Scene, oddities: list[str]) -> None:
    """Give Gaussian i the oddity i, in place. The Gaussians after them stay as they are."""
    T_camera_local = scene.camera.viewmat.double() @ known(scene.gaussians.T_world_local).double()
    T_local_camera = torch.linalg.inv(T_camera_local).float()
    for index, oddity in zip(range(len(scene.gaussians)), oddities, strict=False):
        for name, odd in ODDITIES[oddity].items():
            value = torch.tensor(odd)
            value = T_local_camera[:3, :3] @ value + T_local_camera[:3, 3] if name == "means" else value
            getattr(scene.gaussians, name)[index] = value


@pytest.mark.unchecked
@settings(max_examples=40, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    seed=st.integers(0, 2**20),
    count=st.one_of(st.integers(0, 3), st.integers(4, 120)),
    coefficients=st.sampled_from([1, 4, 9, 16]),
    size=st.tuples(st.integers(1, 70), st.integers(1, 70)),
    oddities=st.lists(st.sampled_from(list(ODDITIES)), max_size=6),
)
@example(seed=1, count=0, coefficients=1, size=(20, 10), oddities=[])
@example(seed=2, count=1, coefficients=16, size=(1, 1), oddities=[])
@example(seed=3, count=60, coefficients=4, size=(33, 31), oddities=list(ODDITIES))
@example(seed=4, count=1, coefficients=9, size=(30, 30), oddities=["on the camera"])
def test_any_scene_matches_the_reference(seed, count, coefficients, size, oddities, monkeypatch) -> None:
    scene = random_scene(seed, count, coefficients, *size)
    make_odd(scene, oddities)
    assert_matches_reference(scene, monkeypatch)


def test_depth_is_the_expected_depth() -> None:
    scene = random_scene(3, 80)
    exact = scene.to(torch.float64)
    found = rasterize(scene.gaussians, scene.camera, depth=True)
    expected = rasterize(exact.gaussians, exact.camera, backend="reference", depth=True)
    depth, seen = known(found.depth), found.alpha > 0.05
    assert (depth[seen] - known(expected.depth)[seen]).abs().median() < 1e-5
    assert (depth[found.alpha == 0] == 0).all()
    assert rasterize(scene.gaussians, scene.camera).depth is None
    # A ball's depth is its distance, and its gradient moves with it.
    means = torch.tensor([[0.0, 0.0, 1.25]], requires_grad=True)
    camera = Camera(torch.tensor([[60.0, 0, 5.5], [0, 60, 5.5], [0, 0, 1]]), torch.eye(4), 11, 11)
    scale, quat, opacity = torch.full((1, 3), 0.05), torch.eye(4)[:1], torch.tensor([0.7])
    ball = Gaussians(means, quat, scale, opacity, torch.zeros(1, 1, 3))
    depth = known(rasterize(ball, [camera, camera], depth=True).depth)
    assert (depth.shape, depth[0, 5, 5].item()) == ((2, 11, 11), pytest.approx(1.25, abs=1e-5))
    (gradient,) = torch.autograd.grad(depth[1, 5, 5], means)
    torch.testing.assert_close(gradient, torch.tensor([[0.0, 0.0, 1.0]]), atol=1e-3, rtol=0)


@pytest.mark.exact
def test_views_of_one_call_equal_single_calls_to_the_bit() -> None:
    """One thread draws each view. Gradients of what views share add up; here, each view has its own means."""
    scenes = [random_scene(seed, 300, 4, 90, 70) for seed in range(5)]
    cameras = [scene.camera for scene in scenes]
    means, shared = torch.stack([scene.gaussians.means for scene in scenes]), scenes[0].gaussians
    fields = {name: getattr(shared, name) for name in ("quats", "scales", "sh", "T_world_local")}

    def drawn(means: Tensor, camera: Camera | list[Camera]) -> tuple[Rendering, list[Tensor]]:
        own = [means.clone().requires_grad_(), shared.opacities.clone().requires_grad_()]
        rendering = rasterize(Gaussians(means=own[0], opacities=own[1], **fields), camera)
        return rendering, list(torch.autograd.grad((rendering.image**2).sum(), own))

    (alone,) = by_threads(lambda: [drawn(*view) for view in zip(means, cameras, strict=True)], (1,))
    total = torch.stack([pulls[1] for _, pulls in alone[::-1]]).sum(0)  # autograd's order
    for batch, (own, together) in by_threads(lambda: drawn(means, cameras), (1, 2, 3)):
        for index, (single, pulls) in enumerate(alone):
            assert torch.equal(batch.image[index], single.image)
            assert torch.equal(batch.radii[index], single.radii)
            assert relative_error(own[index], pulls[0]) < 1e-6
        assert relative_error(together, total) < 1e-6
        assert batch.means2d_offset.shape == (5, 300, 2)
