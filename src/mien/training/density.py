"""Density control: when and where Gaussians are added and removed.

Strategies see a `GaussianStore`, the posed Gaussians, the rendering, and the method's hooks, but never the method. They
keep statistics with one entry per Gaussian, which checkpoints save.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import lru_cache

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mien import _native
from mien.arrays import unpacked
from mien.avatar import DensityControl, FixedDensity, GaussianStore, GradientDensity, Posed, Progress, RefillDensity
from mien.render.rendering import Rendering

Random = Callable[[], torch.Generator]
"""Creates the generator for a step's random numbers. Few steps need one."""


class DensityStrategy(ABC):
    """Observes every step, and changes the store in some of them."""

    @abstractmethod
    def observe(self, posed: Posed, rendering: Rendering) -> None:
        """Update the statistics after a step's backward pass. `posed` holds one timestep."""

    @abstractmethod
    def control(self, store: GaussianStore, posed: Posed, progress: Progress, random: Random) -> bool:
        """Change the store if it is time for that. Called after the optimiser's step; returns whether it changed."""

    @abstractmethod
    def state(self) -> dict[str, Tensor]:
        """Tensors that a checkpoint has to save."""

    @abstractmethod
    def load_state(self, state: dict[str, Tensor]) -> None:
        """Restore what `state` returned."""


def density_strategy(control: DensityControl, store: GaussianStore) -> DensityStrategy:
    """The strategy for a method's description."""
    if isinstance(control, GradientDensity):
        return GradientStrategy(control, len(store), store[store.names()[0]].device)
    if isinstance(control, RefillDensity):
        return RefillStrategy(control, len(store), store[store.names()[0]].device)
    assert isinstance(control, FixedDensity)
    return FixedStrategy()


