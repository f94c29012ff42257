"""What a method tells density control: the strategy, its settings, and the hooks that only the method can answer.

The strategies themselves are in `mien.training.density`; they see a `GaussianStore` and one of these descriptions.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mien.avatar.store import GaussianStore
from mien.rotation import matrix_from_quaternion


@dataclass(frozen=True)
class GradientSettings:
    """Gradient-based density control (3D Gaussian Splatting, section 5).

    Times are fractions of the run, so that a schedule fits runs of any length.
    """

    start: float = 0.1
    """When the first round happens."""
    stop: float = 0.7
    """When the last round happens."""
    rounds: int = 16
    """Rounds from `start` to `stop`, evenly spread."""
    grow_gradient: float = 2e-4
    """Gaussians whose mean gradient with respect to the centre, in normalised device coordinates, reaches this grow."""
    split_size: float = 0.0025
    """Metres: of those that grow, larger ones split in two, smaller ones duplicate."""
    prune_opacity: float = 0.005
    """Gaussians below this opacity go."""
    prune_size: float = 0.1
    """Metres: larger Gaussians go, after the first opacity reset that follows `start`."""
    prune_radius: float = 0.0
    """Pixels: Gaussians that look larger go, from the same time on; 0 for never."""
    opacity_resets: tuple[float, ...] = (0.1, 0.4)
    """When opacities are lowered to `reset_opacity`."""
    reset_opacity: float = 0.01
    """The ceiling at a reset."""
    max_gaussians: int = 40_000
    """Growth stops here; what pulls most grows first."""


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
class RefillSettings:
    """Prune and refill (MonoGaussianAvatar, PointAvatar). Times are fractions of the run."""

    times: tuple[float, ...]
    """When the rounds happen, ascending."""
    targets: tuple[int, ...]
    """The number of Gaussians after each round."""
    prune_opacity: float = 0.1
    """Gaussians whose opacity was never this high in any view since the last round go."""


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
