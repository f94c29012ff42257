"""The native rasterizer agrees with the float64 reference, forward and backward, and keeps its contract."""

import math
import multiprocessing
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from safetensors.torch import load_file
from torch import Tensor

import rasterize_scenes as splats
from instruction_sets import ISAS, by_threads
from known import known
from mien import _native
from mien.camera import Camera, camera_from_fov
from mien.errors import UserError
from mien.gaussians import Gaussians, sh_from_rgb
from mien.render import Rendering
from mien.render import rasterize as rasterize_in_place
from mien.render.rasterize import Backend, choose_backend
from mien.render.validation import drawable
from needs import use_instructions
from rasterize_scenes import Scene, assert_matches_reference, random_scene, relative_error
from rasterize_scenes import rasterize_anywhere as rasterize
from refusals import refuses

BACKENDS = ["native", splats.GSPLAT]


@pytest.fixture(autouse=True)
def restore_native_settings() -> Iterator[None]:
    before = _native.rasterize_isa()
    yield
    _native.set_rasterize_isa(before)


def scenes(backend: Backend) -> Iterator[splats.Scene]:
    """Scenes of any size and number of Gaussians, and odd ones."""
    for width, height in ((1, 1), (3, 70), (32, 32), (129, 65)):
        yield splats.random_scene(width + height, count=150, width=width, height=height)
    for count in (1, 15, 16, 17, 1000):
        yield splats.random_scene(count, count=count)
    # Pixels end early under many opaque layers, when transmittance runs out, and alpha is clamped at 0.999.
    ended = splats.random_scene(5, count=600, width=40, height=40)
    ended.gaussians.scales.mul_(4)
    ended.gaussians.opacities.clamp_(min=0.9).mul_(1.2).clamp_(max=1.0)
    yield ended
    large = splats.random_scene(6, count=30, width=150, height=140)  # larger than the picture
    large.gaussians.scales.mul_(20)
    large.gaussians.opacities.mul_(0.2)
    yield large
    # The covariance's determinant cancels if it is computed carelessly. gsplat computes it so. On an H100, its alpha
    # errs by 8e-6 for needles of 0.1 m, by 2.6e-4 for those of 0.5 m.
    needles = splats.random_scene(7, count=60, width=100, height=100)
    needles.gaussians.scales.copy_(torch.tensor([0.1 if backend == "gsplat" else 0.5, 1e-4, 1e-4]))
    yield needles


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
@pytest.mark.parametrize("level", [*ISAS, splats.GSPLAT])
def test_every_level_matches_the_reference(coefficients: int, level: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if level != "gsplat":
        use_instructions(level)
    backend = "gsplat" if level == "gsplat" else "native"
    splats.assert_matches_reference(splats.random_scene(coefficients, coefficients=coefficients), monkeypatch, backend)


@pytest.mark.unchecked
@pytest.mark.parametrize("backend", BACKENDS)
def test_any_size_number_and_shape_matches_the_reference(backend: Backend, monkeypatch: pytest.MonkeyPatch) -> None:
    for scene in scenes(backend):
        splats.assert_matches_reference(scene, monkeypatch, backend)


def test_several_forwards_before_their_backwards() -> None:
    scenes = [splats.random_scene(seed, count=100 + 50 * seed) for seed in range(6)]
    expected = [splats.gradients(scene, "native", lambda r: (r.image**2).sum())[1]["means"] for scene in scenes]
    tensors = [splats.leaves(scene) for scene in scenes]
    renderings = [splats.render(scene, own, "native") for scene, own in zip(scenes, tensors, strict=True)]
    for index in (3, 0, 5, 1, 4, 2):
        (renderings[index].image ** 2).sum().backward()
    assert all(torch.equal(known(own["means"].grad), value) for own, value in zip(tensors, expected, strict=True))


@pytest.mark.unchecked
def test_reference_gradients_match_finite_differences() -> None:
    scene = splats.random_scene(1, count=4, coefficients=4, width=9, height=7).to(torch.float64)
    scene.gaussians.scales.mul_(8)  # every alpha stays far from its cutoff
    scene.gaussians.means.mul_(0.3)  # within the margin where the Jacobian is not clamped: its bounds count as constant
    tensors = splats.leaves(scene)

    def rgba(*values: Tensor) -> Tensor:
        rendering = splats.render(scene, dict(zip(tensors, values, strict=True)), "reference")
        return torch.cat([rendering.image, rendering.alpha[..., None]], -1)

    assert torch.autograd.gradcheck(rgba, tuple(tensors.values()), eps=1e-6, atol=1e-6, rtol=1e-4)


@pytest.mark.parametrize("backend", ["reference", "native", splats.GSPLAT])
def test_tiny_case_matches_the_picture_that_gsplat_made(test_data: Path, backend: Backend) -> None:
    stored = load_file(test_data / "golden" / "tiny_case.safetensors")
    viewmat = torch.eye(4)
    viewmat[:3, 3] = -torch.tensor([0.123, 0.456, -8.0])
    camera = camera_from_fov(math.pi / 2, 123, 82, viewmat)
    gaussians = Gaussians(
        stored["means"], stored["quats"], stored["scales"].exp(), stored["opacities"].sigmoid(), stored["coeffs"]
    )
    rendering = splats.rasterize_anywhere(gaussians, camera, torch.zeros(3), backend=backend)
    picture = torch.cat([rendering.image, rendering.alpha[..., None]], -1)
    # Measured 1e-6: the same arithmetic in another order; 1e-4 would show a wrong constant (dilation, cutoff, clamp).
    torch.testing.assert_close(picture, stored["out_img"], rtol=0, atol=1e-5)


ALL_BACKENDS = ["native", "reference", splats.GSPLAT]


def one_gaussian(depth: float = 1.0, opacity: float = 0.8, scale: float = 0.02) -> Gaussians:
    """Return an orange ball on the optical axis."""
    return Gaussians(
        means=torch.tensor([[0.0, 0.0, float(depth)]]), quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        scales=torch.full((1, 3), scale), opacities=torch.tensor([float(opacity)]),
        sh=sh_from_rgb(torch.tensor([[[1.0, 0.5, 0.1]]])),
    )  # fmt: skip


def front_camera(width: int = 21, height: int = 15) -> Camera:
    K = torch.tensor([[60.0, 0, width / 2], [0, 60.0, height / 2], [0, 0, 1]])
    return Camera(K, torch.eye(4), width, height)


def stacked(scenes: list[splats.Scene]) -> Gaussians:
    names = ("means", "quats", "scales", "opacities", "sh", "T_world_local")
    return Gaussians(**{name: torch.stack([getattr(s.gaussians, name) for s in scenes]) for name in names})


@pytest.mark.parametrize("backend", ALL_BACKENDS)
def test_balls_on_the_axis_show_their_colors_at_the_center(backend: Backend) -> None:
    rendering = rasterize(one_gaussian(), front_camera(), torch.zeros(3), backend)
    assert rendering.alpha[7, 10].item() == pytest.approx(0.8, abs=1e-4)
    torch.testing.assert_close(rendering.image[7, 10], 0.8 * torch.tensor([1.0, 0.5, 0.1]), atol=1e-4, rtol=0)
    torch.testing.assert_close(rendering.image, rendering.image.flip(0).flip(1), atol=1e-5, rtol=0)
    variance = (60 * 0.02) ** 2 + 0.3
    assert rendering.alpha[7, 12].item() == pytest.approx(0.8 * math.exp(-0.5 * 2**2 / variance), abs=1e-5)
    assert rendering.radii.tolist() == [math.ceil(3 * variance**0.5)]
    # Nearer ones hide farther ones, and ties go by the index.
    means = torch.tensor([[0.0, 0, 1.1], [0, 0, 1], [0, 0, 1]])
    three = replace(one_gaussian().select(torch.tensor([0, 0, 0])), means=means, sh=sh_from_rgb(torch.eye(3))[:, None])
    seen = rasterize(three, front_camera(), torch.zeros(3), backend).image[7, 10]
    torch.testing.assert_close(seen, torch.tensor([0.8 * 0.04, 0.8, 0.8 * 0.2]), atol=1e-3, rtol=0)
    # A clamped alpha has no gradient.
    large = replace(one_gaussian(scale=5.0), opacities=torch.ones(1, requires_grad=True))
    alpha = rasterize(large, front_camera(), torch.zeros(3), backend).alpha[7, 10]
    assert alpha.item() == pytest.approx(0.999, abs=1e-6)
    assert torch.autograd.grad(alpha, large.opacities)[0].item() == 0


@pytest.mark.parametrize("backend", ALL_BACKENDS)
def test_batches_equal_their_single_pictures(backend: Backend) -> None:
    scenes = [splats.random_scene(seed, count=50) for seed in range(3)]
    cameras, background = [scene.camera for scene in scenes], scenes[0].background
    singles = [rasterize(s.gaussians, s.camera, background, backend) for s in scenes]
    batch = rasterize(stacked(scenes), cameras, background, backend)
    for name in ("image", "radii", "alpha"):
        assert torch.equal(getattr(batch, name), torch.stack([getattr(single, name) for single in singles]))
    shared = replace(stacked(scenes), sh=scenes[0].gaussians.sh)
    for index, entry in enumerate(shared.timesteps()):
        assert all(
            a is b is None or torch.equal(known(a), known(b))
            for a, b in zip(vars(entry).values(), vars(shared.timestep(index)).values(), strict=True)
        )
    one_camera = rasterize(stacked(scenes), cameras[1], background, backend)
    assert torch.equal(one_camera.image[1], singles[1].image)
    one_scene = rasterize(scenes[1].gaussians, cameras, background, backend)
    assert torch.equal(one_scene.image[1], singles[1].image)
    assert rasterize(scenes[1].gaussians, cameras[:1], background, backend).image.shape == (1, 45, 61, 3)
    assert one_scene.means2d_offset.requires_grad
    with torch.no_grad():
        fixed = rasterize(scenes[1].gaussians, cameras, background, backend)
    assert not fixed.image.requires_grad
    assert not fixed.means2d_offset.requires_grad


@pytest.mark.parametrize("backend", ALL_BACKENDS)
def test_means2d_gradient_is_per_pixel_of_motion(backend: Backend) -> None:
    gaussians, camera = one_gaussian(), front_camera()
    rendering = rasterize(gaussians, camera, torch.zeros(3), backend)
    rendering.alpha[7, 12].backward()
    moved = replace(camera, K=camera.K + torch.tensor([[0, 0, 1e-2], [0, 0, 0], [0, 0, 0]]))
    change = rasterize(gaussians, moved, torch.zeros(3), backend).alpha[7, 12] - rendering.alpha[7, 12]
    gradient = known(rendering.means2d_offset.grad)
    assert gradient[0, 0].item() == pytest.approx(change.item() / 1e-2, rel=2e-2)
    assert gradient[0, 1].abs() < 1e-6


@pytest.mark.parametrize("backend", ALL_BACKENDS)
def test_nothing_to_see_is_background(backend: Backend) -> None:
    background = torch.tensor([0.1, 0.2, 0.3])
    for name, gaussians in {
        "behind": one_gaussian(depth=-1), "at the near plane": one_gaussian(depth=0.01),
        "transparent": one_gaussian(opacity=0), "below 1/255": one_gaussian(opacity=1 / 256),
        "beside the picture": replace(one_gaussian(), means=torch.tensor([[10.0, 0, 1]])),
        "none": one_gaussian().select(torch.zeros(1, dtype=torch.bool)),
    }.items():  # fmt: skip
        means = gaussians.means.clone().requires_grad_()
        rendering = rasterize(replace(gaussians, means=means), front_camera(), background, backend)
        assert torch.equal(rendering.image, background.expand(15, 21, 3)), name
        assert not rendering.alpha.any(), name
        assert not rendering.radii.any(), name
        assert not torch.autograd.grad(rendering.image.sum(), means)[0].any(), name


@pytest.mark.parametrize("backend", ALL_BACKENDS)
def test_what_is_not_finite_is_named(backend: Backend) -> None:
    camera = splats.random_scene(3).camera
    for name in ("means", "quats", "scales", "opacities", "sh"):
        for value in (torch.nan, torch.inf, -torch.inf):
            gaussians = splats.random_scene(3, count=40).gaussians
            gaussians.means[17] = torch.tensor([0.0, 0.0, 0.2])  # in view, since the kernel reads no other colours
            gaussians.opacities[17] = 0.5
            getattr(gaussians, name).view(40, -1)[17, -1] = value
            with pytest.raises(ValueError, match=rf"{name}\[17.* is -?(nan|inf)"):
                rasterize(gaussians, camera, torch.zeros(3), backend)
    broken = replace(camera, viewmat=torch.full((4, 4), torch.nan))
    for seen_by, background, words in (
        (broken, 0.0, r"camera.viewmat\[0, 0\] is nan"),
        ([camera, broken, camera], 0.0, r"camera.viewmat\[0, \d\] is nan"),
        (camera, torch.inf, r"background\[1\] is inf"),
    ):
        with pytest.raises(ValueError, match=words):
            rasterize(one_gaussian(), seen_by, torch.tensor([0.0, background, 0.0]), backend)


def test_layouts_and_dtypes() -> None:
    scene = splats.random_scene(4)
    spread = {name: getattr(scene.gaussians, name) for name in ("means", "quats", "scales", "opacities", "sh")}
    spread = {name: tensor.repeat_interleave(2, 0)[::2] for name, tensor in spread.items()}
    assert not spread["means"].is_contiguous()
    found = rasterize(replace(scene.gaussians, **spread), scene.camera, scene.background, "native")
    assert torch.equal(found.image, rasterize(scene.gaussians, scene.camera, scene.background, "native").image)
    double = scene.to(torch.float64)
    assert rasterize(double.gaussians, double.camera, double.background).image.dtype == torch.float64
    with pytest.raises(ValueError, match="takes float32 CPU tensors, got torch.float64"):
        rasterize(double.gaussians, double.camera, double.background, "native")
    with pytest.raises(ValueError, match="quats is torch.float64"):
        rasterize(replace(scene.gaussians, quats=double.gaussians.quats), scene.camera, scene.background)
    assert [choose_backend(one.background) for one in (scene, double)] == ["native", "reference"]


def test_what_does_not_fit_or_cannot_be_counted_is_refused() -> None:
    scenes = [splats.random_scene(seed) for seed in range(3)]
    one, cameras = scenes[0].gaussians, [scene.camera for scene in scenes]
    for gaussians, seen_by, words in (
        (stacked(scenes), cameras[:2], "3 timesteps of Gaussians but 2 cameras"),
        (one, [cameras[0], front_camera()], "must have one size"),
        (one, [], "is empty"),
        (splats.random_scene(0, coefficients=5).gaussians, cameras[0], "sh has shape"),
    ):
        with pytest.raises(ValueError, match=words):
            rasterize(gaussians, seen_by, torch.zeros(3))
    count, width = 70_000, 1_048_544  # each Gaussian touches all of 32,767 tiles
    gaussians = one_gaussian(scale=3.0).select(torch.zeros(count, dtype=torch.long))
    gaussians.means[:, 2] += torch.linspace(0, 1, count)
    K = torch.tensor([[float(width), 0, width / 2], [0, float(width), 0.5], [0, 0, 1]])
    words = r"^it: cannot be drawn \(too many pairs .*\); do something else$"
    with pytest.raises(UserError, match=words), drawable("it", "do something else"):
        rasterize_in_place(gaussians, Camera(K, torch.eye(4), width, 1), torch.ones(3), backend="native")


def _render_in_child(queue: "multiprocessing.Queue[list[float]]") -> None:
    _native.set_thread_count(3)  # joins the threads of the old pool, and hangs if that is still the parent's
    queue.put(rasterize(one_gaussian(), front_camera(), torch.zeros(3), "native").image[7, 10].tolist())


def test_a_forked_child_renders() -> None:
    """Threads do not survive a fork, so the pool must notice it."""
    _native.set_thread_count(2)
    scene = splats.random_scene(0)
    expected = rasterize(one_gaussian(), front_camera(), torch.zeros(3), "native").image[7, 10].tolist()
    rasterize(scene.gaussians, scene.camera, scene.background, "native")
    context = multiprocessing.get_context("fork")
    queue: multiprocessing.Queue[list[float]] = context.Queue()
    child = context.Process(target=_render_in_child, args=(queue,), daemon=True)
    child.start()
    assert queue.get(timeout=60) == expected
    child.join(timeout=60)
    _native.set_thread_count(0)


def test_gsplat_says_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gsplat", None)
    refuses("pip install gsplat==", rasterize_in_place, one_gaussian(), front_camera(), torch.zeros(3), "gsplat")


ODDITIES: dict[str, dict[str, list[float] | float]] = {
    "zero quaternion": {"quats": 0.0}, "short quaternion": {"quats": [0.01, 0.003, -0.002, 0.004]},
    "no extent": {"scales": 0.0}, "needle": {"scales": [0.3, 1e-5, 1e-5]}, "disc": {"scales": [0.2, 0.2, 0.0]},
    "huge": {"scales": [2.0, 3.0, 1.0], "opacities": 0.2}, "transparent": {"opacities": 0.0},
    "opaque": {"opacities": 1.0}, "behind the camera": {"means": [0.0, 0.0, -0.5]},
    "on the camera": {"means": [0.0, 0.0, 0.0]}, "touching the camera": {"means": [0.0, 0.0, 0.0101]},
    "far outside": {"means": [50.0, 0.0, 0.3]}, "far away": {"means": [0.0, 0.0, 1e4]},
}  # fmt: skip
"""Names of oddities of a Gaussian. Means are in the camera's frame."""


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
    found = rasterize_in_place(scene.gaussians, scene.camera, depth=True)
    expected = rasterize_in_place(exact.gaussians, exact.camera, backend="reference", depth=True)
    depth, seen = known(found.depth), found.alpha > 0.05
    assert (depth[seen] - known(expected.depth)[seen]).abs().median() < 1e-5
    assert (depth[found.alpha == 0] == 0).all()
    assert rasterize_in_place(scene.gaussians, scene.camera).depth is None
    # A ball's depth is its distance, and its gradient moves with it.
    means = torch.tensor([[0.0, 0.0, 1.25]], requires_grad=True)
    camera = Camera(torch.tensor([[60.0, 0, 5.5], [0, 60, 5.5], [0, 0, 1]]), torch.eye(4), 11, 11)
    scale, quat, opacity = torch.full((1, 3), 0.05), torch.eye(4)[:1], torch.tensor([0.7])
    ball = Gaussians(means, quat, scale, opacity, torch.zeros(1, 1, 3))
    depth = known(rasterize_in_place(ball, [camera, camera], depth=True).depth)
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
        rendering = rasterize_in_place(Gaussians(means=own[0], opacities=own[1], **fields), camera)
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
