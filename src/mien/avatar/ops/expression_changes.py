"""Changes of Gaussians with the expression, of low rank: what a mesh cannot say, such as wrinkles and pressed lips.

A few activations describe the whole face (`ExpressionActivations`). Each Gaussian has a basis, whose product with the
activations is added to one of its raw values (`expression_change`). Not part of any of the three papers.
"""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from mien import _native
from mien.arrays import native, recycled, unpacked
from mien.face.params import FaceParams

_EXPRESSIONS_BEYOND = 1.2
"""How far activations may go, relative to those of the training frames. 98 % of the held-out frames of wojtek go up to
1.14, of d3 up to 1.06, of other clips up to 1.21. With 1, wojtek's held-out frames lose 0.03 dB (11-27)."""
_EXPRESSIONS_LEAST_DEVIATION = 0.1  # smallest deviation that is scaled to 1, relative to that of the first direction

MARGIN = 0.1
"""How far activations can get beyond what training saw along them, as a share of it."""
_LEAST_SEEN = 1e-6
"""Smallest product with what training saw. Activations of which it saw nothing come to almost 0."""


class ExpressionActivations(nn.Module):
    """r numbers that describe an expression: how far it is from the person at rest, along r principal directions.

    The inputs are the expression coefficients, followed by the axis-angle vectors of the free joints, in radians. The
    directions are scaled so that the activations of the given timesteps have a deviation of 1 or less. They are fixed:
    training changes only the bases of the Gaussians.
    """

    rest: Tensor
    directions: Tensor
    seen: Tensor

    def __init__(self, face: FaceParams, neutral: FaceParams, rank: int):
        """Take the directions, and the range of the activations, from the timesteps of `face`.

        Directions that the timesteps do not have are 0.
        """
        super().__init__()
        rest = expression_inputs(neutral)[0]
        offsets = expression_inputs(face) - rest
        directions = principal_directions(offsets, rank)
        seen = _EXPRESSIONS_BEYOND * outermost(offsets @ directions)
        for name, value in (("rest", rest), ("directions", directions), ("seen", seen)):
            self.register_buffer(name, value.detach().clone())

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *others: Any) -> None:
        # The number of rows comes from the frames, which are not there when an avatar is loaded.
        seen = state_dict.get(prefix + "seen")
        if seen is not None and seen.shape[1:] == self.seen.shape[1:]:
            self.seen = self.seen.new_empty(seen.shape)
        super()._load_from_state_dict(state_dict, prefix, *others)

    def forward(self, face: FaceParams) -> Float[Tensor, "b r"]:
        """The activations of some timesteps. Differentiable in `face`; native for float32 on a CPU."""
        return _activations(expression_inputs(face), self.rest, self.directions, self.seen)


def activations_reference(
    inputs: Float[Tensor, "b i"],
    rest: Float[Tensor, " i"],
    directions: Float[Tensor, "i r"],
    seen: Float[Tensor, "s r"],
) -> Float[Tensor, "b r"]:
    """(inputs - rest) directions, shortened (`within_seen`), in plain PyTorch, any dtype and device."""
    return within_seen((inputs - rest) @ directions, seen)


@native(activations_reference)
def _activations(*arguments: Tensor) -> Tensor:
    return _Activations.apply(*arguments)  # pyright: ignore[reportReturnType]


class _Activations(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, inputs: Tensor, *fixed: Tensor) -> Tensor:
        rows, *others = [tensor.detach().contiguous() for tensor in (inputs, *fixed)]
        out = torch.empty(len(rows), others[1].shape[1])
        for row, activations in zip(rows, out, strict=True):
            _native.expression_activations(*unpacked(row, *others, activations))
        ctx.save_for_backward(rows, *others)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        inputs, *fixed = ctx.saved_tensors
        by_inputs = torch.empty_like(inputs)
        for row, by_row, out in zip(inputs, gradient.contiguous(), by_inputs, strict=True):
            _native.expression_activations_backward(*unpacked(row, *fixed, by_row, out))
        return by_inputs, None, None, None


