"""The native parts of posing and of training steps agree with their plain PyTorch twins, on every instruction set.
A table has them all. tests/test_feature_network.py, tests/test_point_avatar.py and others hold what is special."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import pytest
import torch
from torch import Tensor

import test_feature_network as features
import test_point_avatar as points
from instruction_sets import by_threads
from mien import _native
from mien.adam import FactoredGradient, FactoredMoments, FactoredTerm
from mien.avatar.avatar import ParameterGroup
from mien.avatar.ops import changed_gaussians as changing
from mien.avatar.ops.activation import sigmoid
from mien.avatar.ops.bound_gaussians import FACE_FIELDS, LOCAL
from mien.avatar.ops.feature_network import Layers
from mien.avatar.ops.skin_points import skin_points, skin_points_reference
from mien.avatar.ops.surface_limits import keep_on_surface, keep_on_surface_reference, limits_of_triangles, pull_colors
from mien.avatar.ops.triangle_frames import bind_to_world
from mien.avatar.ops.triangle_penalties import triangle_penalties, triangle_penalties_reference
from mien.avatar.settings import Progress, Rate
from mien.avatar.store import GaussianStore, Moments
from mien.training import adam as updates
from mien.training.density_control.gradient import observe_reference
from mien.training.losses import alpha_loss, alpha_loss_reference, color_loss, color_loss_reference
from toy_scene import random, toy_face, toy_face_model

Tensors = list[Tensor]


def some_radii(count: int) -> Tensor:
    return torch.randint(0, 3, (count,), generator=torch.Generator().manual_seed(2), dtype=torch.int32)


def near(rtol: float, atol: float) -> Callable[[int, Tensor, Tensor], None]:
    """Compare number by number."""
    return lambda index, own, truth: torch.testing.assert_close(
        own.double(), truth.double(), rtol=rtol, atol=atol, msg=lambda text: f"{index}: {text}"
    )


def near_by_norm(most: float) -> Callable[[int, Tensor, Tensor], None]:
    """Compare whole tensors, for sums whose terms cancel."""

    def compare(index: int, own: Tensor, truth: Tensor) -> None:
        assert own.shape == truth.shape
        assert float((own.double() - truth).norm() / truth.norm().clamp_min(1e-6)) < most, index

    return compare


@dataclass(frozen=True)
class Kernel:
    """Something with two implementations. `run(inputs, native)` returns what it computes from inputs of a size."""

    make: Callable[[Any], Tensors]
    run: Callable[[Tensors, bool], Tensors]
    sizes: tuple[Any, ...]
    large: Any
    """A size that is divided among threads."""
    compare: Callable[[int, Tensor, Tensor], None]


def adam_inputs(count: int) -> Tensors:
    return [0.1 * random(count, seed=1), random(count, seed=2).square(), random(count, seed=3), random(count)]


def adam(given: Tensors, native: bool, frames: int) -> Tensors:
    def update() -> updates.Update:
        first, second, values, gradient = (tensor.clone() for tensor in given)
        return updates.Update(values, gradient, Moments(first, second, torch.tensor(3.0)), 0.01)

    one = update()
    updates.update_all([one, update()], frames) if native else updates.update_reference(one, frames=frames)
    return [one.values, one.moments.first, one.moments.second, one.moments.step]


def observed_inputs(count: int) -> Tensors:
    view = [random(count, 2), some_radii(count), random(count, seed=5).sigmoid()]
    views = torch.ones(count, dtype=torch.int32)
    return [*view, random(count, seed=6).abs(), random(count, seed=7).abs(), views, random(count, seed=8).sigmoid()]


def observed(given: Tensors, native: bool) -> Tensors:
    (gradient, radii, opacities), scale = given[:3], (256.0, 128.0)
    statistics = [tensor.clone() for tensor in given[3:]]
    if native:
        _native.observe_view(scale, gradient, radii, opacities, *statistics)
    else:
        observe_reference(gradient, radii, opacities, scale, *statistics)
    return statistics


def opacity_inputs(size: tuple[int, int]) -> Tensors:
    alpha, matte = random(*size).sigmoid(), (255 * random(*size, seed=1).sigmoid()).to(torch.uint8)
    alpha[0] = matte[0].float() * (1 / 255)
    return [alpha, matte]


def opacity_loss(given: Tensors, native: bool) -> Tensors:
    """Where alpha is the matte, as in the first row, the gradient is 0."""
    alpha = given[0].clone().requires_grad_()
    loss = 2 * (alpha_loss if native else alpha_loss_reference)(alpha, given[1], 0.7)
    (gradient,) = torch.autograd.grad(loss, alpha)
    assert not native or not gradient[0].any()
    return [loss.detach(), gradient[1:]]


def color_inputs(size: tuple[int, int]) -> Tensors:
    image, picture = random(*size, 3).sigmoid(), (255 * random(*size, 3, seed=1).sigmoid()).to(torch.uint8)
    return [image, picture, random(*size, seed=2) > 0]


def color_difference(given: Tensors, native: bool) -> Tensors:
    image = given[0].clone().requires_grad_()
    loss = color_loss if native else color_loss_reference
    own = (loss(image, given[1], 0.7), 2 * loss(image, given[1], 0.7, 0.1, given[2]))
    return [*(one.detach() for one in own), *(torch.autograd.grad(one, image)[0] for one in own)]


def mean_square(given: Tensors, native: bool) -> Tensors:
    image, picture = given
    if native:
        return [torch.tensor(_native.mean_squared_difference(image, picture))]
    return [(image - picture.double() / 255).square().sum() / max(image.numel(), 1)]


def penalty_inputs(count: int) -> Tensors:
    means = random(count, 3)
    means[:2] = 0  # whose length has no derivative
    return [means, random(count, 3, seed=1), some_radii(count)]


def penalties(given: Tensors, native: bool) -> Tensors:
    means, log_scales = (tensor.clone().requires_grad_() for tensor in given[:2])
    function = triangle_penalties if native else triangle_penalties_reference
    position, scale = function(means, log_scales, given[2], thresholds=(1.0, 0.6), weights=(0.5, 2.0))
    return [position.detach(), scale.detach(), *torch.autograd.grad(3 * position + scale, [means, log_scales])]


def factored_inputs(size: tuple[int, int, int]) -> Tensors:
    """An update of so many features and terms, of which some lack rows that others have. The second has a table."""
    f, terms, table_rows = size
    update = features.update_of(f=f, table_rows=table_rows)
    assert isinstance(update.moments, FactoredMoments)
    more = [random(2000, f, seed=7), random(2, 5, seed=8), random(2000, f, seed=9), torch.zeros(5)]
    more[0][1::3] = 0
    both = [*update.terms[0][:2], *more[: 2 * (terms - 1)]]
    return [update.values, update.moments.second, update.moments.weights, *both]


def terms_of(given: Tensors) -> list[FactoredTerm]:
    pairs = zip(given[::2], given[1::2], strict=True)
    return [FactoredTerm(rows, columns, features.places(columns, len(rows))) for rows, columns in pairs]


def factored(given: Tensors, native: bool) -> Tensors:
    values, second, weights, *terms = (tensor.clone() for tensor in given)
    moments = FactoredMoments(second, weights)
    update = updates.FactoredUpdate(values, terms_of(terms), moments, 0.01)
    for one in (update._replace(rate=0.0), update, update, update):
        (updates.factored_update if native else updates.factored_update_reference)(one)
    return [values, second, weights]


def published_inputs(size: tuple[int, int, int]) -> Tensors:
    values, terms, moments, _ = features.published(*size)
    assert isinstance(moments, Moments)
    return [values, moments.first, moments.second, *(one for term in terms for one in term[:2])]


def published(given: Tensors, native: bool) -> Tensors:
    """Adam as published, by factors. The reference is another dtype."""
    values, first, second, *terms = (tensor.clone() for tensor in given)
    moments = Moments(first, second, torch.tensor(3.0))
    updates.factored_update(updates.FactoredUpdate(values, terms_of(terms), moments, 0.01))
    return [values, first, second, moments.step]


def skin_inputs(size: tuple[int, int, int]) -> Tensors:
    """Points, displacements, weights, and bones in both poses, of points, poses, bones."""
    n, b, k = size
    bones = [torch.eye(3, 4) + 0.1 * random(k, 3, 4), torch.eye(3, 4) + 0.2 * random(b, k, 3, 4, seed=1)]
    return [random(n, 3, seed=2), 0.1 * random(b, n, 3, seed=3), random(n, k, seed=4).softmax(-1), *bones]


def skinned(given: Tensors, native: bool) -> Tensors:
    """Posed points and gradients. Every third point has none."""
    leaves = [tensor.clone().requires_grad_(index != 3) for index, tensor in enumerate(given)]
    posed = (skin_points if native else skin_points_reference)(*leaves)
    by = random(*posed.shape, seed=1)
    by[:, ::3] = 0
    return [posed.detach(), *torch.autograd.grad(posed, [leaf for leaf in leaves if leaf.requires_grad], by.to(posed))]


def bound_inputs(size: tuple[tuple[int, ...], int]) -> Tensors:
    """Vertices at timesteps, faces, and the face, mean, quaternion and scales of Gaussians.
    They are turned in every way, so that each of the four quaternion formulas is used; quaternions have any length."""
    timesteps, count = size
    faces = torch.stack([torch.randperm(20, generator=torch.Generator().manual_seed(i))[:3] for i in range(30)])
    index = torch.randint(0, 30, (count,), generator=torch.Generator().manual_seed(1))
    local = [random(count, width, seed=width) for width in (3, 4)]
    return [0.1 * random(*timesteps, 20, 3), faces, index, *local, random(count, 3, seed=5)]


def bound(given: Tensors, native: bool) -> Tensors:
    """In the world, and gradients of a loss that weighs every number differently. The reference is another dtype."""
    vertices, *local = [tensor.clone().requires_grad_() for tensor in (given[0], *given[3:])]
    world = bind_to_world(vertices, given[1], given[2], *local)
    loss = torch.stack([(one * random(*one.shape, seed=9).to(one)).sum() for one in world]).sum()
    return [*(one.detach() for one in world), *torch.autograd.grad(loss, [vertices, *local])]


def compare_bound(index: int, own: Tensor, truth: Tensor) -> None:
    """20 vertices carry 100 Gaussians, so gradients are sums of many float32 terms."""
    near(2e-6, 1e-6)(index, own, truth) if index < 3 else near_by_norm(2e-5)(index, own, truth)


def limited_inputs(count: int) -> Tensors:
    quats = random(count, 4, seed=1)
    quats[:2] = 0
    pulls = torch.tensor([[1.0, -1, 0.5, 0.1]] * 4 + [[1.0, -1, 0.5, 0]])
    return [random(count, 3), quats, random(count, 3, seed=2), random(count, 1, 3, seed=3), pulls]


def limited(given: Tensors, native: bool, pulled: bool) -> Tensors:
    """Gaussians within the limits of the surface, with colours that are pulled to those of triangles, or not."""
    names = ("means", "quats", "log_scales", "sh_constant")
    made = {name: tensor.clone() for name, tensor in zip(names, given[:4], strict=True)}
    store = GaussianStore(made, {"face_index": torch.arange(len(given[0])) % 5})
    sizes = torch.tensor([0.001, 0.002, 0.004, 0.01, 0.1])
    table = limits_of_triangles(sizes, torch.tensor([0, 0.01, 0, 0.02, 0]), torch.tensor([1, 1, 2, 2, 50.0]))
    if native:
        keep_on_surface(store, table, given[4] if pulled else None)
    else:
        keep_on_surface_reference(store, table.to(given[0]))
        if pulled:
            pull_colors(store, given[4])
    moved = not torch.equal(store["sh_constant"].detach(), given[3])
    assert moved == (pulled and len(given[0]) > 0)
    return [store[name].detach() for name in names]


def change_inputs(count: int) -> Tensors:
    """Activations of triangles, then for each Gaussian its triangle, its values, its three bases, and its features with
    the layers of their network. Some features are 0."""
    triangles = len(toy_face_model().faces)
    index = torch.randint(0, triangles, (count,), generator=torch.Generator().manual_seed(1))
    shapes = ((3,), (4,), (3,), (), (1, 3), (3, 2), (3, 2), (2,), (6,), (5, 6))
    own = [0.5 * random(count, *shape, seed=seed) for seed, shape in enumerate(shapes)]
    own[-1][::3] = own[-2][::3] = 0
    return [random(triangles, 5), index, *own, random(20, 6, seed=20), random(4, 20, seed=21)]


def changed(given: Tensors, native: bool, bases: tuple[str, ...], featured: bool, in_head: bool) -> Tensors:
    """Posed Gaussians, their changes and penalties, and gradients of a loss that weighs every number differently."""
    names = (*LOCAL, "sh", *changing.BASES, "neutral_features", "feature_bases", "weight1", "weight2")
    leaves = {name: own.clone().requires_grad_() for name, own in zip(names, given[2:], strict=True)}
    model, face = toy_face_model(), toy_face(3)[1].detach()
    like, weights = given[2], (leaves["weight1"], leaves["weight2"])
    model, face = model.to(like), face.to(like)
    for name in FACE_FIELDS:
        leaves[name] = getattr(face, name).clone().requires_grad_()
    face, gradient = replace(face, **{name: leaves[name] for name in FACE_FIELDS}), FactoredGradient()
    layers = Layers(weights[0], like.new_zeros(20), weights[1], like.new_zeros(4)) if featured else None
    changes = changing.Changes(given[0], bases, layers, gradient, (3.0, 0.1))
    pose = changing.pose_changed_gaussians if native else changing.pose_changed_gaussians_reference
    posed, found = pose(model, face, leaves | {"face_index": given[1]}, leaves["sh"], in_head, changes)
    parts = [
        posed.means,
        posed.quats,
        posed.scales,
        posed.opacities,
        posed.sh,
        *(found[name] for name in sorted(found)),
    ]
    parts += [posed.T_world_local] if posed.T_world_local is not None else []
    loss = torch.stack([part.flatten() @ random(part.numel(), seed=9).to(part) for part in parts]).sum()
    gradients = torch.autograd.grad(loss, [*leaves.values()], allow_unused=True)
    terms = [features.product(*term) for term in gradient.take()]
    return [*(part.detach() for part in parts), *(own for own in gradients if own is not None), *terms]


def both(native: Callable[..., Tensor], reference: Callable[..., Tensor]) -> Callable[[Tensors, bool], Tensors]:
    """Values and gradients of a function of some tensors."""

    def run(given: Tensors, own: bool) -> Tensors:
        leaves = [tensor.clone().requires_grad_() for tensor in given]
        values = (native if own else reference)(*leaves)
        return [values.detach(), *torch.autograd.grad(values, leaves, random(*values.shape, seed=9).to(values))]

    return run


def feature_network(given: Tensors, native: bool) -> Tensors:
    return (features.ours if native else features.theirs)(given[:-2], (given[-2], given[-1]))


def compare_activated(index: int, own: Tensor, truth: Tensor) -> None:
    near(0, 5e-7 if index else 1.5e-7)(index, own, truth)
    if index == 0:
        near(4e-6, 0)(index, own, truth)


COUNTS, PICTURES = (0, 1, 15, 16, 4097), ((1, 1), (7, 5), (40, 130), (200, 301))
KERNELS = {
    # If the second moment is small, an update is large (up to 10), and its last digits differ in float32.
    **{f"adam{frames}": Kernel(adam_inputs, partial(adam, frames=frames), COUNTS, 20_000, near(1e-5, 1e-5))
       for frames in (1, 2)},
    "factored": Kernel(factored_inputs, factored, ((1, 1, 0), (16, 3, 0), (19, 1, 4), (32, 2, 0)), (32, 2, 0),
                       near(1e-5, 1e-6)),
    "published": Kernel(published_inputs, published, ((1, 1, 0), (16, 1, 3), (19, 3, 0), (32, 2, 4)), (32, 1, 4),
                        near(1e-5, 1e-6)),
    "observed": Kernel(observed_inputs, observed, COUNTS, 20_000, near(1.3e-6, 1e-5)),
    "colors": Kernel(color_inputs, color_difference, PICTURES, (200, 301), near(1e-5, 1e-7)),
    "alpha": Kernel(opacity_inputs, opacity_loss, PICTURES, (200, 301), near(1e-5, 1e-7)),
    "squares": Kernel(lambda size: [random(*size, 3), (255 * random(*size, 3).sigmoid().flip(0)).to(torch.uint8)],
                      mean_square, ((0, 5), (1, 1), (40, 130)), (200, 301), near(1e-5, 0)),
    "penalties": Kernel(penalty_inputs, penalties, COUNTS, 20_000, near(1e-5, 1e-7)),
    "skinned": Kernel(skin_inputs, skinned, ((3000, 1, 6), (7, 3, 2), (1, 1, 1), (0, 2, 3)), (3000, 1, 6),
                      near_by_norm(1e-5)),
    "bound": Kernel(bound_inputs, bound, (((), 100), ((3,), 100), ((2, 2), 100), ((0,), 100)), ((), 9000),
                    compare_bound),
    "limited": Kernel(limited_inputs, partial(limited, pulled=False), (0, 1, 5000), 5000, near(1e-5, 1e-6)),
    "pulled": Kernel(limited_inputs, partial(limited, pulled=True), (0, 1, 5000), 5000, near(1e-5, 1e-6)),
    "features": Kernel(lambda size: [*features.arguments(size), *features.gradients_of(size)], feature_network,
                       tuple(features.SIZES), features.SIZES[3], near_by_norm(1e-5)),
    **{
        f"changes{number}": Kernel(change_inputs, partial(changed, bases=bases, featured=featured, in_head=in_head),
                                   (1, 17, 5000), 20_000, near_by_norm(1e-5))
        for number, (bases, featured, in_head) in enumerate((
            (("offset_basis",), True, True), (changing.BASES, True, False), (changing.BASES, False, True),
            ((), True, True),
        ))
    },
    "sigmoid": Kernel(lambda count: [8 * random(count)], both(sigmoid, torch.sigmoid), (0, 1, 15, 17, 40_001), 50_000,
                      compare_activated),
    **{
        f"points{number}": Kernel(partial(points.arguments), partial(points.results, sizes), (sizes,), sizes,
                                  near_by_norm(1e-5))
        for number, sizes in enumerate(points.NETWORKS)
    },
}  # fmt: skip
every_kernel = pytest.mark.parametrize("name", KERNELS)


@every_kernel
def test_native_equals_its_reference(isa: str, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    kernel = KERNELS[name]
    for size in kernel.sizes:
        given = kernel.make(size)
        exact = [tensor.double() if tensor.is_floating_point() else tensor for tensor in given]
        expected = kernel.run(exact, False)
        with monkeypatch.context() as only_native:
            for reference in ("update_reference", "factored_update_reference"):
                only_native.setattr(f"mien.training.adam.{reference}", None)
            found = kernel.run(given, True)
        for index, (own, truth) in enumerate(zip(found, expected, strict=True)):
            kernel.compare(index, own, truth)


@pytest.mark.exact
@every_kernel
def test_threads_do_not_change_a_bit(name: str) -> None:
    kernel = KERNELS[name]
    given = kernel.make(kernel.large)
    first, *others = by_threads(lambda: kernel.run(given, True), (1, 2, 3))
    assert all(torch.equal(one, two) for other in others for one, two in zip(first, other, strict=True))


def test_sigmoids_far_out_and_of_nan_are_torchs(isa: str) -> None:
    values = torch.tensor([-1e30, -200.0, 200.0, 1e30, torch.inf, -torch.inf, torch.nan, 0.0])
    torch.testing.assert_close(sigmoid(values), values.sigmoid(), equal_nan=True, rtol=1e-6, atol=1e-29)


def test_adam_takes_another_epsilon_and_what_is_not_dense_by_the_reference() -> None:
    """The core has one epsilon. An update with another is made in PyTorch, and is as small as the formula says."""
    for epsilon, moved in ((1e-15, 0.1), (1e-8, 0.1 / 11), (1e-9, 0.05)):
        values = torch.zeros(4, 3)
        updates.update_all(
            [updates.Update(values, torch.full((1, 3), 1e-9).expand(4, 3), Moments.zeros(values), 0.1, epsilon)]
        )
        torch.testing.assert_close(values, torch.full((4, 3), -moved), rtol=1e-4, atol=0)
        of_a_group = torch.zeros(4, 3, requires_grad=True)
        of_a_group.grad = torch.full((4, 3), 1e-9)
        updates.Adam().step([ParameterGroup("one", {"one": of_a_group}, Rate(0.1), epsilon=epsilon)], Progress(0, 1))
        torch.testing.assert_close(of_a_group.detach(), values, rtol=1e-4, atol=0)
