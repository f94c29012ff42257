"""Density control decides on hand-made renderings which Gaussians grow, which are pruned, and where children go."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from known import known
from mien.adam import Moments
from mien.avatar.avatar import Posed
from mien.avatar.density import GradientDensity, RefillDensity, split_along_axes
from mien.avatar.settings import GradientSettings, Progress, RefillSettings
from mien.avatar.store import GaussianStore
from mien.gaussians import Gaussians, Rendering
from mien.rotation import matrix_from_quaternion
from mien.training.density_control.gradient import GradientStrategy
from mien.training.density_control.refill import RefillStrategy
from mien.training.trainer import density_strategy

WIDTH, HEIGHT, FIRST = 40, 20, Progress(0, 100)
EVERY_STEP = GradientSettings(start=0.0, stop=1.0, rounds=101, split_size=0.0025, opacity_resets=())


def make_store(scales: list[float], opacity: float = 0.5) -> GaussianStore:
    n = len(scales)
    log_scales, logits = torch.tensor(scales).log()[:, None].repeat(1, 3), torch.logit(torch.full((n,), opacity))
    values = {"means": torch.arange(3.0 * n).reshape(n, 3), "quats": torch.eye(4)[:1].repeat(n, 1)}
    return GaussianStore(values | {"log_scales": log_scales, "opacity_logits": logits}, {"face_index": torch.arange(n)})


def pose(store: GaussianStore, opacities: list[float] | None = None) -> Posed:
    drawn = store["opacity_logits"].sigmoid() if opacities is None else torch.tensor(opacities)
    gaussians = Gaussians(
        store["means"][None], store["quats"][None], store["log_scales"].exp()[None], drawn,
        torch.zeros(len(store), 1, 3),
    )  # fmt: skip
    return Posed(gaussians, {})


def rendering(gradients: list[float], radii: list[int] | None = None) -> Rendering:
    """Return a rendering whose centres have these gradients along x, in pixels."""
    n = len(gradients)
    offset = torch.zeros(n, 2, requires_grad=True)
    offset.grad = torch.stack([torch.tensor(gradients), torch.zeros(n)], dim=-1)
    size = torch.tensor(radii if radii else [3] * n, dtype=torch.int32)
    return Rendering(torch.zeros(HEIGHT, WIDTH, 3), torch.zeros(HEIGHT, WIDTH), size, offset)


def control(store: GaussianStore, settings: GradientSettings = EVERY_STEP, **hooks: Any) -> GradientStrategy:
    hooks |= {"judged_opacities": lambda store, seen: store["opacity_logits"].detach().sigmoid()}
    strategy = density_strategy(GradientDensity(settings, opacity_logits="opacity_logits", **hooks), store)
    assert isinstance(strategy, GradientStrategy)
    return strategy


def random() -> torch.Generator:
    return torch.Generator().manual_seed(3)


# In normalised device coordinates a gradient in pixels counts WIDTH / 2 = 20 times: the threshold is 1e-5 here.
ABOVE, BELOW = 1.1e-5, 0.9e-5


def faces(
    scales: list[float], gradients: list[float], opacities: list[float] | None = None,
    settings: GradientSettings = EVERY_STEP, progress: Progress = FIRST, radii: list[int] | None = None,
    **hooks: object,
) -> list[int]:  # fmt: skip
    """The faces of the Gaussians after a round."""
    store = make_store(scales)
    store.assign("opacity_logits", torch.logit(torch.tensor(opacities or [0.5] * len(scales))))
    strategy = control(store, settings, **hooks)
    strategy.observe(pose(store), rendering(gradients, radii))
    strategy.adapt(store, pose(store), progress, random)
    return store["face_index"].tolist()


def test_small_ones_duplicate_and_large_ones_split_by_their_mean_gradient() -> None:
    store = make_store([0.001, 0.001, 0.004, 0.004])
    strategy = control(store)
    strategy.observe(pose(store), rendering([ABOVE, BELOW, ABOVE, BELOW]))
    assert strategy.adapt(store, pose(store), FIRST, random)
    # 0, 1 and 3 stay, a copy of 0, and two children that replace 2.
    assert store["face_index"].tolist() == [0, 1, 3, 0, 2, 2]
    assert torch.equal(store["means"][3], store["means"][0])
    torch.testing.assert_close(store["log_scales"][4:].exp(), torch.full((2, 3), 0.004 / 1.6))
    assert not torch.equal(store["means"][4], store["means"][5])
    # Also after a checkpoint.
    store = make_store([0.001, 0.001])
    strategy, other = control(store), control(store)
    strategy.observe(pose(store), rendering([ABOVE, ABOVE]))
    strategy.observe(pose(store), rendering([0.0, 0.0], radii=[0, 3]))
    other.load_state(strategy.state())
    assert all(torch.equal(tensor, other.state()[name]) for name, tensor in strategy.state().items())
    other.adapt(store, pose(store), FIRST, random)
    assert store["face_index"].tolist() == [0, 1, 0]


def test_what_goes_and_what_grows() -> None:
    resets, nothing = replace(EVERY_STEP, opacity_resets=(0.0, 0.5)), [0.0] * 3
    # Faint and huge ones go. Size is judged only after a reset that follows the start.
    assert faces([0.001, 0.001, 0.2], nothing, [0.004, 0.006, 0.5], resets, Progress(60, 100)) == [1]
    assert faces([1.0], [0.0], None, resets, Progress(10, 100)) == [0]
    # A round prunes first, so that what goes does not grow. The published code grows first (docs/paper_preset.md).
    assert faces([0.001, 0.001, 0.004], [ABOVE] * 3, [0.004, 0.5, 0.004]) == [1, 1]
    # An avatar keeps one Gaussian, whatever is pruned.
    assert faces([0.001] * 3, nothing, [0.001, 0.003, 0.002]) == [1]
    # Growth stops at the limit with those that pull most.
    capped = replace(EVERY_STEP, max_gaussians=5)
    assert faces([0.001] * 4, [2e-5, 3e-5, 4e-5, 1e-6], None, capped) == [0, 1, 2, 3, 2]
    # Sizes may be parts of the extent of the cameras.
    of_extent = replace(EVERY_STEP, size_unit="extent", split_size=0.01, prune_size=0.1, opacity_resets=(0.5,))
    for extent, expected in ((1.0, [0, 0, 1, 1]), (4.0, [0, 0, 1, 1, 2, 2]), (0.5, [0, 0])):
        progress = Progress(90, 100, extent=extent)
        assert sorted(faces([0.004, 0.08, 0.35], [ABOVE] * 3, None, of_extent, progress)) == expected


@pytest.mark.parametrize(("axis", "side"), [(0, WIDTH), (1, HEIGHT)])
def test_gradients_weigh_by_the_pictures_own_width_and_height(axis: int, side: int) -> None:
    store, drawn = make_store([0.001, 0.001]), rendering([0.0, 0.0])
    strategy, threshold = control(store), EVERY_STEP.grow_gradient / (side / 2)
    known(drawn.means2d_offset.grad)[:, axis] = torch.tensor([0.99 * threshold, 1.01 * threshold])
    strategy.observe(pose(store), drawn)
    strategy.adapt(store, pose(store), FIRST, random)
    assert store["face_index"].tolist() == [0, 1, 1]


def test_rounds_and_resets_happen_at_their_fractions() -> None:
    settings = GradientSettings(start=0.2, stop=0.6, rounds=3, opacity_resets=(0.5,))
    store, rounds, opacities = make_store([0.001]), [], []
    strategy = control(store, settings)
    for step in range(50):
        strategy.observe(pose(store), rendering([0.0]))
        if strategy.adapt(store, pose(store), Progress(step, 50), random):
            rounds.append(step + 1)
        opacities.append(float(store["opacity_logits"].detach().sigmoid()))
    assert (rounds, opacities) == ([10, 20, 30], pytest.approx([0.5] * 24 + [0.01] * 26))


@pytest.mark.parametrize("scale", [0.5, 0.002])
def test_split_children_are_samples_of_their_parent(scale: float) -> None:
    """Children of a split are samples of their parent. The published code samples with another frame's scale."""
    quat = torch.nn.functional.normalize(torch.tensor([0.9, 0.2, -0.3, 0.1]), dim=0)
    store = make_store([scale])
    store.assign("quats", quat[None])
    store.assign("log_scales", torch.tensor([[scale, scale / 5, scale / 20]]).log())
    noise = torch.randn(4000, 3, generator=random())
    children = split_along_axes(store, torch.zeros(4000, dtype=torch.long), noise)
    spread = ((children["means"] - store["means"].detach()) @ matrix_from_quaternion(quat)).std(0)
    torch.testing.assert_close(spread, store["log_scales"].detach()[0].exp(), rtol=0.05, atol=0)


