"""The ablations of HeadGaS (supplement, section 2): what each variant is made of, and what it gives for an expression.

The ablation without the perceptual loss is no variant: it is the method with `photometric.perceptual.weight` 0.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mien.avatar.headgas.settings import Variant
from mien.avatar.ops.feature_network import SLOPE

_START_OPACITY = 0.1  # opacity of all Gaussians at the start. Of 3D Gaussian Splatting

MOVED = 7
"""Numbers that move a Gaussian: a shift (3), and a rotation as a quaternion less the identity (4)."""


@dataclass(frozen=True)
class Parts:
    """What a variant is made of."""

    layers: int
    """Linear layers of the network. 0 means that there is none, and that the bases are colours and opacities."""
    blends: bool
    """Whether Gaussians have bases that the expression weights. If not, the network takes the expression itself."""
    recolors: bool
    """Whether colours and opacities depend on the expression. If not, each Gaussian has its own."""
    moves: bool
    """Whether positions and rotations depend on the expression."""
    unbaked: str | None = None
    """Why there is no record of `mien.runtime` for it."""


_AVERAGE = "its average of colours is not linear in the expression"
_MOVES = "its network moves Gaussians"
VARIANTS: dict[Variant, Parts] = {
    "full": Parts(2, blends=True, recolors=True, moves=False),
    "no_mlp": Parts(0, blends=True, recolors=True, moves=False, unbaked=_AVERAGE),
    "delta": Parts(2, blends=True, recolors=False, moves=True, unbaked=_MOVES),
    "change_all": Parts(2, blends=True, recolors=True, moves=True, unbaked=_MOVES),
    "no_blending": Parts(5, blends=False, recolors=True, moves=False),
}


class Changes(NamedTuple):
    """What a variant gives for one timestep."""

    colors: Float[Tensor, "n c"]
    """Spherical harmonics, all coefficients of all channels."""
    opacity_logits: Float[Tensor, " n"]
    moved: Float[Tensor, "n 7"] | None = None
    """Columns as in `MOVED`, if the variant moves Gaussians."""


def output_widths(parts: Parts, colors: int) -> tuple[int, int, int]:
    """Columns of a variant's outputs, in their order: colours, what moves Gaussians, opacity."""
    return (colors if parts.recolors else 0), (MOVED if parts.moves else 0), (1 if parts.recolors else 0)


def new_network(parts: Parts, inputs: int, hidden: int, colors: int) -> nn.Sequential:
    """A variant's network. At first it moves nothing, and paints faint Gaussians in about grey."""
    if parts.layers == 0:
        return nn.Sequential()
    first, moved, opacity = output_widths(parts, colors)
    sizes = [inputs, *[hidden] * (parts.layers - 1), first + moved + opacity]
    layers = [layer for i, o in pairwise(sizes) for layer in (nn.Linear(i, o), nn.LeakyReLU(SLOPE))]
    network = nn.Sequential(*layers[:-1])
    last = network[-1]
    assert isinstance(last, nn.Linear)
    with torch.no_grad():
        last.bias.zero_()
        last.weight[first : first + moved] = 0
        if parts.recolors:
            last.bias[-1] = start_logit()
    return network


def start_logit() -> Float[Tensor, ""]:
    """The logit of the opacity at the start."""
    return torch.logit(torch.tensor(_START_OPACITY))


def split_outputs(
    parts: Parts, others: Float[Tensor, "n p"], last: Float[Tensor, " n"]
) -> Changes | Float[Tensor, "n 7"]:
    """All outputs of a network but the last, and the last, as changes; only what moves Gaussians if it paints none."""
    if not parts.recolors:
        return torch.cat([others, last[:, None]], dim=-1)
    if not parts.moves:
        return Changes(others, last)
    return Changes(others[:, :-MOVED], last, others[:, -MOVED:])


def averaging_weights(inputs: Float[Tensor, " k"]) -> tuple[Float[Tensor, " k"], Float[Tensor, ""]]:
    """Weights of the bases and of the neutral, whose absolute values sum to 1 (`no_mlp`).

    The paper averages explicit colours, weighted by the expression, because their sum gets too large. It does not say
    what happens to negative weights or where all are 0: here they keep their sign, and the neutral has the weight 1.
    """
    total = 1 + inputs.abs().sum()
    return inputs / total, 1 / total
