"""Kernels for a GPU compute what plain PyTorch does, forward and backward: in Triton's interpreter without a GPU.

float64 finds mistakes. In it, constants of the kernels and Python's numbers are float32, so 1e-6 is what remains; in
float32, sums in another order differ by up to 1e-5 of the largest number.
"""

import math
import os
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import mien
from mien.adam import FactoredGradient, FactoredMoments, FactoredTerm
from mien.avatar.ops import changed_gaussians
from mien.avatar.ops.bound_gaussians import pose_bound_gaussians_reference
from mien.avatar.ops.changed_gaussians import BASES, Changes, pose_changed_gaussians_reference
from mien.avatar.ops.expression_changes import LEAST_SEEN, MARGIN, ExpressionActivations
from mien.avatar.ops.feature_network import Layers
from mien.avatar.ops.surface_limits import RATIO, keep_on_surface_reference, limits_of_triangles, pull_colors
from mien.avatar.ops.triangle_penalties import triangle_penalties_reference
from mien.face import FaceModel
from mien.kernels import VARIABLE, on_gpu
from mien.rotation import matrix_from_quaternion
from mien.training.adam import FactoredUpdate, factored_update_reference
from mien.training.density_control.gradient import observe_reference
from mien.training.losses import alpha_loss_reference, photometric_loss_reference
from mien.training.whole_head.mouth_interior import covered_reference
from toy_scene import random, toy_face, toy_face_model

pytest.importorskip("triton", reason="kernels for a GPU are written in Triton")
pytestmark = pytest.mark.unchecked

TRIANGLES = 20
DTYPES = {torch.float64: 1e-6, torch.float32: 1e-5}
"""Largest difference, as a share of the largest number, by dtype."""


def numbers(like: Tensor, *shape: int, seed: int = 0) -> Tensor:
    return random(*shape, seed=seed).to(like)


def triangles(n: int) -> Tensor:
    return torch.randint(0, TRIANGLES, (n,), generator=torch.Generator().manual_seed(1))