def refilled(times: tuple[float, ...], targets: tuple[int, ...], store: GaussianStore) -> RefillStrategy:
    """A strategy whose children are at their parents' places plus the noise."""

    def refill(store: GaussianStore, parents: torch.Tensor, noise: torch.Tensor, _: float) -> dict[str, torch.Tensor]:
        return {"means": store["means"].detach()[parents] + noise}

    strategy = density_strategy(RefillDensity(RefillSettings(times, targets), refill=refill), store)
    assert isinstance(strategy, RefillStrategy)
    return strategy


def test_refill_deletes_the_unseen_and_reaches_its_target() -> None:
    store = make_store([0.001] * 6, opacity=0.05)
    strategy, faint = refilled((0.1, 0.5), (10, 20), store), pose(store)
    for posed in (pose(store, [0.05, 0.2, 0.05, 0.05, 0.3, 0.05]), faint):
        strategy.observe(posed, rendering([0.0] * 6))
    assert not strategy.adapt(store, faint, FIRST, random)
    assert strategy.adapt(store, faint, Progress(9, 100), random)
    assert (len(store), set(store["face_index"].tolist())) == (10, {1, 4})
    distance = (store["means"].detach() - 3 * store["face_index"][:, None] - torch.arange(3.0)).abs()
    assert distance[2:].max() <= 0.5
    assert distance[2:].min() > 0


