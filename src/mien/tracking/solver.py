"""Batched Levenberg-Marquardt: small dense problems side by side, tied by shared parameters or along time."""

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

_DAMPING_START, _DAMPING_LEAST, _DAMPING_MOST = 1e-3, 1e-7, 1e7
_SEGMENT = 1024
"""Blocks of a chain whose factors are kept at a time: some 120 MB for pairs of frames with 60 parameters."""


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Half the gradient and the Gauss-Newton half Hessian of b frames, with the cost they belong to."""

    cost: Float[Tensor, " b"]
    gradient: Float[Tensor, "b p"]
    hessian: Float[Tensor, "b p p"]

    def plus(self, other: "NormalEquations") -> "NormalEquations":
        """Of both costs together."""
        return NormalEquations(self.cost + other.cost, self.gradient + other.gradient, self.hessian + other.hessian)

    def split(self, own: int, columns: Int[Tensor, " k"], size: int) -> "tuple[NormalEquations, SharedEquations]":
        """Of each frame's first `own` parameters, and of the other k, which are `columns` of `size` shared ones."""
        across = self.hessian.new_zeros(len(self.cost), own, size)
        across[:, :, columns] = self.hessian[:, :own, own:]
        hessian, gradient = self.hessian.new_zeros(size, size), self.gradient.new_zeros(size)
        hessian[columns[:, None], columns] = self.hessian[:, own:, own:].sum(0)
        gradient[columns] = self.gradient[:, own:].sum(0)
        frames = NormalEquations(self.cost, self.gradient[:, :own], self.hessian[:, :own, :own])
        return frames, SharedEquations(across, hessian, gradient)


@dataclass(frozen=True, eq=False)
class Box:
    """Lower and upper bounds of each parameter, which may be infinite."""

    lower: Float[Tensor, " p"]
    upper: Float[Tensor, " p"]

    def clip(self, state: Float[Tensor, "b p"]) -> Float[Tensor, "b p"]:
        """The nearest state within the bounds."""
        return torch.minimum(torch.maximum(state, self.lower), self.upper)

    def held(self, state: Float[Tensor, "b p"], gradient: Float[Tensor, "b p"]) -> Bool[Tensor, "b p"]:
        """Parameters at a bound that the gradient's descent would push through it: the active set."""
        return ((state <= self.lower) & (gradient > 0)) | ((state >= self.upper) & (gradient < 0))


def minimize_frames(
    equations_at: Callable[[Tensor], NormalEquations],
    cost_at: Callable[[Tensor], Tensor],
    start: Float[Tensor, "b p"],
    box: Box,
    iterations: int,
) -> Float[Tensor, "b p"]:
    """Levenberg-Marquardt within bounds on b independent frames, each with its own damping.

    Parameters held by a bound are left out of the step (a projected Newton step), the rest is clipped.
    """
    state = box.clip(start)
    damping = state.new_full((len(state),), _DAMPING_START)
    for _ in range(iterations):
        equations = equations_at(state)
        held = box.held(state, equations.gradient)
        step = _damped_step(equations, held, damping)
        candidate = box.clip(state + step)
        better = cost_at(candidate) < equations.cost
        state = torch.where(better[:, None], candidate, state)
        damping = torch.where(better, damping / 5, damping * 8).clamp(_DAMPING_LEAST, _DAMPING_MOST)
    return state


def _damped_step(
    equations: NormalEquations, held: Bool[Tensor, "b p"], damping: Float[Tensor, " b"]
) -> Float[Tensor, "b p"]:
    moving = hold(equations, held)
    diagonal = moving.hessian.diagonal(dim1=-2, dim2=-1)
    damped = moving.hessian + torch.diag_embed(diagonal * damping[:, None] + 1e-12)
    return -torch.cholesky_solve(moving.gradient[..., None], torch.linalg.cholesky(damped))[..., 0]


def hold(equations: NormalEquations, held: Bool[Tensor, "b p"]) -> NormalEquations:
    """The same equations with some parameters kept still: their rows and columns become the identity's."""
    moving = (~held).to(equations.hessian)
    kept = equations.hessian * moving[:, :, None] * moving[:, None, :]
    return NormalEquations(equations.cost, equations.gradient * moving, kept + torch.diag_embed(1 - moving))


def joined(parts: Sequence[NormalEquations]) -> NormalEquations:
    """The equations of all parts' frames in a row."""
    return NormalEquations(
        torch.cat([part.cost for part in parts]),
        torch.cat([part.gradient for part in parts]),
        torch.cat([part.hessian for part in parts]),
    )


