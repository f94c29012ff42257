"""Density control by gradients (3D Gaussian Splatting, Kerbl et al. 2023, section 5).

The loop, with the names of `GradientSettings`:

1. In every step, after the backward pass, `observe` adds up the length of the gradient by each Gaussian's centre in
   normalised device coordinates, counts the views that show the Gaussian, and notes its largest radius on screen and
   its highest opacity.
2. After `rounds` steps, evenly spread from `start` to `stop`, `adapt` runs a round:
   - Prune (`_to_prune`): a Gaussian goes if its opacity is below `PRUNE_OPACITY`. From the first opacity reset after
     `start`, or from `size_start`, it also goes if it is larger than `prune_size`, or than `prune_radius` on screen.
     The method says which opacity counts (`judged_opacities`) and can forbid prunes (`may_prune`). One Gaussian always
     stays. `split_size` and `prune_size` are in `size_unit`: metres, or the extent of the training cameras.
   - Grow (`_to_grow`): of the others, those grow whose mean gradient over the views that show them reaches
     `grow_gradient`, strongest first, until there are `max_gaussians`. If such a Gaussian is larger than `split_size`,
     two children from the method's hook `split` replace it. If it is smaller, a copy is added.
   - The statistics start again.
3. After the steps at `opacity_resets`, opacities above `RESET_OPACITY` are lowered to it, if the method has such a
   tensor (`opacity_logits`).

`rules_off` switches rules off.

The optimiser's state: Gaussians that stay keep their moments, and copies and children start with zero moments. A reset
clears the moments of all opacities. The number of updates, which is one count per tensor, goes on.
"""

import math
from functools import lru_cache

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mien import _native
from mien.arrays import is_native, unpacked
from mien.avatar.avatar import Posed
from mien.avatar.density import GradientDensity
from mien.avatar.settings import Progress
from mien.avatar.store import GaussianStore
from mien.gaussians import Rendering
from mien.kernels import on_gpu
from mien.machine.devices import upload
from mien.training.density_control.strategy import (
    DensityStrategy,
    Random,
    Redundant,
    count_each,
    places_in,
    with_most_visible,
)

PRUNE_OPACITY = 0.005  # opacity below which Gaussians are removed. Of 3D Gaussian Splatting
RESET_OPACITY = 0.01  # highest opacity that remains after a reset. Of 3D Gaussian Splatting


