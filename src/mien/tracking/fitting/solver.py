"""Batched Levenberg-Marquardt: many small dense problems, coupled by shared parameters or along time."""

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

SEGMENT = 1024  # blocks of a chain whose factors are in memory at once: about 120 MB for pairs of 60 parameters


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Cost of b frames, with half its gradient and half its Gauss-Newton Hessian."""

    cost: Float[Tensor, " b"]
    gradient: Float[Tensor, "b p"]
    hessian: Float[Tensor, "b p p"]

    def plus(self, other: "NormalEquations") -> "NormalEquations":
        """The equations of the sum of both costs."""
        return NormalEquations(self.cost + other.cost, self.gradient + other.gradient, self.hessian + other.hessian)

    def split(self, own: int, columns: Int[Tensor, " k"], size: int) -> "tuple[NormalEquations, SharedEquations]":
        """Split into those of each frame's first `own` parameters and of the rest, `columns` of `size` shared ones."""
        across = self.hessian.new_zeros(len(self.cost), own, size)
        across[:, :, columns] = self.hessian[:, :own, own:]
        hessian, gradient = self.hessian.new_zeros(size, size), self.gradient.new_zeros(size)
        hessian[columns[:, None], columns] = self.hessian[:, own:, own:].sum(0)
        gradient[columns] = self.gradient[:, own:].sum(0)
        frames = NormalEquations(self.cost, self.gradient[:, :own], self.hessian[:, :own, :own])
        return frames, SharedEquations(across, hessian, gradient)


@dataclass(frozen=True, eq=False)
class Bounds:
    """Lower and upper bounds of each parameter, which may be infinite."""

    lower: Float[Tensor, " p"]
    upper: Float[Tensor, " p"]

    def clip(self, state: Float[Tensor, "*b p"]) -> Float[Tensor, "*b p"]:
        """The nearest state within the bounds."""
        return torch.minimum(torch.maximum(state, self.lower), self.upper)

    def held(self, state: Float[Tensor, "b p"], gradient: Float[Tensor, "b p"]) -> Bool[Tensor, "b p"]:
        """The active set: parameters at a bound that a descent step would push beyond it."""
        return ((state <= self.lower) & (gradient > 0)) | ((state >= self.upper) & (gradient < 0))


def minimize_frames(
    equations_at: Callable[[Tensor], NormalEquations],
    cost_at: Callable[[Tensor], Tensor],
    start: Float[Tensor, "b p"],
    bounds: Bounds,
    iterations: int,
) -> Float[Tensor, "b p"]:
    """Minimise b independent frames within bounds by projected Levenberg-Marquardt steps, each with its own damping."""
    state = bounds.clip(start)
    damping = state.new_full((len(state),), 1e-3)
    for _ in range(iterations):
        equations = equations_at(state)
        moving = hold(equations, bounds.held(state, equations.gradient))
        diagonal = moving.hessian.diagonal(dim1=-2, dim2=-1)
        damped = moving.hessian + torch.diag_embed(diagonal * damping[:, None] + 1e-12)
        step = torch.cholesky_solve(moving.gradient[..., None], torch.linalg.cholesky(damped))[..., 0]
        candidate = bounds.clip(state - step)
        better = cost_at(candidate) < equations.cost
        state = torch.where(better[:, None], candidate, state)
        damping = torch.where(better, damping / 5, damping * 8).clamp(1e-7, 1e7)
    return state


def hold(equations: NormalEquations, held: Bool[Tensor, "b p"]) -> NormalEquations:
    """The equations with some parameters held fixed: their rows and columns become those of the identity."""
    moving = (~held).to(equations.hessian)
    kept = equations.hessian * moving[:, :, None] * moving[:, None, :]
    return NormalEquations(equations.cost, equations.gradient * moving, kept + torch.diag_embed(1 - moving))


def join_frames(parts: Sequence[NormalEquations]) -> NormalEquations:
    """The equations of all parts' frames in a row."""
    return NormalEquations(
        torch.cat([part.cost for part in parts]),
        torch.cat([part.gradient for part in parts]),
        torch.cat([part.hessian for part in parts]),
    )


@dataclass(frozen=True, eq=False)
class SharedEquations:
    """Blocks of the normal equations for s parameters that b frames share."""

    across: Float[Tensor, "b p s"]
    """Half the Hessian between each frame's own parameters and the shared ones."""
    hessian: Float[Tensor, "s s"]
    gradient: Float[Tensor, " s"]
    """Half the gradient."""

    def plus(self, other: "SharedEquations") -> "SharedEquations":
        """The blocks of the sum of both costs."""
        across, hessian = self.across + other.across, self.hessian + other.hessian
        return SharedEquations(across, hessian, self.gradient + other.gradient)

    def with_prior(self, precision: Float[Tensor, " s"], values: Float[Tensor, " s"]) -> "SharedEquations":
        """The blocks with a quadratic cost on the shared values added."""
        return SharedEquations(self.across, self.hessian + torch.diag(precision), self.gradient + precision * values)


def join_shared(parts: Sequence[SharedEquations]) -> SharedEquations:
    """The blocks of all parts' frames in a row, with the shared ones summed."""
    return SharedEquations(
        torch.cat([part.across for part in parts]),
        torch.stack([part.hessian for part in parts]).sum(0),
        torch.stack([part.gradient for part in parts]).sum(0),
    )


