"""The ablations of HeadGaS (supplement, section 2): what differs in each from the method itself.

The ablation without the perceptual loss is no variant: it is the method with `photometric.perceptual.weight` 0.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mien.avatar.avatar import Posed
from mien.avatar.headgas.settings import HeadGasConfig, Variant
from mien.avatar.ops.activation import sigmoid
from mien.avatar.ops.feature_network import SLOPE, Layers, blended_features
from mien.avatar.settings import Progress
from mien.gaussians import Gaussians
from mien.rotation import multiply_quaternions

START_OPACITY = 0.1  # opacity of all Gaussians at the start. Of 3D Gaussian Splatting
SHIFT_LENGTH = 0.01  # unit of the network's shifts, in metres. The papers do not say one
MOVED = 7
"""Numbers that move a Gaussian: a shift (3), and a rotation as a quaternion less the identity (4)."""
LEAST_SUM = 0.1
"""Sum of expression weights below which the average of `no_mlp` counts all bases. The supplement does not say one."""
_LEAST_OPACITY = 1e-4  # of an average, whose weights may be negative


class Changes(NamedTuple):
    """Changes of the Gaussians with the expression, at one timestep."""

    colors: Float[Tensor, "n c"]
    """Spherical harmonics, all coefficients of all channels."""
    opacity_logits: Float[Tensor, " n"]
    moved: Float[Tensor, "n 7"] | None = None
    """Columns as in `MOVED`. Only ablations move Gaussians."""


@dataclass(frozen=True)
class Ablation:
    """Functions of a variant that take the place of the method's."""

    tensors: Callable[[Float[Tensor, "n 3"], int, HeadGasConfig], dict[str, Tensor]]
    """(centres, number of directions, settings) -> trained tensors beside the shapes of Gaussians."""
    network: Callable[[int, HeadGasConfig], nn.Sequential]
    """(number of directions, settings) -> the network."""
    changes: Callable[[Any, Float[Tensor, "b k"], Progress], Iterator[Changes]]
    """(avatar, inputs along the directions, progress) -> what depends on the expression at each timestep."""
    unbaked: str | None = None
    """Why there is no record of `mien.runtime` for it."""


def colors_of(config: HeadGasConfig) -> int:
    """Number of coefficients of all channels."""
    return 3 * (config.sh_degree + 1) ** 2


def encoded(config: HeadGasConfig) -> int:
    """Number of columns of the positional encoding."""
    return 3 + 6 * config.encoding_bands


def feature_tensors(means: Float[Tensor, "n 3"], directions: int, width: int) -> dict[str, Tensor]:
    """Bases and neutral features, which start at zero, as in the paper."""
    n = len(means)
    return {"bases": means.new_zeros(n, directions, width), "neutral_features": means.new_zeros(n, width)}


def new_network(sizes: list[int], moved: slice | None = None, *, opacity: bool = True) -> nn.Sequential:
    """Layers with leaky ReLU between them. At first they move nothing, and paint faint Gaussians in about grey."""
    layers = [layer for i, o in pairwise(sizes) for layer in (nn.Linear(i, o), nn.LeakyReLU(SLOPE))]
    network = nn.Sequential(*layers[:-1])
    last = network[-1]
    assert isinstance(last, nn.Linear)
    with torch.no_grad():
        last.bias.zero_()
        if moved is not None:
            last.weight[moved] = 0
        if opacity:
            last.bias[-1] = start_logit()
    return network


def start_logit() -> Float[Tensor, ""]:
    """The logit of the opacity at the start."""
    return torch.logit(torch.tensor(START_OPACITY))


def averaging_weights(inputs: Float[Tensor, " k"]) -> Float[Tensor, " k"]:
    """Weights of the bases, which sum to 1: the inputs divided by their sum (`no_mlp`; supplement, section 2).

    The supplement does not say what happens at a sum of 0. Here, a sum that is nearer to 0 than `LEAST_SUM` counts as
    that, with its sign, and all bases share alike what is left of 1: where all inputs are 0, each has the same weight.
    """
    total = inputs.sum()
    divisor = torch.where(total < 0, -1.0, 1.0) * total.abs().clamp_min(LEAST_SUM)
    return (inputs + (divisor - total) / len(inputs)) / divisor


