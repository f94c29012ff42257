"""The native rasterizer agrees with the float64 reference, forward and backward, and the reference with differences.
All draw the same picture as another program (gsplat)."""

import math
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor

from instruction_sets import ISAS
from known import known
from mien import _native
from mien.camera import camera_from_fov
from mien.gaussians import Gaussians
from mien.render.rasterize import Backend
from needs import use_instructions
from rasterize_scenes import (
    GSPLAT,
    Scene,
    assert_matches_reference,
    gradients,
    leaves,
    random_scene,
    rasterize_anywhere,
    render,
)

BACKENDS = ["native", GSPLAT]


@pytest.fixture(autouse=True)
def restore_native_settings() -> Iterator[None]:
    before = _native.rasterize_isa()
    yield
    _native.set_rasterize_isa(before)


def scenes(backend: Backend) -> Iterator[Scene]:
    """Scenes of any size and number of Gaussians, and odd ones."""
    for width, height in ((1, 1), (3, 70), (32, 32), (129, 65)):
        yield random_scene(width + height, count=150, width=width, height=height)
    for count in (1, 15, 16, 17, 1000):
        yield random_scene(count, count=count)
    # Pixels end early under many opaque layers, when transmittance runs out, and alpha is clamped at 0.999.
    ended = random_scene(5, count=600, width=40, height=40)
    ended.gaussians.scales.mul_(4)
    ended.gaussians.opacities.clamp_(min=0.9).mul_(1.2).clamp_(max=1.0)
    yield ended
    large = random_scene(6, count=30, width=150, height=140)  # larger than the picture
    large.gaussians.scales.mul_(20)
    large.gaussians.opacities.mul_(0.2)
    yield large
    # The covariance's determinant cancels if it is computed carelessly. gsplat computes it so. On an H100, its alpha
    # errs by 8e-6 for needles of 0.1 m, by 2.6e-4 for those of 0.5 m.
    needles = random_scene(7, count=60, width=100, height=100)
    needles.gaussians.scales.copy_(torch.tensor([0.1 if backend == "gsplat" else 0.5, 1e-4, 1e-4]))
    yield needles


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
@pytest.mark.parametrize("level", [*ISAS, GSPLAT])
def test_every_level_matches_the_reference(coefficients: int, level: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if level != "gsplat":
        use_instructions(level)
    backend = "gsplat" if level == "gsplat" else "native"
    assert_matches_reference(random_scene(coefficients, coefficients=coefficients), monkeypatch, backend)


@pytest.mark.unchecked
@pytest.mark.parametrize("backend", BACKENDS)
def test_any_size_number_and_shape_matches_the_reference(backend: Backend, monkeypatch: pytest.MonkeyPatch) -> None:
    for scene in scenes(backend):
        assert_matches_reference(scene, monkeypatch, backend)


def test_several_forwards_before_their_backwards() -> None:
    scenes = [random_scene(seed, count=100 + 50 * seed) for seed in range(6)]
    expected = [gradients(scene, "native", lambda r: (r.image**2).sum())[1]["means"] for scene in scenes]
    tensors = [leaves(scene) for scene in scenes]
    renderings = [render(scene, own, "native") for scene, own in zip(scenes, tensors, strict=True)]
    for index in (3, 0, 5, 1, 4, 2):
        (renderings[index].image ** 2).sum().backward()
    assert all(torch.equal(known(own["means"].grad), value) for own, value in zip(tensors, expected, strict=True))


@pytest.mark.unchecked
def test_reference_gradients_match_finite_differences() -> None:
    scene = random_scene(1, count=4, coefficients=4, width=9, height=7).to(torch.float64)
    scene.gaussians.scales.mul_(8)  # every alpha stays far from its cutoff
    scene.gaussians.means.mul_(0.3)  # within the margin where the Jacobian is not clamped: its bounds count as constant
    tensors = leaves(scene)

    def rgba(*values: Tensor) -> Tensor:
        rendering = render(scene, dict(zip(tensors, values, strict=True)), "reference")
        return torch.cat([rendering.image, rendering.alpha[..., None]], -1)

    assert torch.autograd.gradcheck(rgba, tuple(tensors.values()), eps=1e-6, atol=1e-6, rtol=1e-4)


@pytest.mark.parametrize("backend", ["reference", "native", GSPLAT])
def test_tiny_case_matches_the_picture_that_gsplat_made(test_data: Path, backend: Backend) -> None:
    stored = load_file(test_data / "golden" / "tiny_case.safetensors")
    viewmat = torch.eye(4)
    viewmat[:3, 3] = -torch.tensor([0.123, 0.456, -8.0])
    camera = camera_from_fov(math.pi / 2, 123, 82, viewmat)
    gaussians = Gaussians(
        stored["means"], stored["quats"], stored["scales"].exp(), stored["opacities"].sigmoid(), stored["coeffs"]
    )
    rendering = rasterize_anywhere(gaussians, camera, torch.zeros(3), backend=backend)
    picture = torch.cat([rendering.image, rendering.alpha[..., None]], -1)
    # Measured 1e-6: the same arithmetic in another order; 1e-4 would show a wrong constant (dilation, cutoff, clamp).
    torch.testing.assert_close(picture, stored["out_img"], rtol=0, atol=1e-5)
