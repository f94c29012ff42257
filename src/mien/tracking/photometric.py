"""The photometric stage: faces tracked from landmarks are moved until a texture common to all pictures fits each one."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mien import _native
from mien.face import FaceModel
from mien.progress import progress_bar
from mien.tracking.landmark_term import LandmarkTerm, Subject
from mien.tracking.photometric_pictures import Pictures
from mien.tracking.photometric_surface import SurfaceModel, surface_model
from mien.tracking.photometric_texture import (
    Appearance,
    Sighting,
    TextureSpace,
    estimate_appearance,
    even_light,
    texture_space,
)
from mien.tracking.photometric_threads import in_threads
from mien.tracking.shot import Shot
from mien.tracking.solver import NormalEquations, Smoothness, solve_chain
from mien.tracking.stages import Fit, SequenceFit, box_of


@dataclass(frozen=True)
class PhotometricSettings:
    """How faces are fitted to pixels."""

    texture_size: int = 512
    """Texels along each side."""
    shrinks: tuple[int, ...] = (2, 1, 1)
    """Levels from coarse to fine: pictures are shrunk by this; the texture is made anew at each."""
    iterations: int = 2
    """Gauss-Newton steps a level."""
    texture_frames: int = 48
    """Pictures of each sequence that make the texture."""
    independent_pixels: float = 1000.0
    """What all pixels of a picture are worth, whose errors go together: weighs them against landmarks and priors."""
    landmark_share: float = 0.3
    """Weight of landmarks, of that in the fit to landmarks alone."""
    light_extent: float = 0.012
    """metres"""
    outlier: float = 3.0
    """Beyond this many standard deviations of its colour a pixel's pull fades."""


@dataclass(frozen=True, eq=False)
class PhotometricFit:
    """A fit with what it found out about the subject's looks."""

    fit: Fit
    appearance: Appearance
    lights: tuple[Float[Tensor, "9 3"], ...]
    """Of each sequence."""
    offsets: Float[Tensor, "v 3"] | None
    """Static offsets of the subject's vertices."""


@dataclass(frozen=True, eq=False)
class _Sequence:
    shot: Shot
    term: LandmarkTerm
    smoothness: Smoothness

    @property
    def timesteps(self) -> Int[Tensor, " v"]:
        return self.shot.valid.nonzero()[:, 0]

    def views_of(self, row: int) -> list[int]:
        views = self.shot.views
        return views.camera[views.row == row].tolist()


def refine_photometrically(
    face_model: FaceModel,
    shots: Sequence[Shot],
    terms: Sequence[LandmarkTerm],
    smoothness: Sequence[Smoothness],
    fit: Fit,
    settings: PhotometricSettings,
) -> PhotometricFit:
    model = surface_model(face_model, terms[0].model.layout)
    space = texture_space(model.face_model, settings.texture_size)
    sequences = []
    for shot, term, smooth in zip(shots, terms, smoothness, strict=True):
        quiet = replace(term, weights=term.weights * settings.landmark_share)
        sequences.append(_Sequence(shot, quiet, smooth))
    at = PhotometricFit(fit, None, tuple(even_light() for _ in shots), None)
    total = len(settings.shrinks) * settings.iterations
    with progress_bar("Fitting to pixels", total=total) as advance:
        for shrink in settings.shrinks:
            at = _look(model, space, sequences, at, shrink, settings)
            for own, sequence in enumerate(sequences):
                refined = _refine_sequence(model, space, sequence, at, own, shrink, settings, advance)
                parts = list(at.fit.sequences)
                parts[own] = refined
                at = replace(at, fit=replace(at.fit, sequences=tuple(parts)))
    return at


def high_pass(own: SequenceFit, shrink: int, settings: PhotometricSettings) -> int:
    """Radius in pixels of a level of what counts as light."""
    if settings.light_extent <= 0: return 0
    camera = own.cameras
    depth = (own.state[:, 3:6] @ camera.viewmat[0, 2, :3] + camera.viewmat[0, 2, 3]).median()
    return max(int(settings.light_extent * float(camera.K[0, 0, 0] / depth) / shrink), 2)


