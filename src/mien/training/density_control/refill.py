"""Density control by prune and refill (MonoGaussianAvatar, SIGGRAPH 2024; PointAvatar, CVPR 2023).

The loop, with the names of `RefillSettings`:

1. In every step, after the backward pass, `observe` notes the highest opacity that each Gaussian has had. The method
   can say otherwise how visible a Gaussian is (`observed`).
2. After the steps at `times`, `adapt` runs a round:
   - Prune: a Gaussian goes if its opacity stayed below `prune_opacity` in all views since the last round. One Gaussian
     always stays.
   - Refill: if fewer Gaussians are left than the round's target, children of random survivors are added up to it. The
     method's hook `refill` says in what they differ from their parents.
   - The statistics start again.

The optimiser's state: survivors keep their moments, and children start with zero moments. The number of updates, which
is one count per tensor, goes on.
"""

import torch
from torch import Tensor

from mien.avatar.avatar import Posed
from mien.avatar.density import RefillDensity
from mien.avatar.settings import Progress
from mien.avatar.store import GaussianStore
from mien.gaussians import Rendering
from mien.machine.devices import upload
from mien.training.density_control.strategy import (
    DensityStrategy,
    Random,
    Redundant,
    count_each,
    places_in,
    with_most_visible,
)


class RefillStrategy(DensityStrategy):
    """Deletes Gaussians that no view has shown, then refills up to the target with children of random survivors."""

    def __init__(self, density: RefillDensity, gaussians: int, device: torch.device):
        self._density = density
        self._highest_opacities = torch.zeros(gaussians, device=device)

    def observe(self, posed: Posed, rendering: Rendering) -> None:
        """Update each Gaussian's highest opacity."""
        observed = self._density.observed
        visible = posed.gaussians.opacities.detach().reshape(-1)
        visible = visible if observed is None else observed(posed.gaussians, rendering)
        torch.maximum(self._highest_opacities, visible, out=self._highest_opacities)

    def adapt(self, store: GaussianStore, posed: Posed, progress: Progress, random: Random) -> bool:
        """Prune and refill at the times of the rounds."""
        settings = self._density.settings
        due = [
            target
            for time, target in zip(settings.times, settings.targets, strict=True)
            if progress.completes([max(1, round(time * progress.steps))])
        ]
        if not due:
            return False
        # Without any Gaussian there is no parent for a refill.
        kept = with_most_visible(~(self._highest_opacities < settings.prune_opacity), self._highest_opacities)
        store.select(places_in(kept, *count_each(kept)))
        missing = due[-1] - len(store)
        if missing > 0:
            generator = random()
            parents = torch.randint(len(store), (missing,), generator=generator)
            noise = upload(torch.rand(missing, 3, generator=generator), self._highest_opacities) - 0.5
            parents = upload(parents, noise)
            store.append(parents, self._density.refill(store, parents, noise, progress.fraction))
        self._highest_opacities = torch.zeros(len(store), device=self._highest_opacities.device)
        return True

    def thin(self, store: GaussianStore, redundant: Redundant) -> None:
        """Do nothing, because the rounds remove what no view has shown."""

    def state(self) -> dict[str, Tensor]:
        """The statistics since the last round."""
        return {"opacity": self._highest_opacities}

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Restore what `state` returned."""
        self._highest_opacities = state["opacity"].to(self._highest_opacities, copy=True)
