"""The inverse of `mien.gaussians.sh_from_rgb`."""

import torch
from jaxtyping import Float
from torch import Tensor

from mien.gaussians import SH_C0


def rgb_from_sh(dc: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
    """Colours of constant SH coefficients, clamped to 0 from below as in the renderers."""
    return torch.clamp_min(dc * SH_C0 + 0.5, 0)
