"""Descriptions of a method's density control: the strategy, its settings, and hooks that only the method can provide.

The strategies themselves are in `mien.training.density_control`, one file each. They see a `GaussianStore` and one of
these descriptions, never the method.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mien.avatar.settings import GradientSettings, RefillSettings
from mien.avatar.store import GaussianStore
from mien.gaussians import Gaussians, Rendering
from mien.rotation import matrix_from_quaternion


def split_along_axes(
    store: GaussianStore, parents: Int[Tensor, " p"], noise: Float[Tensor, "p 3"]
) -> dict[str, Tensor]:
    """Centres and scales of the children of a split, for stores with `means, quats, log_scales` in one frame.

    Each centre is drawn from the parent's own distribution in the parent's frame. Scales shrink by a factor of 1.6.
    """
    log_scales = store["log_scales"].detach()[parents]
    rotations = matrix_from_quaternion(store["quats"].detach()[parents])
    offsets = (rotations @ (log_scales.exp() * noise)[..., None])[..., 0]
    return {
        "means": store["means"].detach()[parents] + offsets,
        # The logarithm in the dtype of the scales, on the CPU.
        "log_scales": log_scales - float(torch.log(torch.tensor(1.6, dtype=log_scales.dtype))),
    }


@dataclass(frozen=True)
class GradientDensity:
    """Grows Gaussians by the screen-space gradients of their centres, prunes them, and resets opacities."""

    settings: GradientSettings
    opacity_logits: str | None
    """Name of the store's raw opacity, which resets lower. None if opacity comes from a network: no resets then."""
    judged_opacities: Callable[[GaussianStore, Float[Tensor, " n"]], Float[Tensor, " n"]] | None = None
    """(store, highest opacity of each Gaussian since the last round) -> the opacity to prune by. None: the latter."""
    split: Callable[[GaussianStore, Int[Tensor, " p"], Float[Tensor, "p 3"]], dict[str, Tensor]] = split_along_axes
    """(store, parents, standard normal noise) -> tensors, by name, in which children differ from their parents."""
    may_prune: Callable[[GaussianStore, Bool[Tensor, " n"]], Bool[Tensor, " n"]] | None = None
    """(store, prunes requested) -> prunes allowed. None: all."""
    may_reset: Callable[[GaussianStore], Bool[Tensor, " n"]] | None = None
    """(store) -> Gaussians whose opacity resets lower. None if they all are."""


@dataclass(frozen=True)
class RefillDensity:
    """Each round deletes Gaussians that were never visible, then adds children of random survivors up to a target."""

    settings: RefillSettings
    refill: Callable[[GaussianStore, Int[Tensor, " p"], Float[Tensor, "p 3"], float], Mapping[str, Tensor]]
    """(store, parents, noise uniform in -0.5..0.5, fraction of the run) -> tensors, by name, in which children differ
    from their parents."""
    observed: Callable[[Gaussians, Rendering], Float[Tensor, " n"]] | None = None
    """(Gaussians of a step, their picture after the backward pass) -> how visible each Gaussian is, 0..1, in the place
    of its opacity."""


DensityControl = GradientDensity | RefillDensity | None
"""None: the number of Gaussians never changes."""
