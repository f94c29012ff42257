"""Make random scenes for the rasterizer's tests, and find the pixels that can be compared."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from mien.camera import Camera
from mien.gaussians import Gaussians
from mien.render import Rendering, rasterize
from mien.render.rasterize import Backend
from mien.rotation import matrix_from_axis_angle, rigid_transform

GSPLAT = pytest.param("gsplat", marks=pytest.mark.gpu)
GPU = "cuda"
TOLERANCES: dict[Backend, tuple[float, float]] = {"native": (1e-5, 1e-4), "gsplat": (1e-4, 1e-3)}
"""Relative L2 errors of pictures and of gradients. gsplat uses the GPU's fast approximation of the exponential."""
PARAMETERS = ("means", "quats", "scales", "opacities", "sh", "T_world_local")


@dataclass(frozen=True)
class Scene:
    gaussians: Gaussians
    camera: Camera
    background: Tensor

    def to(self, dtype: torch.dtype) -> "Scene":
        like = torch.zeros((), dtype=dtype)
        return Scene(self.gaussians.to(like), self.camera.to(like), self.background.to(like))


def rasterize_anywhere(
    gaussians: Gaussians, camera: Camera | Sequence[Camera], background: Tensor | None = None,
    backend: Backend = "auto", depth: bool = False,
) -> Rendering:  # fmt: skip
    """Call `rasterize` with CPU tensors, on the GPU if the back end needs one. The picture is returned on the CPU."""
    if backend != "gsplat":
        return rasterize(gaussians, camera, background, backend, depth)
    like = torch.zeros((), device=GPU)
    cameras = camera.to(like) if isinstance(camera, Camera) else [one.to(like) for one in camera]
    there = rasterize(gaussians.to(like), cameras, None if background is None else background.to(like), backend, depth)
    pictures = {"image": there.image.cpu(), "alpha": there.alpha.cpu(), "radii": there.radii.cpu()}
    return replace(there, **pictures, depth=None if there.depth is None else there.depth.cpu())