def _look(model, space, sequences, at, shrink, settings) -> PhotometricFit:
    sightings = []
    for sequence, own, light in zip(sequences, at.fit.sequences, at.lights, strict=True):
        pictures = Pictures(sequence.shot.capture, shrink)
        rows = torch.linspace(0, len(own.state) - 1, min(settings.texture_frames, len(own.state))).round().long()

        def sight(row: int) -> list[Sighting]:
            posed = model.pose(own.state[row], at.fit.subject.identity, at.offsets, derive=False)
            timestep = int(sequence.timesteps[row])
            return [Sighting(posed, pictures.picture(timestep, camera, own.cameras), light)
                    for camera in sequence.views_of(row)]

        found = in_threads(sight, rows.tolist())
        sightings.append([one for several in found for one in several])
    appearance, lights = estimate_appearance(space, sightings, at.appearance, settings.outlier, high_pass(at.fit.sequences[0], shrink, settings))
    return replace(at, appearance=appearance, lights=tuple(lights))


def _refine_sequence(model, space, sequence, at, own, shrink, settings, advance) -> SequenceFit:
    surface = space.native(at.appearance, settings.outlier)
    pictures = Pictures(sequence.shot.capture, shrink)
    radius = high_pass(at.fit.sequences[own], shrink, settings)
    fit = at.fit.sequences[own]
    subject = at.fit.subject
    box = box_of(model.layout)

    def photometric(row_and_state) -> tuple[float, Tensor, Tensor]:
        row, state = row_and_state
        posed = model.pose(state, subject.identity, at.offsets)
        cost, gradient, hessian = 0.0, 0, 0
        for camera in sequence.views_of(row):
            sighting = Sighting(posed, pictures.picture(int(sequence.timesteps[row]), camera, fit.cameras), at.lights[own])
            p = len(state)
            h, g, gains = torch.empty(p, p), torch.empty(p), 0
            value, _ = _native.align_mesh(surface, *sighting.arguments(), radius, posed.jacobian, h, g, None, None)
            cost, gradient, hessian = cost + value, gradient + g.double(), hessian + h.double()
        n = settings.independent_pixels
        return n * cost, n * gradient, n * hessian

    def equations(state) -> NormalEquations:
        marks = sequence.term.equations(state, subject, fit.cameras)
        found = in_threads(photometric, list(enumerate(state)))
        photo_cost = torch.tensor([one[0] for one in found]).double()
        print("   photo %.1f marks %.2f"%(photo_cost.mean(), marks.cost.mean()), "smooth %.2f"%(sequence.smoothness.cost(state)/len(state)))
        return NormalEquations(marks.cost + photo_cost, marks.gradient + torch.stack([one[1] for one in found]),
                               marks.hessian + torch.stack([one[2] for one in found]))

    state = fit.state
    at_state = equations(state)
    damping = torch.full((len(state),), 1e-3).double()
    for _ in range(settings.iterations):
        diagonal = torch.diag_embed(at_state.hessian.diagonal(dim1=1, dim2=2) * damping[:, None])
        damped = replace(at_state, hessian=at_state.hessian + diagonal)
        held = box.held(state, at_state.gradient + sequence.smoothness.gradient(state))
        candidate = box.clip(state + solve_chain(damped, sequence.smoothness, state, held))
        at_candidate = equations(candidate)
        worse = at_candidate.cost > at_state.cost * 1.02
        print("   worse", int(worse.sum()))
        state = torch.where(worse[:, None], state, candidate)
        pick = lambda a, b: torch.where(worse.reshape(-1, *[1] * (a.ndim - 1)), a, b)
        at_state = NormalEquations(pick(at_state.cost, at_candidate.cost), pick(at_state.gradient, at_candidate.gradient), pick(at_state.hessian, at_candidate.hessian))
        damping = torch.where(worse, damping * 30, damping / 3)
        advance(status=f"1/{shrink}")
    return replace(fit, state=state)
