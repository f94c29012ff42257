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
from mien.tracking.stages import Fit, SequenceFit, box_of, choose_keyframes, fit_bias
from mien.tracking.photometric_term import PhotometricTerm
from mien.tracking.photometric_shared import step_shared


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
    reference_angle: float = 0.12
    shared_steps: int = 2
    keyframes: int = 24
    identity_weight: float = 4.0
    focal_sigma: float = 0.03
    independent_pixels: float = 300.0
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
    lenses,
    tracking_settings,
) -> PhotometricFit:
    model = surface_model(face_model, terms[0].model.layout)
    space = texture_space(model.face_model, settings.texture_size)
    sequences = []
    for shot, term, smooth in zip(shots, terms, smoothness, strict=True):
        quiet = replace(term, weights=term.weights * settings.landmark_share)
        sequences.append(_Sequence(shot, quiet, smooth))
    at = PhotometricFit(fit, None, tuple(even_light() for _ in shots), None)
    total = len(settings.shrinks) * settings.iterations
    first = fit
    with progress_bar("Fitting to pixels", total=total) as advance:
        for level, shrink in enumerate(settings.shrinks):
            if level > 0:
                for _ in range(settings.shared_steps):
                    at = _look(model, space, sequences, at, shrink, settings)
                    rows = [choose_keyframes(own.state[:, :6], settings.keyframes) for own in at.fit.sequences]
                    moved = step_shared(_terms(model, space, sequences, at, shrink, settings), rows, at.fit, first, lenses, settings.identity_weight, settings.focal_sigma, 1e-3)
                    quiet = [sequence.term for sequence in sequences]
                    at = replace(at, fit=fit_bias(quiet, moved, tracking_settings))
            at = _look(model, space, sequences, at, shrink, settings)
            terms_now = _terms(model, space, sequences, at, shrink, settings)
            parts = tuple(_refine_sequence(term, sequence.smoothness, at.fit.subject, own, settings, advance)
                     for term, sequence, own in zip(terms_now, sequences, at.fit.sequences, strict=True))
            at = replace(at, fit=replace(at.fit, sequences=parts))
    return at


def _terms(model, space, sequences, at, shrink, settings) -> list[PhotometricTerm]:
    surface = space.native(at.appearance, settings.outlier)
    return [PhotometricTerm(model, sequence.term, Pictures(sequence.shot.capture, shrink), sequence.timesteps, surface, light, at.offsets, high_pass(own, shrink, settings), settings.independent_pixels)
            for sequence, own, light in zip(sequences, at.fit.sequences, at.lights, strict=True)]


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

        middle = own.state[:, :3].median(0).values

        def sight(row: int) -> list[Sighting]:
            posed = model.pose(own.state[row], at.fit.subject.identity, at.offsets, derive=False)
            timestep = int(sequence.timesteps[row])
            away = (own.state[row, :3] - middle).norm() / settings.reference_angle
            share = float(1 / (1 + away**4) + 0.03)
            return [Sighting(posed, pictures.picture(timestep, camera, own.cameras), light, share)
                    for camera in sequence.views_of(row)]

        found = in_threads(sight, rows.tolist())
        sightings.append([one for several in found for one in several])
    appearance, lights = estimate_appearance(space, sightings, at.appearance, settings.outlier, high_pass(at.fit.sequences[0], shrink, settings))
    return replace(at, appearance=appearance, lights=tuple(lights))


def _refine_sequence(term, smoothness, subject, own, settings, advance) -> SequenceFit:
    box = box_of(term.layout)
    state = own.state
    at_state = term.equations(state, subject, own.cameras)
    damping = torch.full((len(state),), 1e-3).double()
    for _ in range(settings.iterations):
        diagonal = torch.diag_embed(at_state.hessian.diagonal(dim1=1, dim2=2) * damping[:, None])
        damped = replace(at_state, hessian=at_state.hessian + diagonal)
        held = box.held(state, at_state.gradient + smoothness.gradient(state))
        candidate = box.clip(state + solve_chain(damped, smoothness, state, held))
        at_candidate = term.equations(candidate, subject, own.cameras)
        worse = at_candidate.cost > at_state.cost * 1.02
        state = torch.where(worse[:, None], state, candidate)
        pick = lambda a, b: torch.where(worse.reshape(-1, *[1] * (a.ndim - 1)), a, b)
        at_state = NormalEquations(pick(at_state.cost, at_candidate.cost), pick(at_state.gradient, at_candidate.gradient), pick(at_state.hessian, at_candidate.hessian))
        damping = torch.where(worse, damping * 30, damping / 3)
        advance(status=f"1/{term.pictures.shrink}")
    return replace(own, state=state)