def expression_inputs(face: FaceParams) -> Float[Tensor, "b i"]:
    """The expression coefficients, followed by the axis-angle vectors of the free joints, in radians."""
    return torch.cat([face.expression, face.joints.flatten(1)], dim=-1)


def principal_directions(offsets: Float[Tensor, "t i"], rank: int) -> Float[Tensor, "i r"]:
    """Directions of the largest spread, strongest first. Along each, the timesteps have a deviation of 1 or less."""
    exact = offsets.detach().double().cpu()
    centered = exact - exact.mean(0)
    strengths, vectors = torch.linalg.eigh(centered.T @ centered / len(centered))
    count = min(rank, len(strengths))
    deviations, vectors = strengths.flip(0)[:count].clamp_min(0).sqrt(), vectors.flip(1)[:, :count]
    largest = vectors.gather(0, vectors.abs().argmax(0, keepdim=True))
    usable = deviations > 1e-6
    scales = deviations.clamp_min(max(_EXPRESSIONS_LEAST_DEVIATION * float(deviations[0]), 1e-6))
    directions = exact.new_zeros(len(vectors), rank)
    directions[:, :count] = vectors * largest.sign() * usable / scales
    return directions.to(offsets)


def outermost(activations: Float[Tensor, "t r"]) -> Float[Tensor, "s r"]:
    """Those of some activations that go furthest along at least one of them, in their order."""
    exact = activations.detach().double().cpu()
    return activations[(exact @ exact.T).argmax(0).unique().to(activations.device)]


def within_seen(values: Float[Tensor, "b r"], seen: Float[Tensor, "s r"]) -> Float[Tensor, "b r"]:
    """`values`, but where they are longer than any row of `seen` goes along them: there they get shorter.

    With l the furthest that a row of `seen` goes along them, the new length approaches (1 + `MARGIN`) l and never gets
    there. Its slope is continuous. The rows of `seen` are not shortened. If there are none, nothing is.

    A limit of the length alone does not hold one strong expression: in r directions of deviation 1, usual activations
    have the length sqrt(r), which is far beyond what was filmed along any single direction.
    """
    if not len(seen):
        return values
    furthest = (values @ seen.T).amax(-1, keepdim=True).clamp_min(_LEAST_SEEN)
    ratio = values.square().sum(-1, keepdim=True) / furthest
    over = (ratio - 1).clamp_min(0)
    shortened = (1 + MARGIN * over / (MARGIN + over)) / ratio.clamp_min(1)
    return values * torch.where(over > 0, shortened, 1.0)


def expression_change_reference(basis: Float[Tensor, "*s r"], activations: Float[Tensor, " r"]) -> Float[Tensor, "*s"]:
    """`expression_change` in plain PyTorch, any dtype and device."""
    return (basis.flatten(0, -2) @ activations).view(basis.shape[:-1])


@native(expression_change_reference)
def expression_change(basis: Float[Tensor, "*s r"], activations: Float[Tensor, " r"]) -> Float[Tensor, "*s"]:
    """The sum of a basis' columns, weighted by 1 to 8 activations. Differentiable; native for float32 on a CPU."""
    return _Change.apply(basis, activations)


class _Change(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, basis: Tensor, activations: Tensor) -> Tensor:
        basis, activations = basis.detach().contiguous(), activations.detach().contiguous()
        out = torch.empty(basis.shape[:-1])
        _native.expression_change(*unpacked(basis, activations, out))
        ctx.save_for_backward(basis, activations)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor]:
        basis, activations = ctx.saved_tensors
        by_basis, by_activations = recycled(*basis.shape), torch.empty_like(activations)
        _native.expression_change_backward(
            *unpacked(basis, activations, gradient.contiguous(), by_basis, by_activations)
        )
        return by_basis, by_activations
