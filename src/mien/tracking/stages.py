"""The stages of tracking from landmarks. Each stage takes the fit so far and returns it refined."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mien.tracking.facing import trust_of
from mien.tracking.head_pose import landmark_term
from mien.tracking.landmark_groups import (
    LEFT_EYELIDS,
    LEFT_IRIS,
    LIPS,
    RIGHT_EYELIDS,
    RIGHT_IRIS,
    landmark_weights,
)
from mien.tracking.landmark_model import LandmarkModel
from mien.tracking.landmark_term import LandmarkTerm, Subject
from mien.tracking.parameters import ParameterLayout
from mien.tracking.resume import Keeper
from mien.tracking.settings import SmoothnessSettings, TrackingSettings
from mien.tracking.solver import Box, Smoothness, minimize_frames, solve_chain
from mien.tracking.views import CameraBatch, Views

_FRAME_ITERATIONS = 12
_FRAMES_AT_ONCE = 512
"""Number of timesteps fitted in one batch, which takes about 100 MB of memory."""
_ROUNDS = 2
SEQUENCE_ITERATIONS = 10
"""Largest number of iterations of the fit over time, in all rounds together."""
_RIM_BIAS_SHARE = 0.25
"""Standard deviation of the static offset for lids and lips, as a share of that of other landmarks."""
_LINE_SEARCH = (1.0, 0.5, 0.25, 0.1)


@dataclass(frozen=True, eq=False)
class SequenceFit:
    """Fit of one sequence: its cameras, and the parameters of the v timesteps in which a face was found."""

    cameras: CameraBatch
    state: Float[Tensor, "v p"]
    """Parameters in the order of the layout."""


@dataclass(frozen=True, eq=False)
class Fit:
    """The state of tracking: the subject's parameters, which all sequences share, and those of each sequence."""

    subject: Subject
    sequences: tuple[SequenceFit, ...]

    def tensors(self) -> dict[str, Tensor]:
        """The fit as tensors by name, for a file."""
        tensors = {"identity": self.subject.identity, "bias": self.subject.bias, "person": self.subject.person}
        if self.subject.vertex_offsets is not None:
            tensors["vertex_offsets"] = self.subject.vertex_offsets
        for index, own in enumerate(self.sequences):
            named = {"K": own.cameras.K, "viewmat": own.cameras.viewmat, "state": own.state}
            tensors |= {f"{name}_{index}": tensor for name, tensor in named.items()}
        return tensors


def fit_of(tensors: Mapping[str, Tensor]) -> Fit:
    """The fit made of tensors by name (`Fit.tensors`)."""
    subject = Subject(tensors["identity"], tensors["bias"], tensors.get("vertex_offsets"), tensors["person"])
    sequences: list[SequenceFit] = []
    while f"state_{len(sequences)}" in tensors:
        K, viewmat, state = (tensors[f"{name}_{len(sequences)}"] for name in ("K", "viewmat", "state"))
        sequences.append(SequenceFit(CameraBatch(K, viewmat), state))
    return Fit(subject, tuple(sequences))


def choose_keyframes(pose: Float[Tensor, "v 6"], count: int) -> Int[Tensor, " k"]:
    """Choose frames with head rotations as far apart as possible, starting from the one nearest to the median."""
    rotations = pose[:, :3]
    chosen = [int((rotations - rotations.median(0).values).norm(dim=1).argmin())]
    distance = (rotations - rotations[chosen[0]]).norm(dim=1)
    while len(chosen) < min(count, len(pose)):
        chosen.append(int(distance.argmax()))
        distance = torch.minimum(distance, (rotations - rotations[chosen[-1]]).norm(dim=1))
        distance[chosen] = -1
    return torch.tensor(sorted(chosen))


