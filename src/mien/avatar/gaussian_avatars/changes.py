"""The changes of Gaussians with the expression beside those of the mesh, and what holds them back."""

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from mien.avatar.gaussian_avatars.settings import GaussianAvatarsConfig

_FEATURES = ("feature_color", "feature_opacity")
"""Names of the changes by features."""
BASES = ("color_basis", "opacity_basis", "offset_basis")
"""Names of the bases of linear changes, which are also those of the changes."""


def change_penalties(config: GaussianAvatarsConfig, changes: Mapping[str, Tensor]) -> dict[str, Float[Tensor, ""]]:
    """The weighted mean squared changes over all Gaussians: linear ones as `expression`, features' as `appearance`.

    Args:
        config: The settings, which have the weights.
        changes: The changes of one or more timesteps by name; others are ignored.
    """
    kinds = (("expression", BASES, config.expression_weight), ("appearance", _FEATURES, config.appearance_weight))
    losses = {}
    for loss, names, weight in kinds:
        squares = [changes[name].square().mean() for name in names if name in changes]
        if squares:
            losses[loss] = weight * torch.stack(squares).sum()
    return losses