@dataclass(frozen=True, eq=False)
class SharedEquations:
    """Blocks of s parameters that b frames share."""

    across: Float[Tensor, "b p s"]
    """Half Hessian, mixed with each frame's own parameters."""
    hessian: Float[Tensor, "s s"]
    gradient: Float[Tensor, " s"]
    """Half the gradient."""

    def plus(self, other: "SharedEquations") -> "SharedEquations":
        """Of both costs together."""
        across, hessian = self.across + other.across, self.hessian + other.hessian
        return SharedEquations(across, hessian, self.gradient + other.gradient)

    def with_prior(self, precision: Float[Tensor, " s"], values: Float[Tensor, " s"]) -> "SharedEquations":
        """Under a quadratic cost on the values."""
        return SharedEquations(self.across, self.hessian + torch.diag(precision), self.gradient + precision * values)


def joined_shared(parts: Sequence[SharedEquations]) -> SharedEquations:
    """The blocks of all parts' frames."""
    return SharedEquations(
        torch.cat([part.across for part in parts]),
        torch.stack([part.hessian for part in parts]).sum(0),
        torch.stack([part.gradient for part in parts]).sum(0),
    )


def solve_arrow(
    frames: NormalEquations, shared: SharedEquations, held: Bool[Tensor, "b p"], damping: float
) -> tuple[Float[Tensor, "b p"], Float[Tensor, " s"]]:
    """One damped step of b frames' parameters and of what they share, by the Schur complement."""
    frames, across = hold(frames, held), shared.across * (~held)[:, :, None]
    diagonal = frames.hessian.diagonal(dim1=-2, dim2=-1)
    factor = torch.linalg.cholesky(frames.hessian + torch.diag_embed(diagonal * damping + 1e-12))
    eliminated = torch.cholesky_solve(torch.cat([across, frames.gradient[..., None]], dim=-1), factor)
    reduced = shared.hessian + torch.diag(shared.hessian.diagonal() * damping)
    reduced = reduced - torch.einsum("bps,bpr->sr", across, eliminated[..., :-1])
    right = shared.gradient - torch.einsum("bps,bp->s", across, eliminated[..., -1])
    shared_step = -torch.linalg.solve(reduced, right)
    return -eliminated[..., -1] - eliminated[..., :-1] @ shared_step, shared_step


@dataclass(frozen=True, eq=False)
class Smoothness:
    """Robust costs on the acceleration d[t] = x[t-1] - 2 x[t] + x[t+1] of each parameter.

    A second difference leaves steady motion alone, and the chain is solved as a whole, forward and backward in time:
    it damps jitter without lag. The cost of a parameter's s = precision d^2 is 2 c^2 (sqrt(1 + s / c^2) - 1): square
    for jitter, but only linear (pseudo-Huber) from c sigmas on, so that a sudden turn keeps its speed.
    """

    precision: Float[Tensor, " p"]
    """Of each parameter's second difference."""
    linked: Bool[Tensor, " t"]
    """Whether the second difference centred at each timestep counts (False at the ends and beside missing frames)."""
    outlier: float = 1.5
    """c: sigmas from which the cost is about linear."""

    def differences(self, state: Float[Tensor, "t p"]) -> Float[Tensor, "t p"]:
        """Second differences where they count, else zero."""
        second = torch.zeros_like(state)
        second[1:-1] = state[:-2] - 2 * state[1:-1] + state[2:]
        return second * self.linked[:, None]

    def cost(self, state: Float[Tensor, "t p"]) -> Float[Tensor, ""]:
        """Of all parameters over all time."""
        square = self.outlier**2
        relative = self.differences(state) ** 2 * self.precision / square
        return 2 * square * ((1 + relative).sqrt() - 1).sum()

    def weights(self, state: Float[Tensor, "t p"]) -> Float[Tensor, "t p"]:
        """Of each squared second difference in the quadratic cost with the same gradient; 0 where none counts."""
        relative = self.differences(state) ** 2 * self.precision / self.outlier**2
        return self.linked[:, None] * self.precision / (1 + relative).sqrt()

    def gradient(self, state: Float[Tensor, "t p"]) -> Float[Tensor, "t p"]:
        """Half the gradient of the cost."""
        weighted = self.differences(state) * self.weights(state)
        gradient = -2 * weighted
        gradient[:-1] += weighted[1:]
        gradient[1:] += weighted[:-1]
        return gradient

    def bands(self, state: Float[Tensor, "t p"]) -> tuple[Tensor, Tensor, Tensor]:
        """The half Hessian of that quadratic cost along time: diagonal, first and second upper off-diagonal, [t, p]."""
        weights = self.weights(state)
        before, after, first, second = (torch.zeros_like(weights) for _ in range(4))
        before[1:], after[:-1] = weights[:-1], weights[1:]
        first[:-1] = -2 * (weights[:-1] + weights[1:])
        second[:-2] = weights[1:-1]
        return 4 * weights + before + after, first, second