def learnt(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return copies, of which those with fractions need a gradient."""
    return {name: own.clone().requires_grad_(own.is_floating_point()) for name, own in tensors.items()}


def weighted(results: Sequence[Tensor]) -> Tensor:
    """Return a sum with a weight of its own for every number."""
    parts = [(own * numbers(own, *(own.shape or (1,)), seed=50 + i)).sum() for i, own in enumerate(results)]
    return torch.stack(parts).sum()


def assert_close(expected: Any, found: Any, name: str = "") -> None:
    """Check that the numbers are the same but for rounding, and NaN at the same places."""
    assert (expected is None) == (found is None), name
    if expected is None or not expected.numel():
        return
    assert expected.shape == found.shape, name
    largest = float(expected.detach().nan_to_num().abs().max())
    bound = DTYPES.get(expected.dtype, 0) * max(largest, 1e-30)
    torch.testing.assert_close(found, expected, atol=bound, rtol=0, equal_nan=True, msg=lambda text: f"{name}: {text}")


def same(reference: Callable, kernel: Callable, tensors: dict[str, Tensor]) -> None:
    """Check results, and gradients by all tensors, of two functions of a dict of tensors."""
    both = []
    for function in (reference, kernel):
        own = learnt(tensors)
        results = [one for one in function(own) if one is not None]
        weighted(results).backward()
        both.append((results, own))
    (expected, before), (found, after) = both
    for index, (one, other) in enumerate(zip(expected, found, strict=True)):
        assert_close(one, other, f"result {index}")
    for name, one in before.items():
        assert_close(one.grad, after[name].grad, f"gradient by {name}")


dtypes = pytest.mark.parametrize("like", [torch.zeros((), dtype=dtype) for dtype in DTYPES], ids=str)
counts = pytest.mark.parametrize("n", [0, 1, 137])


@dtypes
@counts
@pytest.mark.parametrize("bad", [False, True])
def test_penalties(like: Tensor, n: int, bad: bool) -> None:
    from mien.avatar.ops.triangle_penalties_gpu import triangle_penalties

    tensors = {"means": numbers(like, n, 3), "log_scales": numbers(like, n, 3, seed=1)}
    if bad and n:
        tensors["means"][n // 2, 1] = math.nan
    rest = (torch.randint(0, 3, (n,), generator=torch.Generator().manual_seed(2)).int(), (1.0, 0.6), (0.01, 1.0))
    if bad and n:
        rest[0][n // 2] = 1
    same(
        lambda own: triangle_penalties_reference(own["means"], own["log_scales"], *rest),
        lambda own: triangle_penalties(own["means"], own["log_scales"], *rest),
        tensors,
    )


@dtypes
@pytest.mark.parametrize(
    ("size", "parts", "box"),
    [((7, 9), (), None), ((9, 14), ((3, 2, 8, 5), (6, 3, 8, 6)), None), ((8, 6), (), (1, 2, 3, 4)), ((1, 1), (), None)],
)
def test_losses_of_pictures(like: Tensor, size: tuple[int, int], parts: tuple, box: Any) -> None:
    """The target has bytes, or with parts, numbers with fractions."""
    from mien.training.losses_gpu import alpha_loss, photometric_loss

    whole = (0, 0, size[1], size[0])
    picture = torch.randint(0, 256, (*size, 3), generator=torch.Generator().manual_seed(2)).to(torch.uint8)
    target = picture.to(like) / 255 if parts else picture

    def reference(own: dict[str, Tensor]) -> tuple[Tensor, ...]:
        loss = photometric_loss_reference(own["image"], target, 0.8, 0.2, box, parts, 0.5)
        return loss, alpha_loss_reference(own["image"][..., 0], picture[..., 0], 0.3)

    def kernel(own: dict[str, Tensor]) -> tuple[Tensor, ...]:
        loss = photometric_loss(own["image"], target, (0.8, 0.2), box or whole, parts, 0.5)
        return loss, alpha_loss(own["image"][..., 0], picture[..., 0], 0.3)

    same(reference, kernel, {"image": numbers(like, *size, 3).sigmoid()})


def test_a_picture_that_is_not_finite_has_no_finite_loss() -> None:
    from mien.training.losses_gpu import alpha_loss, photometric_loss

    image, target = torch.full((9, 8, 3), 0.5), torch.zeros(9, 8, 3, dtype=torch.uint8)
    image[4, 4, 1] = math.nan
    assert bool(photometric_loss(image, target, (0.8, 0.2), (0, 0, 8, 9), (), 0.0).isnan())
    assert bool(alpha_loss(image[..., 1], target[..., 1], 0.3).isnan())


def jointed(like: Tensor) -> FaceModel:
    """A face model with correctives, and a joint that moves with another.

    The kernel blends transforms to the world, so weights have to sum to 1 in the dtype: a head is half a metre away.
    """
    model, v = toy_face_model(), len(toy_face_model().template)
    weights = model.skinning_weights.double()
    return replace(
        model, pose_basis=0.01 * random(9, v, 3), joint_parents=(-1, 0, 1),
        skinning_weights=weights / weights.sum(1, keepdim=True),
        joint_identity_basis=0.01 * random(2, 3, 3, seed=5), joint_translation_basis=0.01 * random(2, 3, 3, seed=6),
    ).to(like)  # fmt: skip


@dtypes
@counts
@pytest.mark.parametrize("in_head", [True, False])
@pytest.mark.parametrize("turn", [0.0, 1.0])
def test_posed_and_bound_gaussians(like: Tensor, n: int, in_head: bool, turn: float) -> None:
    """One triangle is degenerate. Covariances carry the gradients, and quats and scales say the same."""
    from mien.avatar.ops.bound_gaussians_gpu import pose_bound_gaussians

    model, face = jointed(like), toy_face(3)[1].to(like)
    model.faces[3] = model.faces[3, :1]
    fixed = {name: own for name, own in face.tensors().items() if name in ("identity", "vertex_offsets")}
    moving = {name: own for name, own in face.tensors().items() if name not in fixed}
    moving["head_rotation"] = turn * moving["head_rotation"]
    tensors = {
        "face_index": triangles(n), "means": numbers(like, n, 3), "quats": numbers(like, n, 4, seed=2),
        "log_scales": numbers(like, n, 3, seed=3), "opacity_logits": numbers(like, n, seed=4), **moving,
    }  # fmt: skip

    def pose(function: Callable) -> Callable:
        def posed(own: dict[str, Tensor]) -> list[Tensor | None]:
            face_of = replace(face, **{name: own[name] for name in moving})
            found = function(model, face_of, own, numbers(like, n, 1, 3), in_head)
            axes = matrix_from_quaternion(found.quats) * found.scales[:, None]
            squares = (axes @ axes.mT)[:, (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)]
            if found.covariances is not None:
                assert_close(squares, found.covariances)
                squares = found.covariances
            # In units in which gradients of the face are about 1.
            return [found.means, 1e3 * squares, found.opacities, found.T_world_local]

        return posed

    if in_head:
        same(pose(pose_bound_gaussians_reference), pose(pose_bound_gaussians), tensors)
        return
    # Gradients of triangles in the world nearly cancel in that of the head's place.
    tensors = {name: own.double() if own.is_floating_point() else own for name, own in tensors.items()}
    if like.dtype == torch.float64:
        same(pose(pose_bound_gaussians_reference), pose(pose_bound_gaussians), tensors)


@dtypes
@counts
@pytest.mark.parametrize(
    ("bases", "features", "degree"), [(BASES[:1], True, 0), (BASES, True, 1), ((), True, 0), (BASES[1:], False, 0)]
)
def test_changes_of_gaussians(
    like: Tensor, n: int, bases: tuple[str, ...], features: bool, degree: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    from mien.avatar.ops.changed_gaussians_gpu import changed

    monkeypatch.setattr(changed_gaussians, "pose_bound_gaussians", lambda _, __, own, sh, ___: (own, sh))
    rank, count, width, hidden, k = 3, 5, 6, 7, (degree + 1) ** 2
    tensors = {
        "means": numbers(like, n, 3), "opacity_logits": numbers(like, n, seed=3), "sh": numbers(like, n, k, 3, seed=4),
        "offset_basis": numbers(like, n, 3, rank, seed=5), "color_basis": numbers(like, n, 3, rank, seed=6),
        "opacity_basis": numbers(like, n, rank, seed=7), "neutral_features": numbers(like, n, width, seed=8),
        "feature_bases": numbers(like, n, count, width, seed=9), "first": numbers(like, hidden, width, seed=10),
        "last": numbers(like, 4, hidden, seed=11), "face_index": triangles(n),
        "quats": numbers(like, n, 4), "log_scales": numbers(like, n, 3),
    }  # fmt: skip
    terms = []

    def of(own: dict[str, Tensor]) -> Changes:
        gradient, none = FactoredGradient(), like.new_zeros(hidden)
        terms.append(gradient.terms)
        layers = Layers(own["first"], none, own["last"], none[:4]) if features else None
        activations = numbers(like, TRIANGLES, count, seed=12)
        return Changes(activations, bases, layers, gradient, (0.3, 0.1))

    def reference(own: dict[str, Tensor]) -> list[Tensor]:
        nobody: Any = None
        posed: Any = pose_changed_gaussians_reference(nobody, nobody, own, own["sh"], True, of(own))
        (local, sh), found = posed
        return [local["means"], local["opacity_logits"], sh, *(found[name] for name in sorted(found))]

    def kernel(own: dict[str, Tensor]) -> list[Tensor]:
        means, logits, sh, found = changed(own, own["sh"], of(own))
        sh = torch.cat([sh, own["sh"][:, 1:]], dim=1)
        return [means, logits, sh, *(found[name] for name in sorted(found))]

    if n == 0:
        assert all(not one.numel() or float(one.detach()) == 0 for one in kernel(learnt(tensors))[3:])
        return
    same(reference, kernel, tensors)
    if features:
        assert_close(terms[0][0].rows, terms[1][0].rows)


@dtypes
@pytest.mark.parametrize("count", [1, 3, 11])
@pytest.mark.parametrize("far", [0.5, 3.0])
def test_activations_of_a_face(like: Tensor, count: int, far: float) -> None:
    from mien.avatar.ops.expression_changes_gpu import activation_table

    model, face = toy_face_model(), toy_face(9)
    own = ExpressionActivations(model, face, model.neutral(1), count).to(like.dtype)
    face = face[3].to(like)
    face = replace(face, expression=far * face.expression, head_rotation=far * face.head_rotation)
    assert_close(own.reference(face), activation_table(own, face, MARGIN, LEAST_SEEN))


@dtypes
@counts
def test_what_changes_tensors_in_place(like: Tensor, n: int) -> None:
    """Limits of the surface, statistics of density control and updates of factored tensors."""
    from mien.avatar.ops.surface_limits_gpu import keep_on_surface
    from mien.training.training_gpu import factored_update, observe_view

    limits = limits_of_triangles(0.01 * numbers(like, TRIANGLES).abs() + 1e-3, 0.01 * numbers(like, TRIANGLES).abs())
    pulls = numbers(like, TRIANGLES, 4, seed=2).sigmoid()
    store = {
        "face_index": triangles(n), "means": numbers(like, n, 3), "quats": numbers(like, n, 4, seed=2),
        "log_scales": numbers(like, n, 3, seed=3), "sh_constant": numbers(like, n, 1, 3, seed=4),
    }  # fmt: skip
    found = {name: own.clone() for name, own in store.items()}
    keep_on_surface_reference(store, limits)
    pull_colors(store, pulls)
    index, means, quats, log_scales, colors = found.values()
    keep_on_surface(index, limits, math.log(RATIO), (means, quats, log_scales), colors, pulls)
    radii, gradient = torch.arange(n).int() - 3, numbers(like, n, 2, seed=5)
    known = [numbers(like, n).abs(), numbers(like, n).abs(), radii.flip(0).contiguous(), numbers(like, n, seed=8)]
    own = [one.clone() for one in known]
    observe_reference(gradient, radii, numbers(like, n, seed=9), (16.0, 8.0), *known)
    observe_view(gradient, radii, numbers(like, n, seed=9), (16.0, 8.0), *own)
    rows, columns = numbers(like, n, 5, seed=10), numbers(like, TRIANGLES, 3, seed=11)
    rows[::3] = 0
    terms = [FactoredTerm(rows, columns, triangles(n)), FactoredTerm(2 * rows, columns[:1])]
    values = [numbers(like, n, 3, 5) for _ in range(2)]
    states = [FactoredMoments(numbers(like, n, 5).square(), numbers(like, n).sigmoid()) for _ in range(2)]
    factored_update_reference(FactoredUpdate(values[0], terms, states[0], 0.01))
    factored_update(values[1], terms, states[1], 0.01)
    expected = [*store.values(), *known, values[0], states[0].second, states[0].weights]
    for one, other in zip(
        expected, [*found.values(), *own, values[1], states[1].second, states[1].weights], strict=True
    ):
        assert_close(one, other)


@dtypes
@counts
def test_hidden_gaussians(like: Tensor, n: int) -> None:
    from mien.training.training_gpu import covered

    hidden, color, own = torch.arange(TRIANGLES) % 3 == 0, (0.1, 0.2, 0.3), triangles(n)
    tensors = {"sh": numbers(like, n, 4, 3), "opacities": numbers(like, n)}
    same(
        lambda given: covered_reference(given["sh"], given["opacities"], hidden[own], like.new_tensor(color)),
        lambda given: covered(given["sh"], given["opacities"], hidden, own, color),
        tensors,
    )


@pytest.mark.slow
def test_kernels_compile_for_a_gpu() -> None:
    """The interpreter runs what Triton's compiler refuses."""
    command = [sys.executable, "compiled_kernels.py"]
    known = {name: value for name, value in os.environ.items() if name != "TRITON_INTERPRET"}
    found = subprocess.run(command, cwd=Path(__file__).parent, env=known, capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stderr
    names = set(found.stdout.split())
    kernels = {
        name
        for path in Path(mien.__file__).parent.rglob("*.py")
        for name in re.findall(r"launch\(\s*(_\w+),", path.read_text(encoding="utf-8"))
    }
    assert kernels - names == set()
    assert len(kernels) > 20


def test_a_variable_switches_kernels_off(monkeypatch: pytest.MonkeyPatch) -> None:
    for value, expected in (("1", True), ("0", False)):
        monkeypatch.setenv(VARIABLE, value)
        assert on_gpu(torch.zeros(3, device="meta")) is expected