@given(
    opacities=st.lists(st.floats(0, 1, width=32), min_size=1, max_size=40),
    target=st.integers(1, 80),
    seed=st.integers(0, 99),
)
def test_every_refill_keeps_the_store_whole(opacities: list[float], target: int, seed: int) -> None:
    """Survivors keep their order, values and moments; children fill up to the target beside them, with new moments."""
    n, seen = len(opacities), torch.tensor(opacities)
    store = make_store([0.001] * n)
    store.moments["means"] = Moments(torch.arange(1.0, n + 1)[:, None].repeat(1, 3), torch.ones(n, 3), torch.zeros(()))
    strategy, posed = refilled((0.5,), (target,), store), pose(store, opacities)
    strategy.observe(posed, rendering([0.0] * n))
    assert strategy.adapt(store, posed, Progress(49, 100), lambda: torch.Generator().manual_seed(seed))
    kept = (seen >= 0.1).nonzero()[:, 0]
    kept = kept if len(kept) > 0 else seen.argmax()[None]
    alive, parents, moments = len(kept), store["face_index"], store.moments["means"]
    assert len(store) == max(alive, target)
    assert isinstance(moments, Moments)
    assert {len(store[name]) for name in store.names()} == {len(moments.first), len(moments.second), len(store)}
    assert parents[:alive].equal(kept)
    assert torch.equal(store["means"].detach()[:alive], torch.arange(3.0 * n).reshape(n, 3)[kept])
    assert torch.equal(moments.first[:alive, 0], kept + 1.0)
    assert not moments.first[alive:].any()
    children = store["means"].detach()[alive:] - 3 * parents[alive:, None] - torch.arange(3.0)
    assert set(parents.tolist()) <= set(kept.tolist())
    assert (children.abs() <= 0.5 + 1e-5).all()
    assert torch.equal(strategy.state()["opacity"], torch.zeros(len(store)))


def faces_after(settings: GradientSettings, gradient: float, **hooks: object) -> list[int]:
    """The faces of the Gaussians after a late round: 0 small, 1 large, 2 faint, 3 huge, 4 wide on screen."""
    scales, opacities, radii = [0.001, 0.004, 0.001, 0.2, 0.001], [0.5, 0.5, 0.004, 0.5, 0.5], [3, 3, 3, 3, 50]
    return sorted(faces(scales, [gradient] * 5, opacities, settings, Progress(90, 100), radii, **hooks))


def test_each_rule_has_a_switch() -> None:
    settings = replace(EVERY_STEP, opacity_resets=(0.5,), prune_radius=20.0)
    capped = replace(settings, max_gaussians=3)
    keeps = {"may_prune": lambda store, prune: prune & (store["face_index"] != 3)}
    for rules, gradient, hooks, expected in (
        (settings, ABOVE, {}, [0, 0, 1, 1]),
        (off("clone", settings), ABOVE, {}, [0, 1, 1]),
        (off("split", settings), ABOVE, {}, [0, 0, 1]),
        (settings, BELOW, {}, [0, 1]),
        (off("prune_faint", settings), BELOW, {}, [0, 1, 2]),
        (off("prune_large", settings), BELOW, {}, [0, 1, 3]),
        (off("prune_wide", settings), BELOW, {}, [0, 1, 4]),
        (capped, ABOVE, {}, [0, 0, 1]),
        (off("cap", capped), ABOVE, {}, [0, 0, 1, 1]),
        (settings, BELOW, keeps, [0, 1, 3]),
        (off("never_empty", settings), BELOW, keeps, [0, 1]),
        # Pruning by size may begin without resets.
        (replace(EVERY_STEP, size_start=0.0, prune_radius=20.0), BELOW, {}, [0, 1]),
        (replace(EVERY_STEP, size_start=0.99, prune_radius=20.0), BELOW, {}, [0, 1, 3, 4]),
    ):
        assert faces_after(rules, gradient, **hooks) == expected, rules


def off(rule: str, settings: GradientSettings) -> GradientSettings:
    return replace(settings, rules_off=(rule,))


@pytest.mark.parametrize("on", [True, False])
def test_resets_have_a_switch_that_leaves_the_time_of_size_pruning(on: bool) -> None:
    settings = replace(EVERY_STEP, opacity_resets=(0.5,))
    store = make_store([0.001, 0.2])
    strategy = control(store, settings if on else off("reset_opacities", settings))
    for step, left in ((49, 2), (59, 1)):
        strategy.observe(pose(store), rendering([0.0, 0.0]))
        strategy.adapt(store, pose(store), Progress(step, 100), random)
        assert store["opacity_logits"].detach().sigmoid().tolist() == pytest.approx([0.01 if on else 0.5] * left)