def solve_chain(
    frames: NormalEquations, smoothness: Smoothness, state: Float[Tensor, "t p"], held: Bool[Tensor, "t p"]
) -> Float[Tensor, "t p"]:
    """The Gauss-Newton step of all frames under the smoothness cost; direct, by block-tridiagonal elimination.

    Two frames make one block, so that second differences couple neighbouring blocks only.
    """
    t, p = state.shape
    moving = (~held).to(state)
    diagonal, first, second = smoothness.bands(state)
    gradient = (frames.gradient + smoothness.gradient(state)) * moving
    first = first * moving * torch.cat([moving[1:], moving[:1]])
    second = second * moving * torch.cat([moving[2:], moving[:2]])
    if t % 2:
        gradient, first, second = (torch.cat([part, part.new_zeros(1, p)]) for part in (gradient, first, second))

    def frame(index: int) -> Float[Tensor, "p p"]:
        if index == t:
            return torch.eye(p).to(state)
        free = moving[index]
        hessian = frames.hessian[index] + torch.diag(diagonal[index] + 1e-12)
        return hessian * free[:, None] * free + torch.diag(1 - free)

    def own(block: int) -> Float[Tensor, "q q"]:
        tie = torch.diag(first[2 * block])
        return torch.cat([torch.cat([frame(2 * block), tie], 1), torch.cat([tie, frame(2 * block + 1)], 1)])

    def upper(block: int) -> Float[Tensor, "q q"]:
        here, next_ = torch.diag(second[2 * block]), torch.diag(second[2 * block + 1])
        tie = torch.diag(first[2 * block + 1])
        return torch.cat([torch.cat([here, torch.zeros_like(here)], 1), torch.cat([tie, next_], 1)])

    return -_solve_tridiagonal(own, upper, gradient.reshape(-1, 2 * p)).reshape(-1, p)[:t]


def _solve_tridiagonal(
    own: Callable[[int], Tensor], upper: Callable[[int], Tensor], right: Float[Tensor, "n q"]
) -> Float[Tensor, "n q"]:
    """Solve a symmetric positive definite block-tridiagonal system; `upper(i)` couples block i to block i + 1.

    Factors are kept for a segment of blocks at a time. A system of several segments is eliminated twice: first to know
    where each segment begins, then from the last segment to the first, to go back through each.
    """
    starts = range(0, len(right), _SEGMENT)
    begins = [(own(0), right[0])]
    for start in starts[:-1]:
        steps = _eliminate(own, upper, right, begins[-1], range(start, start + _SEGMENT + 1))
        _, block, side = deque(steps, maxlen=1).pop()
        begins.append((block, side))
    solution = torch.zeros_like(right)
    for start, begin in zip(reversed(starts), reversed(begins), strict=True):
        segment = range(start, min(start + _SEGMENT, len(right)))
        steps = list(_eliminate(own, upper, right, begin, segment))
        for index, (factor, _, side) in zip(reversed(segment), reversed(steps), strict=True):
            if index + 1 < len(right):
                side = side - upper(index) @ solution[index + 1]
            solution[index] = torch.cholesky_solve(side[:, None], factor)[:, 0]
        steps.clear()  # before the next segment's are made
    return solution


def _eliminate(
    own: Callable[[int], Tensor],
    upper: Callable[[int], Tensor],
    right: Float[Tensor, "n q"],
    begin: tuple[Tensor, Tensor],
    blocks: range,
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Factor, reduced block and right side of consecutive blocks, of which `begin` is the first's."""
    block, side = begin
    for index in blocks:
        factor = torch.linalg.cholesky(block)
        yield factor, block, side
        if index + 1 < blocks.stop:
            coupling = upper(index)
            solved = torch.cholesky_solve(torch.cat([coupling, side[:, None]], dim=1), factor)
            block = own(index + 1) - coupling.T @ solved[:, :-1]
            side = right[index + 1] - coupling.T @ solved[:, -1]