class GradientStrategy(DensityStrategy):
    """Duplicates small and splits large Gaussians with strong gradients, prunes faint ones, and resets opacities."""

    def __init__(self, density: GradientDensity, gaussians: int, device: torch.device):
        self._density = density
        self._device = device
        self._restart(gaussians)

    def observe(self, posed: Posed, rendering: Rendering) -> None:
        """Add up the gradients of the centres in normalised device coordinates, for visible Gaussians."""
        gradient = rendering.means2d_offset.grad
        assert gradient is not None, "observe() needs the gradients of a backward pass"
        height, width = rendering.image.shape[-3:-1]
        # Scale pixels to normalised device coordinates, which span -1..1: the unit of the thresholds.
        scale, opacities = (width / 2, height / 2), posed.gaussians.opacities.data.view(-1)
        statistics = (self._gradient_sums, self._views, self._largest_radii, self._highest_opacities)
        if is_native(gradient):
            arrays = unpacked(gradient, rendering.radii, opacities, *statistics)
            _native.observe_view(scale, *arrays)
        elif on_gpu(gradient):
            from mien.training.training_gpu import observe_view

            observe_view(gradient, rendering.radii, opacities, scale, *statistics)
        else:
            observe_reference(gradient, rendering.radii, opacities, scale, *statistics)

    def adapt(self, store: GaussianStore, posed: Posed, progress: Progress, random: Random) -> bool:
        """Add and prune Gaussians in rounds, and reset opacities at their times."""
        settings = self._density.settings
        changed = progress.completes(round_steps(settings.start, settings.stop, settings.rounds, progress.steps))
        if changed:
            self._grow_and_prune(store, posed, progress, random())
            self._restart(len(store))
        name = self._density.opacity_logits
        if name is not None and progress.completes(max(1, round(time * progress.steps)) for time in self._resets):
            ceiling = torch.logit(torch.tensor(RESET_OPACITY))
            logits = store[name].detach()
            lowered = logits.clamp_max(float(ceiling))
            if self._density.may_reset is not None:
                lowered = torch.where(self._density.may_reset(store), lowered, logits)
            store.assign(name, lowered)
        return changed

    def thin(self, store: GaussianStore, redundant: Redundant) -> None:
        """Remove redundant Gaussians. The statistics start again."""
        store.select(~redundant())
        self._restart(len(store))

    @property
    def _resets(self) -> tuple[float, ...]:
        settings = self._density.settings
        return () if "reset_opacities" in settings.rules_off else settings.opacity_resets

    def state(self) -> dict[str, Tensor]:
        """The statistics since the last round, under the names that checkpoints have always used."""
        return {
            "pull": self._gradient_sums,
            "seen": self._views,
            "radius": self._largest_radii,
            "opacity": self._highest_opacities,
        }

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Restore what `state` returned."""
        self._gradient_sums, self._views, self._largest_radii, self._highest_opacities = (
            state[name].to(self._device, copy=True) for name in ("pull", "seen", "radius", "opacity")
        )

    def _restart(self, gaussians: int) -> None:
        self._gradient_sums = torch.zeros(gaussians, device=self._device)
        self._views = torch.zeros(gaussians, device=self._device)
        self._largest_radii = torch.zeros(gaussians, dtype=torch.int32, device=self._device)
        self._highest_opacities = torch.zeros(gaussians, device=self._device)

    def _grow_and_prune(self, store: GaussianStore, posed: Posed, progress: Progress, random: torch.Generator) -> None:
        settings, off = self._density.settings, self._density.settings.rules_off
        sizes = posed.gaussians.scales.detach().reshape(len(store), 3).amax(-1)
        if settings.size_unit == "extent":
            sizes = sizes / progress.extent
        prune = self._to_prune(store, sizes, progress)
        if self._density.may_prune is not None and "never_empty" not in off:
            prune = self._density.may_prune(store, prune)
        # Without any Gaussian there are no gradients to grow by.
        staying = with_most_visible(~prune, self._highest_opacities)
        large = sizes > settings.split_size
        may_grow = staying & torch.where(large, "split" not in off, "clone" not in off)
        grow = self._to_grow(may_grow, None if "cap" in off else settings.max_gaussians - staying.sum())
        split, n = grow & large, len(store)
        staying &= ~split
        copied, divided, old = count_each(grow & ~split, split, staying)
        store.append(places_in(grow & ~split, copied))
        # Both children of a split replace their parent.
        parents = places_in(split, divided).repeat(2)
        noise = upload(torch.randn(len(parents), 3, generator=random), sizes)
        store.append(parents, self._density.split(store, parents, noise))
        store.select(torch.cat([places_in(staying, old), torch.arange(n, len(store), device=prune.device)]))

    def _to_prune(self, store: GaussianStore, sizes: Float[Tensor, " n"], progress: Progress) -> Bool[Tensor, " n"]:
        settings, off = self._density.settings, self._density.settings.rules_off
        prune = torch.zeros_like(sizes, dtype=torch.bool)
        if "prune_faint" not in off:
            judged = self._density.judged_opacities
            seen = self._highest_opacities
            prune = (seen if judged is None else judged(store, seen)) < PRUNE_OPACITY
        begin = settings.size_start
        if begin is None:
            begin = min((time for time in settings.opacity_resets if time > settings.start), default=math.inf)
        if progress.fraction > begin:
            if "prune_large" not in off:
                prune = prune | (sizes > settings.prune_size)
            if "prune_wide" not in off and settings.prune_radius > 0:
                prune = prune | (self._largest_radii > settings.prune_radius)
        return prune

    def _to_grow(self, candidates: Bool[Tensor, " n"], budget: Int[Tensor, ""] | None) -> Bool[Tensor, " n"]:
        """Gaussians above the threshold, or those with the largest gradients if the budget allows fewer."""
        gradients = torch.where(candidates, self._gradient_sums / self._views.clamp_min(1), -1.0)
        grow = gradients >= self._density.settings.grow_gradient
        if budget is None:
            return grow
        order, places = gradients.argsort(descending=True, stable=True), torch.arange(len(grow), device=grow.device)
        strongest = torch.zeros_like(grow).scatter_(0, order, places < budget)
        return torch.where(grow.sum() > budget, strongest, grow)


def observe_reference(
    gradient: Float[Tensor, "n 2"],
    radii: Int[Tensor, " n"],
    opacities: Float[Tensor, " n"],
    scale: tuple[float, float],
    *statistics: Tensor,
) -> None:
    """`_native.observe_view` in plain PyTorch: add a step to sums, views, largest radii and highest opacities."""
    gradient_sums, views, largest_radii, highest_opacities = statistics
    # Culled Gaussians have no gradient, so the sum needs no mask.
    gradient_sums += torch.hypot(gradient[:, 0] * scale[0], gradient[:, 1] * scale[1])
    views += radii > 0
    torch.maximum(largest_radii, radii, out=largest_radii)
    torch.maximum(highest_opacities, opacities, out=highest_opacities)


@lru_cache
def round_steps(start: float, stop: float, rounds: int, steps: int) -> frozenset[int]:
    """The numbers of steps after which the rounds happen, evenly from `start` to `stop` (fractions of the run)."""
    gaps = max(rounds - 1, 1)
    return frozenset(max(1, round((start + (stop - start) * index / gaps) * steps)) for index in range(rounds))