def moved_by(gaussians: Gaussians, moved: Float[Tensor, "b n 7"]) -> Posed:
    """Gaussians moved and turned (supplement, eq. 1 to 3), with the shifts for their penalty."""
    shifts, turns = moved.split([3, 4], dim=-1)
    shifts = SHIFT_LENGTH * shifts
    turned = multiply_quaternions(turns.new_tensor([1.0, 0.0, 0.0, 0.0]) + turns, gaussians.quats.expand_as(turns))
    return Posed(replace(gaussians, means=gaussians.means + shifts, quats=turned), {"shifts": shifts})


def _explicit(means: Tensor, directions: int, config: HeadGasConfig) -> dict[str, Tensor]:
    n, logits = len(means), start_logit().to(means).repeat(len(means), directions)
    return {"bases": means.new_zeros(n, directions, colors_of(config)), "opacity_logits": logits}


def _average(avatar: Any, inputs: Tensor, progress: Progress) -> Iterator[Changes]:
    store, shares = avatar.store, avatar.output_shares(progress)[:-1].to(inputs)
    none, opacities = inputs.new_zeros(len(store), len(shares)), sigmoid(store["opacity_logits"])
    for e in inputs:
        weights = averaging_weights(e)
        colors = shares * blended_features(store["bases"], weights, None, none, avatar.bases_gradient)
        yield Changes(colors, torch.logit(opacities @ weights, _LEAST_OPACITY))


def _unpainted(means: Tensor, directions: int, config: HeadGasConfig) -> dict[str, Tensor]:
    return {
        **feature_tensors(means, directions, config.features),
        "sh": means.new_zeros(len(means), colors_of(config) // 3, 3),
        "opacity_logits": start_logit().to(means).repeat(len(means)),
    }


def _moving(directions: int, config: HeadGasConfig) -> nn.Sequential:
    return new_network([config.features + encoded(config), config.hidden, MOVED], slice(None), opacity=False)


def _moves(avatar: Any, inputs: Tensor, progress: Progress) -> Iterator[Changes]:
    first, _, last = avatar.network
    layers, encoding = Layers(first.weight, first.bias, last.weight, last.bias), avatar.encoding()
    shares = avatar.output_shares(progress)[:-1].to(encoding).view(-1, 3)
    for e in inputs:
        others, last_column = avatar.outputs(e, encoding, layers)
        moved = torch.cat([others, last_column[:, None]], dim=-1)
        yield Changes((shares * avatar.store["sh"]).flatten(1), avatar.store["opacity_logits"], moved)


def _painting(directions: int, config: HeadGasConfig) -> nn.Sequential:
    colors = colors_of(config)
    sizes = [config.features + encoded(config), config.hidden, colors + MOVED + 1]
    return new_network(sizes, slice(colors, colors + MOVED))


def _paints_and_moves(avatar: Any, inputs: Tensor, progress: Progress) -> Iterator[Changes]:
    first, _, last = avatar.network
    own, encoding = avatar.output_shares(progress).to(last.weight), avatar.encoding()
    shares = torch.cat([own[:-1], own.new_ones(MOVED), own[-1:]])
    layers = Layers(first.weight, first.bias, last.weight * shares[:, None], last.bias * shares)
    for e in inputs:
        others, opacity_logits = avatar.outputs(e, encoding, layers)
        yield Changes(others[:, :-MOVED], opacity_logits, others[:, -MOVED:])


def _deep(directions: int, config: HeadGasConfig) -> nn.Sequential:
    """Five layers, each followed by a leaky ReLU: opacities start at 1/2, because those below it change slowly."""
    sizes = [directions + encoded(config), *[config.hidden] * 4, colors_of(config) + 1]
    return new_network(sizes, opacity=False).append(nn.LeakyReLU(SLOPE))


def _unblended(avatar: Any, inputs: Tensor, progress: Progress) -> Iterator[Changes]:
    shares, encoding = avatar.output_shares(progress).to(inputs), avatar.encoding()
    for e in inputs:
        values = shares * avatar.network(torch.cat([e.expand(len(encoding), -1), encoding], dim=-1))
        yield Changes(values[:, :-1], values[:, -1])


_AVERAGE = "its average of colours is not linear in the expression"
_MOVES = "its network moves Gaussians"
ABLATIONS: dict[Variant, Ablation] = {
    "no_mlp": Ablation(_explicit, lambda k, config: nn.Sequential(), _average, _AVERAGE),
    "delta": Ablation(_unpainted, _moving, _moves, _MOVES),
    "change_all": Ablation(
        lambda means, k, config: feature_tensors(means, k, config.features), _painting, _paints_and_moves, _MOVES
    ),
    "no_blending": Ablation(lambda means, k, config: {}, _deep, _unblended),
}
