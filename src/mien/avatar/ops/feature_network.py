"""Features of Gaussians, blended by the inputs of a face, through a network of two layers (HeadGaS, section 3.2).

A Gaussian's features are f = f0 + sum over k of e_k F_k: its neutral features f0, and its bases F weighted by the
inputs e. The network takes the features and some numbers of the Gaussian's own. It is the same for all Gaussians and
has one hidden layer with leaky ReLU. Native for float32 on a CPU: one call forward and one backward.

The bases are by far the largest tensor of an avatar. Their gradient by F_k is e_k times that by f, so it is given to a
`FactoredGradient` as these two factors, and never made.
"""

from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from mien import _native
from mien.adam import FactoredGradient, FactoredTerm
from mien.arrays import native, recycled, recycled_like, unpacked

SLOPE = 0.01
"""Slope of the leaky ReLU below 0."""
_LANES = 16


class Layers(NamedTuple):
    """Weights and biases of the two layers."""

    weight1: Float[Tensor, "h i"]
    """i: the features, then the Gaussian's own numbers."""
    bias1: Float[Tensor, " h"]
    weight2: Float[Tensor, "o h"]
    bias2: Float[Tensor, " o"]


def _plain_network(
    bases: Tensor, inputs: Tensor, rows: Tensor | None, neutral: Tensor, own: Tensor, layers: Layers,
    gradient: FactoredGradient,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    return network_outputs(blended_features(bases, inputs, rows, neutral, gradient), own, layers)


@native(_plain_network)
def feature_network(
    bases: Float[Tensor, "n k f"],
    inputs: Float[Tensor, "*g k"],
    rows: Int[Tensor, " n"] | None,
    neutral: Float[Tensor, "n f"],
    own: Float[Tensor, "n x"],
    layers: Layers,
    gradient: FactoredGradient,
) -> tuple[Float[Tensor, "n p"], Float[Tensor, " n"]]:
    """All outputs but the last, and the last. Differentiable in everything but inputs with rows.

    With `rows`, `inputs` is a table [g, k], and each Gaussian takes its row; without, all take the same inputs [k]. The
    gradient of the bases goes to `gradient`. `own` are numbers of each Gaussian beside its features.
    """
    return _Network.apply(gradient, rows, bases, inputs, neutral, own, *layers)


def blended_features(
    bases: Float[Tensor, "n k f"],
    inputs: Float[Tensor, "*g k"],
    rows: Int[Tensor, " n"] | None,
    neutral: Float[Tensor, "n f"],
    gradient: FactoredGradient,
) -> Float[Tensor, "n f"]:
    """The features without a network. The gradient of the bases goes to `gradient`, as in `feature_network`."""
    return _Blend.apply(gradient, rows, bases, inputs, neutral)


def network_outputs(
    features: Float[Tensor, "n f"], own: Float[Tensor, "n x"], layers: Layers
) -> tuple[Float[Tensor, "n p"], Float[Tensor, " n"]]:
    """The network on blended features, in plain PyTorch: all outputs but the last, and the last."""
    hidden = torch.cat([features, own], dim=-1) @ layers.weight1.T + layers.bias1
    outputs = torch.nn.functional.leaky_relu(hidden, SLOPE) @ layers.weight2.T + layers.bias2
    return outputs[:, :-1], outputs[:, -1]


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, gradient: FactoredGradient, rows: Tensor | None, bases: Tensor, inputs: Tensor, neutral: Tensor
    ) -> Tensor:
        ctx.gradient, ctx.rows = gradient, rows
        ctx.save_for_backward(bases, inputs)
        if rows is not None:
            return neutral + torch.einsum("nkf,nk->nf", bases, inputs[rows])
        return neutral + inputs @ bases  # where a sum over k by einsum would copy the bases

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_features: Tensor) -> tuple[Tensor | None, ...]:
        bases, inputs = ctx.saved_tensors
        if ctx.needs_input_grad[2]:
            ctx.gradient.terms.append(FactoredTerm(by_features, inputs, ctx.rows))
        by_inputs = torch.einsum("nkf,nf->k", bases, by_features) if ctx.needs_input_grad[3] else None
        return None, None, None, by_inputs, by_features


class _Network(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, gradient: FactoredGradient, rows: Tensor | None, *arguments: Tensor) -> tuple[Tensor, Tensor]:
        bases, inputs, neutral, *rest = (tensor.contiguous() for tensor in arguments)
        n, outputs = len(neutral), len(rest[-1])
        last, others = recycled(n), recycled(n, outputs - 1)
        kept: tuple[Tensor, ...] = ()
        if any(ctx.needs_input_grad):
            kept = (recycled(*neutral.shape), recycled(n, -(-len(rest[2]) // _LANES) * _LANES))
        _native.feature_network(
            _native.FeatureNetwork(*unpacked(neutral, *rest)),
            _native.FeatureBases(*unpacked(bases, torch.atleast_2d(inputs), rows)),
            _native.FeatureKept(*unpacked(*kept)) if kept else None,
            *unpacked(others, last),
        )
        ctx.gradient, ctx.rows, ctx.neutral = gradient, rows, arguments[2] if arguments[2].is_leaf else None
        ctx.save_for_backward(bases, inputs, neutral, *rest, *kept)
        return others, last

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_others: Tensor, by_last: Tensor) -> tuple[Tensor | None, ...]:
        bases, inputs, neutral, own, *layers = ctx.saved_tensors[:8]
        by_features = recycled(*neutral.shape)
        by_inputs = recycled(len(inputs) if ctx.needs_input_grad[3] else 0)
        by_own = recycled_like(own) if ctx.needs_input_grad[5] else None
        by_layers = [recycled_like(tensor) for tensor in layers]
        _native.feature_network_backward(
            _native.FeatureNetwork(*unpacked(neutral, own, *layers)),
            _native.FeatureBases(*unpacked(bases, torch.atleast_2d(inputs), ctx.rows)),
            _native.FeatureKept(*unpacked(*ctx.saved_tensors[8:])),
            _native.FeatureGradients(
                *unpacked(by_others.contiguous(), by_last.contiguous(), by_features, *by_layers, by_inputs),
                *unpacked(recycled(0, 0) if by_own is None else by_own),
            ),
        )
        if ctx.needs_input_grad[2]:
            if ctx.neutral is not None and ctx.neutral.grad is not None:
                # It may share the memory of an earlier term, and autograd adds to it in place.
                ctx.neutral.grad = ctx.neutral.grad.clone()
            # Autograd copies gradients that somebody else holds. It does not know of a second tensor in their memory.
            ctx.gradient.terms.append(FactoredTerm(by_features.detach(), inputs, ctx.rows))
        return None, None, None, by_inputs if len(by_inputs) else None, by_features, by_own, *by_layers
