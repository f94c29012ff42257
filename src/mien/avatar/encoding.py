"""The positional encoding, which the networks of several methods share."""

import torch
from jaxtyping import Float
from torch import Tensor


def positional_encoding(points: Float[Tensor, "*b 3"], bands: int) -> Float[Tensor, "*b c"]:
    """Points, then sines and cosines of 1, 2, 4, ... times the points (NeRF, Mildenhall et al. 2020): 3 + 6 `bands`."""
    angles = points[..., None, :] * 2.0 ** torch.arange(bands, dtype=points.dtype, device=points.device)[:, None]
    waves = torch.stack([angles.sin(), angles.cos()], dim=-2)
    return torch.cat([points, waves.flatten(-3)], dim=-1)