def fit_bias(terms: Sequence[LandmarkTerm], fit: Fit) -> Fit:
    """Fit the static offset of every landmark, with all else fixed.

    Beyond the detector's expected offsets, irises get none, because their position determines scale and gaze. Lids and
    lips get little, because closed is closed for everyone. All offsets together contain no translation, rotation or
    scaling, which belong to pose and identity.
    """
    bias, response = fit.subject.bias, terms[0].model.response
    expected = response.mean + response.of_person(fit.subject.person)
    precision = torch.full((len(bias), 1), response.rest_sigma**-2).to(bias)
    precision[list(LIPS + LEFT_EYELIDS + RIGHT_EYELIDS)] *= _RIM_BIAS_SHARE**-2
    hessian, gradient = precision[..., None] * torch.eye(3).to(bias), precision * (bias - expected)
    for term, sequence in zip(terms, fit.sequences, strict=True):
        for part in term.linearizations(sequence.state, fit.subject, sequence.cameras):
            part_hessian, part_gradient = part.bias_equations()
            hessian, gradient = hessian + part_hessian, gradient + part_gradient
    own = bias - torch.linalg.solve(hessian, gradient) - expected
    own[list(LEFT_IRIS + RIGHT_IRIS)] = 0
    model, weights = terms[0].model, terms[0].weights
    rest = model.layout.face_params(bias.new_zeros(1, model.layout.size), fit.subject.identity)
    positions = model.head_points(rest, torch.zeros_like(bias))[0][0]
    bias = expected + _without_similarity(own, positions, weights)
    return replace(fit, subject=replace(fit.subject, bias=bias))


def _without_similarity(
    offsets: Float[Tensor, "l 3"], positions: Float[Tensor, "l 3"], weights: Float[Tensor, " l"]
) -> Float[Tensor, "l 3"]:
    centred = positions - positions.mean(0)
    axes = torch.eye(3).to(positions)
    motions = [axis.expand_as(centred) for axis in axes]
    motions += [torch.linalg.cross(axis.expand_as(centred), centred) for axis in axes] + [centred]
    basis = torch.stack(motions, dim=-1)
    moving = (offsets != 0).any(1)
    root = weights.sqrt() * moving
    weighted = (basis * root[:, None, None]).flatten(0, 1)
    amount = torch.linalg.lstsq(weighted, (offsets * root[:, None]).flatten()[:, None]).solution
    return (offsets - (basis @ amount)[..., 0]) * moving[:, None]


def fit_frames(
    term: LandmarkTerm,
    subject: Subject,
    own: SequenceFit,
    advance: Callable[[int], None] = lambda timesteps: None,
    keeper: Keeper | None = None,
    name: str = "frames",
) -> SequenceFit:
    """Fit pose, expression and eyes at every timestep alone. `advance` receives the number of finished timesteps."""
    keeper, parts = keeper or Keeper(), []

    def fitted(rows: Int[Tensor, " k"]) -> dict[str, Tensor]:
        part = term.at(rows)
        state = minimize_frames(
            lambda state: part.equations(state, subject, own.cameras),
            lambda state: part.cost(state, subject, own.cameras),
            own.state[rows], box_of(term.model.layout), _FRAME_ITERATIONS,
        )  # fmt: skip
        return {"state": state}

    for index, rows in enumerate(torch.arange(len(own.state)).split(_FRAMES_AT_ONCE)):
        parts.append(keeper.once(f"{name}-{index}", partial(fitted, rows))["state"])
        advance(len(rows))
    return replace(own, state=torch.cat(parts))


def fit_sequences(
    terms: Sequence[LandmarkTerm],
    fit: Fit,
    smoothness: Sequence[Smoothness],
    advance: Callable[[int], None] = lambda timesteps: None,
    keeper: Keeper | None = None,
) -> Fit:
    """Fit all timesteps of each sequence together under its smoothness cost, in turn with the landmarks' bias.

    `advance` receives the number of finished timesteps in each of the `SEQUENCE_ITERATIONS` iterations.
    """
    keeper = keeper or Keeper()

    def round_from(fit: Fit) -> dict[str, Tensor]:
        fit = fit_bias(terms, fit)
        parts = zip(terms, fit.sequences, smoothness, strict=True)
        chains = tuple(_fit_chain(term, fit.subject, own, smooth, advance) for term, own, smooth in parts)
        return replace(fit, sequences=chains).tensors()

    for number in range(_ROUNDS):
        fit = fit_of(keeper.once(f"sequence-{number}", partial(round_from, fit)))
    return fit