class GradientStrategy(DensityStrategy):
    """Duplicates small and splits large Gaussians with strong gradients, prunes faint ones, and resets opacities."""

    def __init__(self, control: GradientDensity, gaussians: int, device: torch.device):
        self._control = control
        self._device = device
        self._restart(gaussians)

    def observe(self, posed: Posed, rendering: Rendering) -> None:
        """Add up the gradients of the centres in normalised device coordinates, for visible Gaussians."""
        gradient = rendering.means2d_offset.grad
        assert gradient is not None, "observe() needs the gradients of a backward pass"
        height, width = rendering.image.shape[-3:-1]
        # Scale pixels to normalised device coordinates, which span -1..1: the unit of the thresholds.
        scale, opacities = (width / 2, height / 2), posed.gaussians.opacities.detach().reshape(-1)
        statistics = (self._pull, self._seen, self._radius, self._opacity)
        if gradient.device.type == "cpu" and gradient.dtype == torch.float32:
            arrays = unpacked(gradient, rendering.radii, opacities, *statistics)
            _native.observe_view(scale, *arrays)
        else:
            observe_reference(gradient, rendering.radii, opacities, scale, *statistics)

    def control(self, store: GaussianStore, posed: Posed, progress: Progress, random: Random) -> bool:
        """Add and prune Gaussians in rounds, and reset opacities at their times."""
        settings = self._control.settings
        done = progress.step + 1
        changed = done in _round_steps(settings.start, settings.stop, settings.rounds, progress.steps)
        if changed:
            self._grow_and_prune(store, posed, progress, random())
            self._restart(len(store))
        name = self._control.opacity_logits
        if name is not None and done in {max(1, round(time * progress.steps)) for time in settings.opacity_resets}:
            ceiling = torch.logit(torch.tensor(settings.reset_opacity))
            store.assign(name, store[name].detach().clamp_max(float(ceiling)))
        return changed

    def state(self) -> dict[str, Tensor]:
        """The statistics since the last round."""
        return {"pull": self._pull, "seen": self._seen, "radius": self._radius, "opacity": self._opacity}

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Restore what `state` returned."""
        self._pull, self._seen, self._radius, self._opacity = (
            state[name].to(self._device, copy=True) for name in ("pull", "seen", "radius", "opacity")
        )

    def _restart(self, gaussians: int) -> None:
        self._pull = torch.zeros(gaussians, device=self._device)
        self._seen = torch.zeros(gaussians, device=self._device)
        self._radius = torch.zeros(gaussians, dtype=torch.int32, device=self._device)
        self._opacity = torch.zeros(gaussians, device=self._device)

    def _grow_and_prune(self, store: GaussianStore, posed: Posed, progress: Progress, random: torch.Generator) -> None:
        settings = self._control.settings
        sizes = posed.gaussians.scales.detach().reshape(len(store), 3).amax(-1)
        prune = self._control.may_prune(store, self._to_prune(store, sizes, progress))
        if bool(prune.all()):
            # Without any Gaussian there are no gradients to grow by, so keep the one that was most visible.
            prune[self._opacity.argmax()] = False
        grow = self._to_grow(~prune, budget=settings.max_gaussians - int((~prune).sum()))
        split = grow & (sizes > settings.split_size)
        parents = (grow & ~split).nonzero()[:, 0]
        store.append(parents)
        # Both children of a split replace their parent.
        parents = split.nonzero()[:, 0].repeat(2)
        noise = torch.randn(len(parents), 3, generator=random).to(sizes)
        store.append(parents, self._control.split(store, parents, noise))
        kept = torch.ones(len(store), dtype=torch.bool, device=prune.device)
        kept[: len(prune)] = ~(prune | split)
        store.select(kept)

    def _to_prune(self, store: GaussianStore, sizes: Float[Tensor, " n"], progress: Progress) -> Bool[Tensor, " n"]:
        settings = self._control.settings
        prune = self._control.judged_opacities(store, self._opacity) < settings.prune_opacity
        later_resets = [time for time in settings.opacity_resets if time > settings.start]
        if later_resets and progress.fraction > min(later_resets):
            prune = prune | (sizes > settings.prune_size)
            if settings.prune_radius > 0:
                prune = prune | (self._radius > settings.prune_radius)
        return prune

    def _to_grow(self, candidates: Bool[Tensor, " n"], budget: int) -> Bool[Tensor, " n"]:
        """Gaussians above the threshold, or those with the largest gradients if the budget allows fewer."""
        pull = torch.where(candidates, self._pull / self._seen.clamp_min(1), -1.0)
        grow = pull >= self._control.settings.grow_gradient
        if int(grow.sum()) > budget:
            strongest = pull.argsort(descending=True, stable=True)[: max(budget, 0)]
            grow = torch.zeros_like(grow).index_fill(0, strongest, True)
        return grow


def observe_reference(
    gradient: Float[Tensor, "n 2"],
    radii: Int[Tensor, " n"],
    opacities: Float[Tensor, " n"],
    scale: tuple[float, float],
    *statistics: Tensor,
) -> None:
    """`_native.observe_view` in plain PyTorch: add a step to pull, seen, radius and opacity."""
    pull, seen, radius, opacity = statistics
    # Culled Gaussians have no gradient, so the sum needs no mask.
    pull += torch.hypot(gradient[:, 0] * scale[0], gradient[:, 1] * scale[1])
    seen += radii > 0
    torch.maximum(radius, radii, out=radius)
    torch.maximum(opacity, opacities, out=opacity)


class RefillStrategy(DensityStrategy):
    """Deletes Gaussians that no view has shown, then refills up to the target with children of random survivors."""

    def __init__(self, control: RefillDensity, gaussians: int, device: torch.device):
        self._control = control
        self._opacity = torch.zeros(gaussians, device=device)

    def observe(self, posed: Posed, rendering: Rendering) -> None:
        """Update each Gaussian's highest opacity."""
        torch.maximum(self._opacity, posed.gaussians.opacities.detach().reshape(-1), out=self._opacity)

    def control(self, store: GaussianStore, posed: Posed, progress: Progress, random: Random) -> bool:
        """Prune and refill at the times of the rounds."""
        settings = self._control.settings
        due = [
            target
            for time, target in zip(settings.times, settings.targets, strict=True)
            if max(1, round(time * progress.steps)) == progress.step + 1
        ]
        if not due:
            return False
        unseen = self._control.judged_opacities(store, self._opacity) < settings.prune_opacity
        kept = ~self._control.may_prune(store, unseen)
        if not bool(kept.any()):
            # Without any Gaussian there is no parent for a refill, so keep the one that was most visible.
            kept[self._opacity.argmax()] = True
        store.select(kept)
        missing = due[-1] - len(store)
        if missing > 0:
            generator = random()
            parents = torch.randint(len(store), (missing,), generator=generator)
            noise = torch.rand(missing, 3, generator=generator).to(self._opacity) - 0.5
            parents = parents.to(noise.device)
            store.append(parents, self._control.refill(store, parents, noise, progress.fraction))
        self._opacity = torch.zeros(len(store), device=self._opacity.device)
        return True

    def state(self) -> dict[str, Tensor]:
        """The statistics since the last round."""
        return {"opacity": self._opacity}

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Restore what `state` returned."""
        self._opacity = state["opacity"].to(self._opacity, copy=True)


class FixedStrategy(DensityStrategy):
    """Never changes the store."""

    def observe(self, posed: Posed, rendering: Rendering) -> None:
        """Do nothing."""

    def control(self, store: GaussianStore, posed: Posed, progress: Progress, random: Random) -> bool:
        """Return False, because the store never changes."""
        return False

    def state(self) -> dict[str, Tensor]:
        """An empty dict."""
        return {}

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Do nothing."""


@lru_cache
def _round_steps(start: float, stop: float, rounds: int, steps: int) -> frozenset[int]:
    """The numbers of steps after which the rounds happen, evenly from `start` to `stop` (fractions of the run)."""
    gaps = max(rounds - 1, 1)
    return frozenset(max(1, round((start + (stop - start) * index / gaps) * steps)) for index in range(rounds))