def solve_arrow(
    frames: NormalEquations, shared: SharedEquations, held: Bool[Tensor, "b p"], damping: float
) -> tuple[Float[Tensor, "b p"], Float[Tensor, " s"]]:
    """One damped step of the frames' own parameters and the shared ones, by the Schur complement."""
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
    """Robust cost of the acceleration d[t] = x[t-1] - 2 x[t] + x[t+1] of each parameter.

    A second difference is zero for steady motion, and the chain is solved as a whole, forward and backward in time, so
    jitter is damped without lag. With s = precision d^2 the cost is 2 c^2 (sqrt(1 + s / c^2) - 1): quadratic for
    jitter, but only linear (pseudo-Huber) beyond c sigmas, so that a sudden turn keeps its speed.
    """

    precision: Float[Tensor, " p"]
    """Precision of each parameter's second difference."""
    linked: Bool[Tensor, " t"]
    """Whether the second difference centred at each timestep counts. It does not at the ends and beside gaps."""
    outlier: float = 1.5
    """The c of the cost: number of sigmas beyond which it is about linear."""

    def differences(self, state: Float[Tensor, "t p"]) -> Float[Tensor, "t p"]:
        """Second differences; zero where they do not count."""
        second = torch.zeros_like(state)
        second[1:-1] = state[:-2] - 2 * state[1:-1] + state[2:]
        return second * self.linked[:, None]

    def cost(self, state: Float[Tensor, "t p"]) -> Float[Tensor, ""]:
        """The cost of all parameters over all timesteps."""
        square = self.outlier**2
        relative = self.differences(state) ** 2 * self.precision / square
        return 2 * square * ((1 + relative).sqrt() - 1).sum()

    def weights(self, state: Float[Tensor, "t p"]) -> Float[Tensor, "t p"]:
        """Weights of the squared second differences in the quadratic cost with the same gradient; 0 if not linked."""
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
        """Diagonal and two upper off-diagonals along time of half the Hessian of that quadratic cost, [t, p] each."""
        weights = self.weights(state)
        before, after, first, second = (torch.zeros_like(weights) for _ in range(4))
        before[1:], after[:-1] = weights[:-1], weights[1:]
        first[:-1] = -2 * (weights[:-1] + weights[1:])
        second[:-2] = weights[1:-1]
        return 4 * weights + before + after, first, second


def solve_chain(
    frames: NormalEquations, smoothness: Smoothness, state: Float[Tensor, "t p"], held: Bool[Tensor, "t p"]
) -> Float[Tensor, "t p"]:
    """The Gauss-Newton step of all frames under the smoothness cost, by elimination of blocks of two frames."""
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

    return -solve_tridiagonal(own, upper, gradient.reshape(-1, 2 * p)).reshape(-1, p)[:t]


def solve_tridiagonal(
    own: Callable[[int], Tensor], upper: Callable[[int], Tensor], right: Float[Tensor, "n q"]
) -> Float[Tensor, "n q"]:
    """Solve a symmetric positive definite block-tridiagonal system. `upper(i)` couples block i to block i + 1.

    Only the factors of one segment of blocks are in memory. A system of several segments is eliminated twice: first to
    find the reduced block at the start of each segment, then from the last segment to the first, for substitution.
    """
    starts = range(0, len(right), SEGMENT)
    begins = [(own(0), right[0])]
    for start in starts[:-1]:
        steps = _eliminate(own, upper, right, begins[-1], range(start, start + SEGMENT + 1))
        _, block, side = deque(steps, maxlen=1).pop()
        begins.append((block, side))
    solution = torch.zeros_like(right)
    for start, begin in zip(reversed(starts), reversed(begins), strict=True):
        segment = range(start, min(start + SEGMENT, len(right)))
        steps = list(_eliminate(own, upper, right, begin, segment))
        for index, (factor, _, side) in zip(reversed(segment), reversed(steps), strict=True):
            if index + 1 < len(right):
                side = side - upper(index) @ solution[index + 1]
            solution[index] = torch.cholesky_solve(side[:, None], factor)[:, 0]
        steps.clear()  # Free the memory before the next segment.
    return solution


def _eliminate(
    own: Callable[[int], Tensor],
    upper: Callable[[int], Tensor],
    right: Float[Tensor, "n q"],
    begin: tuple[Tensor, Tensor],
    blocks: range,
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Yield factor, reduced block and right side of consecutive blocks. `begin` has block and side of the first."""
    block, side = begin
    for index in blocks:
        factor = torch.linalg.cholesky(block)
        yield factor, block, side
        if index + 1 < blocks.stop:
            coupling = upper(index)
            solved = torch.cholesky_solve(torch.cat([coupling, side[:, None]], dim=1), factor)
            block = own(index + 1) - coupling.T @ solved[:, :-1]
            side = right[index + 1] - coupling.T @ solved[:, -1]


def place_shared(own: SharedEquations, lens: int | None, free: int) -> SharedEquations:
    """A sequence's blocks (subject, focal length), placed among all focal lengths. A known one is dropped."""
    subject = len(own.gradient) - 1
    placing = own.gradient.new_zeros(subject + 1, subject + free)
    placing[:subject, :subject] = torch.eye(subject)
    if lens is not None:
        placing[subject, subject + lens] = 1
    return SharedEquations(own.across @ placing, placing.T @ own.hessian @ placing, own.gradient @ placing)