def random_scene(seed: int, count: int = 200, coefficients: int = 4, width: int = 61, height: int = 45) -> Scene:
    """Return Gaussians of all shapes around a tilted camera, some behind it, outside of the picture or transparent."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    pose = rigid_transform(matrix_from_axis_angle(0.3 * normal(3)), 0.1 * normal(3))
    gaussians = Gaussians(
        means=normal(count, 3) * torch.tensor([0.5, 0.5, 0.4]), quats=normal(count, 4),
        scales=0.02 * torch.exp(normal(count, 3)), opacities=torch.rand(count, generator=generator),
        sh=0.4 * normal(count, coefficients, 3), T_world_local=pose,
    )  # fmt: skip
    viewmat = rigid_transform(matrix_from_axis_angle(0.2 * normal(3)), torch.tensor([0.05, -0.02, 0.9]))
    focal = 1.1 * width
    K = torch.tensor([[focal, 0, 0.48 * width], [0, 1.2 * focal, 0.55 * height], [0, 0, 1]])
    return Scene(gaussians, Camera(K, viewmat, width, height), torch.rand(3, generator=generator))


def comparable_pixels(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> Tensor:
    """Return the pixels [h, w] that do not change when the two cutoffs move a little.
    At the others, an alpha or a transmittance is so close to its cutoff that rounding decides."""
    pictures = []
    for factor in (1 - 1e-4, 1 + 1e-4):
        with monkeypatch.context() as patch:
            patch.setattr("mien.render.reference.MIN_ALPHA", factor / 255)
            patch.setattr("mien.render.reference.MIN_TRANSMITTANCE", factor * 1e-4)
            picture = rasterize(scene.gaussians, scene.camera, scene.background, backend="reference")
            pictures.append(picture.image.detach())
    return ((pictures[0] - pictures[1]).abs() < 1e-7).all(-1)


def leaves(scene: Scene) -> dict[str, Tensor]:
    """Return copies of everything that a rendering is differentiable in, as leaves."""
    tensors = {name: getattr(scene.gaussians, name) for name in PARAMETERS}
    tensors |= {"background": scene.background, "viewmat": scene.camera.viewmat, "K": scene.camera.K}
    return {name: tensor.detach().clone().requires_grad_() for name, tensor in tensors.items()}


def render(scene: Scene, tensors: dict[str, Tensor], backend: Backend) -> Rendering:
    gaussians = Gaussians(**{name: tensors[name] for name in PARAMETERS})
    camera = Camera(tensors["K"], tensors["viewmat"], scene.camera.width, scene.camera.height)
    return rasterize_anywhere(gaussians, camera, tensors["background"], backend)


def gradients(
    scene: Scene, backend: Backend, loss: Callable[[Rendering], Tensor]
) -> tuple[Rendering, dict[str, Tensor]]:
    tensors = leaves(scene)
    rendering = render(scene, tensors, backend)
    loss(rendering).backward()
    found = {}
    for name, tensor in [*tensors.items(), ("means2d", rendering.means2d_offset)]:
        if name == "K" and backend == "gsplat":  # gsplat has no gradient of the intrinsics
            continue
        assert tensor.grad is not None, name
        found[name] = tensor.grad.cpu()
    # No back end reads the last row of transforms or the constant entries of K.
    found["T_world_local"][3] = found["viewmat"][3] = 0
    if "K" in found:
        found["K"][2] = found["K"][0, 1] = found["K"][1, 0] = 0
    return rendering, found


def relative_error(value: Tensor, truth: Tensor) -> float:
    """Return the relative L2 error."""
    value, truth = value.detach().double(), truth.detach().double()
    return float((value - truth).norm() / truth.norm().clamp_min(1e-12))


class WeightedSum:
    """Random linear loss on the pixels that can be compared."""

    def __init__(self, comparable: Tensor, seed: int) -> None:
        generator = torch.Generator().manual_seed(seed)
        self.weights = comparable[..., None] * torch.randn(*comparable.shape, 4, generator=generator)

    def __call__(self, rendering: Rendering) -> Tensor:
        rgba = torch.cat([rendering.image, rendering.alpha[..., None]], -1)
        return (self.weights.to(rgba) * rgba).sum()


def assert_matches_reference(scene: Scene, monkeypatch: pytest.MonkeyPatch, backend: Backend = "native") -> None:
    of_pictures, of_gradients = TOLERANCES[backend]
    # Rounding alone gives about 2e-7 in the image and 2e-6 in the gradients.
    exact = scene.to(torch.float64)
    comparable = comparable_pixels(exact, monkeypatch)
    assert comparable.numel() < 100 or comparable.float().mean() > 0.8
    loss = WeightedSum(comparable, seed=0)
    expected, expected_gradients = gradients(exact, "reference", loss)
    found, found_gradients = gradients(scene, backend, loss)
    assert relative_error(found.image[comparable], expected.image[comparable]) < of_pictures
    assert relative_error(found.alpha[comparable], expected.alpha[comparable]) < of_pictures
    assert torch.equal(found.radii > 0, expected.radii > 0)
    assert ((found.radii - expected.radii).abs() <= 1).all()  # rounded up from 3 sigma
    errors = {name: relative_error(value, expected_gradients[name]) for name, value in found_gradients.items()}
    # The transmittance is 1 - alpha, which float32 rounds to 1e-7, however small it is.
    errors["background"] = min(
        errors["background"],
        float((found_gradients["background"] - expected_gradients["background"]).abs().max()) * 1e2,
    )
    large = {name for name, error in errors.items() if error >= of_gradients}
    if large:
        # Where terms cancel, float32 loses digits, whoever adds them. The reference in float32 tells how many. It
        # rounds 20 times less than the core, which has a faster exponential and adds in blocks.
        _, rounded_gradients = gradients(scene, "reference", loss)
        for name in large:
            cancelled = relative_error(rounded_gradients[name], expected_gradients[name])
            assert cancelled > 1e-5, errors
            assert errors[name] < 30 * cancelled, errors
