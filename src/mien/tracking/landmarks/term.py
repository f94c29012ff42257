"""The landmark cost: robust distances between detected and projected landmarks, with priors on the parameters."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mien.machine.parallel import stream_in_threads
from mien.rotation import matrix_from_axis_angle
from mien.tracking.fitting.fit import SequenceFit, Subject
from mien.tracking.fitting.solver import NormalEquations, SharedEquations
from mien.tracking.fitting.views import CameraBatch, Views
from mien.tracking.landmarks.detector_response import DetectorResponse
from mien.tracking.landmarks.groups import LEFT_EYELIDS, LEFT_IRIS, LIPS, RIGHT_EYELIDS, RIGHT_IRIS, landmark_weights
from mien.tracking.landmarks.model import LandmarkModel, Linearization
from mien.tracking.settings import TrackingSettings

Result = TypeVar("Result")

LANDMARK_SIGMA = 0.0015  # expected error of a landmark, in metres on the face
_OUTLIER = 6.0  # number of these sigmas beyond which a landmark's pull fades
INDEPENDENT_LANDMARKS = 25.0
"""Number of independent landmarks that all of a picture are worth, because their errors are correlated."""
_SIDEWAYS_ANGLE = 0.3
"""Angle between the direction of the face and the camera at which a picture counts half if there are several cameras,
in radians. Measured: 0.25 to 0.7 have the same error to 0.04 mm, and smaller angles better blinks (log, "Several
cameras in the fit")."""

LINEARIZED = 48
"""Number of pictures linearised at once, which takes about 100 MB of memory."""
PROJECTED = 128
"""Number of pictures projected at once, which takes about as much memory."""


def move_subject(subject: Subject, step: Float[Tensor, " s"], response: DetectorResponse) -> Subject:
    """The subject with `shared` changed by a step."""
    identity, person = step.split([len(subject.identity), len(subject.person)])
    bias = subject.bias + response.of_person(person)
    return replace(subject, identity=subject.identity + identity, person=subject.person + person, bias=bias)


def unknown_subject(model: LandmarkModel) -> Subject:
    """The subject before any fit: an average person."""
    response = model.response
    zeros = response.mean.new_zeros
    return Subject(zeros(len(model.identity_basis)), response.mean, person=zeros(len(response.by_person)))


@dataclass(frozen=True, eq=False)
class LandmarkTerm:
    """Landmark costs of the v timesteps of one sequence.

    The cost of a timestep is the sum of t w_l rho(|r_l|^2 / sigma^2) over its pictures and their landmarks, plus the
    prior's; t is the picture's trust. With rho(s) = c^2 s / (c^2 + s) (Geman and McClure) the pull of outliers fades.
    """

    model: LandmarkModel
    views: Views
    weights: Float[Tensor, " l"]
    """Weights of the landmarks. They sum to the number of independent points that a picture's landmarks are worth."""
    sigma: Float[Tensor, " c"]
    """Expected distance in each camera, in pixels."""
    outlier: float
    """The c of rho: beyond this many sigmas a landmark hardly counts."""

    def at(self, rows: Int[Tensor, " k"]) -> "LandmarkTerm":
        """The same term over some of the timesteps."""
        return replace(self, views=self.views.at(rows))

    def robust(
        self, residual: Float[Tensor, "n l 2"], pictures: Views
    ) -> tuple[Float[Tensor, " n"], Float[Tensor, "n l"]]:
        """Robust costs of pictures with these residuals, and the weight of each landmark's squared residual."""
        variance = self.sigma[pictures.camera][:, None] ** 2
        squared = (residual**2).sum(-1) / variance
        least = self.outlier**2
        weights = self.weights * pictures.trust[:, None]
        cost = (weights * least * squared / (least + squared)).sum(-1)
        return cost, weights * (least / (least + squared)) ** 2 / variance

    def _prior(self, state: Float[Tensor, "v p"]) -> tuple[Float[Tensor, " v"], Float[Tensor, "v p"]]:
        pull = state @ self.model.layout.precision
        return (state * pull).sum(-1), pull

    def _batches(self, size: int, cameras: CameraBatch) -> Iterator[tuple[Views, Tensor, CameraBatch, Tensor]]:
        """Yield at most `size` pictures at a time, their timesteps (posed once), and the camera and place of each."""
        for start in range(0, len(self.views.row), size):
            pictures = self.views.some(slice(start, start + size))
            rows, place = pictures.row.unique(return_inverse=True)
            yield pictures, rows, cameras[pictures.camera], place

    def _offsets(
        self, state: Float[Tensor, "v p"], subject: Subject, cameras: CameraBatch
    ) -> Iterator[tuple[Float[Tensor, "m l 2"], Views]]:
        """Yield the offsets from detected to projected landmarks, and their pictures."""

        def offsets(part: tuple[Views, Tensor, CameraBatch, Tensor]) -> tuple[Tensor, Views]:
            pictures, rows, batch, place = part
            projected = self.model.project(state[rows], subject.identity, subject.bias, batch, place)
            return projected - pictures.detected, pictures

        return stream_in_threads(offsets, self._batches(PROJECTED, cameras))

    def cost(self, state: Float[Tensor, "v p"], subject: Subject, cameras: CameraBatch) -> Float[Tensor, " v"]:
        """The cost of each timestep."""
        of_pictures = torch.cat([self.robust(*part)[0] for part in self._offsets(state, subject, cameras)])
        return self._prior(state)[0].index_add(0, self.views.row, of_pictures)

    def residuals(self, state: Float[Tensor, "v p"], subject: Subject, cameras: CameraBatch) -> Float[Tensor, "n l"]:
        """Distances between detected and projected landmarks in each picture, in pixels."""
        return torch.cat([offsets.norm(dim=-1) for offsets, _ in self._offsets(state, subject, cameras)])

    def linearized(
        self,
        use: "Callable[[WeightedLinearization], Result]",
        state: Float[Tensor, "v p"],
        subject: Subject,
        cameras: CameraBatch,
        with_identity: bool = False,
    ) -> Iterator[Result]:
        """Yield what `use` makes of linearisations of all pictures, a bounded number at a time, each in a thread."""

        def used(part: tuple[Views, Tensor, CameraBatch, Tensor]) -> Result:
            pictures, rows, batch, place = part
            at = self.model.linearize(state[rows], subject.identity, subject.bias, batch, place, with_identity)
            residual = at.pixels - pictures.detected
            return use(WeightedLinearization(at, pictures.row, residual, *self.robust(residual, pictures)))

        return stream_in_threads(used, self._batches(LINEARIZED, cameras))

    def equations(
        self,
        state: Float[Tensor, "v p"],
        subject: Subject,
        cameras: CameraBatch,
        shared: SharedEquations | None = None,
    ) -> NormalEquations:
        """The normal equations of each timestep on its own. Those of shared parameters are added to `shared`."""
        cost, pull = self._prior(state)
        equations = NormalEquations(cost, pull, self.model.layout.precision.repeat(len(state), 1, 1))

        def blocks(part: WeightedLinearization) -> tuple[Tensor, NormalEquations, SharedEquations | None]:
            return part.row, part.equations(), None if shared is None else part.shared_equations()

        for row, own, across in self.linearized(blocks, state, subject, cameras, with_identity=shared is not None):
            equations.cost.index_add_(0, row, own.cost)
            equations.gradient.index_add_(0, row, own.gradient)
            equations.hessian.index_add_(0, row, own.hessian)
            if shared is not None and across is not None:
                shared.across.index_add_(0, row, across.across)
                shared.hessian.add_(across.hessian)
                shared.gradient.add_(across.gradient)
        return equations

    def joint_equations(
        self, state: Float[Tensor, "v p"], subject: Subject, cameras: CameraBatch
    ) -> tuple[NormalEquations, SharedEquations]:
        """The equations of timesteps and of the shared parameters: `Subject.shared`, logarithm of the focal length."""
        size = len(subject.shared) + 1
        empty = state.new_zeros(*state.shape, size), state.new_zeros(size, size), state.new_zeros(size)
        shared = SharedEquations(*empty)
        return self.equations(state, subject, cameras, shared), shared


@dataclass(frozen=True, eq=False)
class WeightedLinearization:
    """A linearisation of n pictures with its residuals and their current robust weights."""

    at: Linearization
    row: Int[Tensor, " n"]
    """The timestep of each picture."""
    residual: Float[Tensor, "n l 2"]
    cost: Float[Tensor, " n"]
    weights: Float[Tensor, "n l"]

    def _weighted(self, derivative: Float[Tensor, "n l 2 s"]) -> Float[Tensor, "n m s"]:
        return (derivative * self.weights.sqrt()[:, :, None, None]).flatten(1, 2)

    def equations(self) -> NormalEquations:
        """Cost, half gradient and half Hessian of each picture by its timestep's own parameters."""
        jacobian = self._weighted(self.at.by_frame)
        gradient = jacobian.mT @ self._weighted(self.residual[..., None])
        return NormalEquations(self.cost, gradient[..., 0], jacobian.mT @ jacobian)

    def shared_equations(self) -> SharedEquations:
        """The blocks of the shared parameters, across those of each picture's timestep."""
        assert self.at.by_shared is not None
        shared = self._weighted(self.at.by_shared)
        own = self._weighted(self.at.by_frame)
        gradient = shared.mT @ self._weighted(self.residual[..., None])
        return SharedEquations(own.mT @ shared, (shared.mT @ shared).sum(0), gradient[..., 0].sum(0))

    def bias_equations(self) -> tuple[Float[Tensor, "l 3 3"], Float[Tensor, "l 3"]]:
        """Half Hessian and half gradient of every landmark's bias."""
        weighted = self.at.by_bias * self.weights[:, :, None, None]
        hessian = torch.einsum("nlxc,nlxd->lcd", weighted, self.at.by_bias)
        return hessian, torch.einsum("nlxc,nlx->lc", weighted, self.residual)


def landmark_term(
    model: LandmarkModel,
    views: Views,
    weights: Float[Tensor, " l"],
    state: Float[Tensor, "v p"],
    cameras: CameraBatch,
) -> LandmarkTerm:
    """The landmark cost, with the expected error turned from metres into pixels at the median depth in each camera."""
    towards, origin = cameras.viewmat[:, 2, :3], cameras.viewmat[:, 2, 3]
    depth = (state[views.row, 3:6] * towards[views.camera]).sum(-1) + origin[views.camera]
    sigma = torch.ones_like(origin)
    for camera in views.camera.unique():
        middle = depth[views.camera == camera].median()
        sigma[camera] = LANDMARK_SIGMA * cameras.K[camera, 0, 0] / middle
    weights = weights * (INDEPENDENT_LANDMARKS / weights.sum())
    return LandmarkTerm(model, views, weights, sigma, _OUTLIER)


def all_landmarks(model: LandmarkModel, views: Views, own: SequenceFit, settings: TrackingSettings) -> LandmarkTerm:
    """The cost of all landmarks at the depth of a fit. Its head poses determine the trust in each picture."""
    views = replace(views, trust=trust_of(views, own.state, own.cameras))
    return landmark_term(model, views, landmark_weights(settings.landmark_set), own.state, own.cameras)


def quiet_landmarks(term: LandmarkTerm) -> LandmarkTerm:
    """The term with 0.3 of its weight, but all of it for lips, lids and irises: no texture shows two mouths."""
    kept = torch.full_like(term.weights, 0.3)
    kept[list(LIPS + LEFT_EYELIDS + RIGHT_EYELIDS + LEFT_IRIS + RIGHT_IRIS)] = 1
    return replace(term, weights=term.weights * kept)


def trust_of(views: Views, state: Float[Tensor, "v p"], cameras: CameraBatch) -> Float[Tensor, " n"]:
    """Weight of each picture's landmarks, 0..1. It is 1 for the most frontal picture of each timestep.

    From the side, a detector guesses the far half of the face, and its landmarks of the near half change with the view.
    A single camera is fully trusted, because the effect of turns was measured for that case (`DetectorResponse`).
    """
    ahead = matrix_from_axis_angle(state[:, :3])[views.row, :, 2]
    sight = cameras.centers[views.camera] - state[views.row, 3:6]
    angle = ((ahead * sight).sum(-1) / sight.norm(dim=-1)).clamp(-1, 1).acos()
    trust = 1 / (1 + (angle / _SIDEWAYS_ANGLE) ** 4)
    best = torch.zeros_like(state[:, 0]).scatter_reduce(0, views.row, trust, "amax")
    return trust / best[views.row]
