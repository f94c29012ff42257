"""What a method tells density control: the strategy, its settings, and the hooks that only the method can answer.

The strategies themselves are in `mien.training.density`; they see a `GaussianStore` and one of these descriptions.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mien.avatar.settings import GradientSettings, RefillSettings
from mien.avatar.store import GaussianStore
from mien.rotation import matrix_from_quaternion


def keep_all_prunes(store: GaussianStore, prune: Bool[Tensor, " n"]) -> Bool[Tensor, " n"]:
    """The hook of methods that let every Gaussian be pruned."""
    return prune


def highest_opacities_seen(store: GaussianStore, seen: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """The hook of methods whose opacity depends on the face: a Gaussian counts by its highest since the last round."""
    return seen


def split_along_axes(
    store: GaussianStore, parents: Int[Tensor, " p"], noise: Float[Tensor, "p 3"]
) -> dict[str, Tensor]:
    """Where children of a split go, for stores with `means, quats, log_scales` in one frame: samples of the parent.

    The child's centre is drawn from the parent's own distribution in the parent's frame; scales shrink by 1.6.
    """
    log_scales = store["log_scales"].detach()[parents]
    rotations = matrix_from_quaternion(store["quats"].detach()[parents])
    offsets = (rotations @ (log_scales.exp() * noise)[..., None])[..., 0]
    return {
        "means": store["means"].detach()[parents] + offsets,
        "log_scales": log_scales - torch.log(noise.new_tensor(1.6)),
    }


@dataclass(frozen=True)
class GradientDensity:
    """Duplicate, split, prune and reset opacity, driven by the centres' gradients on screen."""

    settings: GradientSettings
    opacity_logits: str | None
    """Name of the store's raw opacity, which resets lower; None where opacity comes from a network (no resets)."""
    judged_opacities: Callable[[GaussianStore, Float[Tensor, " n"]], Float[Tensor, " n"]] = highest_opacities_seen
    """(store, highest opacity of each since the last round) -> the opacity to prune by."""
    split: Callable[[GaussianStore, Int[Tensor, " p"], Float[Tensor, "p 3"]], dict[str, Tensor]] = split_along_axes
    """(store, parents, standard normal noise) -> what differs between parents and children, by tensor name."""
    may_prune: Callable[[GaussianStore, Bool[Tensor, " n"]], Bool[Tensor, " n"]] = keep_all_prunes
    """(store, prunes asked for) -> prunes granted."""


@dataclass(frozen=True)
class RefillDensity:
    """In each round, delete what was never visible and refill up to a target with children of random survivors."""

    settings: RefillSettings
    refill: Callable[[GaussianStore, Int[Tensor, " p"], Float[Tensor, "p 3"], float], Mapping[str, Tensor]]
    """(store, parents, noise uniform in -0.5..0.5, fraction of the run) -> what differs from the parents."""
    judged_opacities: Callable[[GaussianStore, Float[Tensor, " n"]], Float[Tensor, " n"]] = highest_opacities_seen
    """(store, highest opacity of each since the last round) -> the opacity to prune by."""
    may_prune: Callable[[GaussianStore, Bool[Tensor, " n"]], Bool[Tensor, " n"]] = keep_all_prunes
    """(store, prunes asked for) -> prunes granted."""


@dataclass(frozen=True)
class FixedDensity:
    """The number of Gaussians never changes."""


DensityControl = GradientDensity | RefillDensity | FixedDensity