def _fit_chain(
    term: LandmarkTerm,
    subject: Subject,
    own: SequenceFit,
    smoothness: Smoothness,
    advance: Callable[[int], None],
) -> SequenceFit:
    box, iterations = box_of(term.model.layout), SEQUENCE_ITERATIONS // _ROUNDS

    def cost(state: Float[Tensor, "v p"]) -> float:
        return float(term.cost(state, subject, own.cameras).sum() + smoothness.cost(state))

    def step_from(state: Float[Tensor, "v p"]) -> Float[Tensor, "v p"]:
        equations = term.equations(state, subject, own.cameras)
        held = box.held(state, equations.gradient + smoothness.gradient(state))
        return solve_chain(equations, smoothness, state, held)

    state, best = own.state, cost(own.state)
    for done in range(iterations):
        step = step_from(state)
        candidates = (box.clip(state + fraction * step) for fraction in _LINE_SEARCH)
        improved = next(((c, value) for c in candidates if (value := cost(c)) < best), None)
        converged = improved is None or best - improved[1] < 1e-4 * best
        state, best = improved or (state, best)
        advance(len(state) * (iterations - done if converged else 1))
        if converged:
            break
    return replace(own, state=state)


def smoothness_of(
    layout: ParameterLayout,
    valid: Bool[Tensor, " t"],
    fps: float,
    settings: SmoothnessSettings,
    cameras: CameraBatch | None = None,
) -> Smoothness:
    """The smoothness cost over the valid timesteps. Missing timesteps break the chain.

    Args:
        layout: Layout of the parameters.
        valid: Timesteps in which a face was found.
        fps: Frames per second.
        settings: The smoothness settings.
        cameras: Cameras of the sequence. A single camera sees depth less well. The default looks along z.
    """
    sigmas = torch.full((layout.size,), math.inf, dtype=torch.float64)
    sigmas[:3] = settings.rotation
    along_sight = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    if cameras is not None:
        along_sight = cameras.viewmat[0, 2, :3] ** 2 if len(cameras) == 1 else torch.zeros_like(along_sight)
    sigmas[3:6] = settings.translation + (settings.depth - settings.translation) * along_sight
    # Eyes and lids may jump.
    slow = torch.tensor(["eye" not in name.lower() for name in layout.names[6:]], dtype=torch.bool)
    sigmas[6:] = torch.where(slow, settings.expression * layout.units, torch.inf)
    frames = valid.nonzero()[:, 0]
    linked = torch.zeros(len(frames), dtype=torch.bool)
    if len(frames) > 2:
        linked[1:-1] = frames[2:] - frames[:-2] == 2
    return Smoothness((sigmas / fps**2) ** -2, linked)


def widen(pose: Float[Tensor, "v 6"], layout: ParameterLayout) -> Float[Tensor, "v p"]:
    """Head poses as complete parameter vectors, with everything else at rest."""
    return torch.cat([pose, pose.new_zeros(len(pose), layout.size - 6)], dim=1)


def all_landmarks(model: LandmarkModel, views: Views, own: SequenceFit, settings: TrackingSettings) -> LandmarkTerm:
    """The cost of all landmarks at the depth of a fit. Its head poses determine the trust in each picture."""
    views = replace(views, trust=trust_of(views, own.state, own.cameras))
    return landmark_term(model, views, landmark_weights(settings.landmarks), own.state, own.cameras, settings)


def quiet_landmarks(term: LandmarkTerm, share: float) -> LandmarkTerm:
    """The term with a share of its weight, except for lips, lids and irises.

    These keep their weight, because one texture cannot show both an open and a closed mouth.
    """
    kept = torch.full_like(term.weights, share)
    kept[list(LIPS + LEFT_EYELIDS + RIGHT_EYELIDS + LEFT_IRIS + RIGHT_IRIS)] = 1
    return replace(term, weights=term.weights * kept)


def box_of(layout: ParameterLayout) -> Box:
    """The bounds of the parameters."""
    return Box(layout.lower, layout.upper)
