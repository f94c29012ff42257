"""The photometric stage: it moves faces that were tracked from landmarks until one texture fits all pictures."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mien.machine.parallel import map_in_threads
from mien.machine.progress import progress_bar, say
from mien.tracking.eyelids.placing import place_lids
from mien.tracking.fitting.fit import Course, Fit, SequenceFit, Subject, Watch, smoothness_of
from mien.tracking.fitting.resume import StageCache
from mien.tracking.fitting.shot import Shot
from mien.tracking.fitting.solver import NormalEquations, Smoothness, solve_chain
from mien.tracking.landmarks.model import LandmarkModel
from mien.tracking.landmarks.shared_fit import fit_bias
from mien.tracking.landmarks.term import LandmarkTerm, all_landmarks, quiet_landmarks
from mien.tracking.pixels.outline import OutlineTerm, outline_term
from mien.tracking.pixels.pictures import Pictures
from mien.tracking.pixels.shared import SharedPrior, step_shared
from mien.tracking.pixels.surface import SurfaceModel, surface_model
from mien.tracking.pixels.term import PhotometricTerm
from mien.tracking.pixels.texture import (
    PhotometricFit,
    Sighting,
    TextureSpace,
    estimate_appearance,
    even_light,
    photometric_fit_of,
    texture_space,
    unknown_texture,
)
from mien.tracking.settings import PhotometricSettings, TrackingSettings

_FRAME_DAMPING = 1e-3  # damping of a frame's step, as a share of the diagonal
_WORSE = 1.02  # a step of a frame is undone if it multiplies the frame's cost by this factor or more
_LEAST_KEYFRAMES = 3
"""Fewest keyframes for any number of cameras, because the mouth must be seen open and closed. Measured: with 16
cameras, 3 are as good as 24 (log, "Several cameras in the fit")."""
_LEAST_SHARE = 0.03  # least weight of a frame in the texture, however far from the middle pose

FRAMES_AT_ONCE = 256
"""Number of timesteps whose equations are stored as one piece: a few seconds of work, about 10 MB."""
_SHARED_COST, _APPEARANCE_COST, _LIDS_PART = 100, 40, 4
"""Costs for the progress bar. The first two are the durations of a step of identity and an estimate of the
appearance, in timesteps of a step of all frames. The third is how many times longer such a step takes than the lids."""


@dataclass(frozen=True, eq=False)
class _Round:
    """Data and settings that all steps of one round share."""

    model: SurfaceModel
    space: TextureSpace
    shots: Sequence[Shot]
    landmarks: Sequence[LandmarkTerm]
    outlines: Sequence[OutlineTerm]
    prior: SharedPrior
    settings: PhotometricSettings
    size: int

    @property
    def keyframes(self) -> int:
        """Number of keyframes of each sequence for the steps of the shared parameters."""
        pictures = 2 * self.settings.keyframes // max(shot.capture.valid.shape[1] for shot in self.shots)
        return min(self.settings.keyframes, max(pictures, _LEAST_KEYFRAMES))

    def pictures(self, shot: Shot) -> Pictures:
        """The pictures of a sequence at this round's size."""
        return Pictures(shot.capture, max(round(min(shot.capture.width, shot.capture.height) / self.size), 1))

    def light_radius(self, shot: Shot, own: SequenceFit) -> int:
        """Radius in pixels over which a smooth difference counts as light."""
        cameras = own.cameras
        depth = (own.state[:, 3:6] @ cameras.viewmat[0, 2, :3] + cameras.viewmat[0, 2, 3]).median()
        extent = self.settings.light_extent * float(cameras.K[0, 0, 0] / depth)
        return max(round(extent / self.pictures(shot).shrink), 2)

    def terms(self, at: PhotometricFit, independent_pixels: float) -> list[PhotometricTerm]:
        """The cost of every sequence. All pixels of a picture are worth `independent_pixels` independent ones."""
        surface = self.space.native(at.texture, self.settings.outlier)
        return [
            PhotometricTerm(
                self.model, marks, self.pictures(shot), shot.valid.nonzero()[:, 0], surface, light,
                self.light_radius(shot, own), independent_pixels, at.texture.sigma,
            )
            for shot, marks, own, light in zip(self.shots, self.landmarks, at.fit.sequences, at.lights, strict=True)
        ]  # fmt: skip

    def update_appearance(self, at: PhotometricFit) -> PhotometricFit:
        """Estimate texture and light again, from the present positions of the faces."""
        sightings = [
            self._sightings(shot, marks, own, at.fit.subject.identity, light)
            for shot, marks, own, light in zip(self.shots, self.landmarks, at.fit.sequences, at.lights, strict=True)
        ]
        radius = self.light_radius(self.shots[0], at.fit.sequences[0])
        found, lights = estimate_appearance(self.space, sightings, at.texture, self.settings.outlier, radius)
        return replace(at, texture=found, lights=tuple(lights))

    def step_shared(self, at: PhotometricFit) -> PhotometricFit:
        """Estimate texture and light again, then take one step of identity and unknown focal lengths."""
        at = self.update_appearance(at)
        terms = self.terms(at, self.settings.independent_pixels)
        moved = step_shared(terms, self.outlines, at.fit, self.prior, self.keyframes)
        return replace(at, fit=fit_bias(self.landmarks, moved))

    def _sightings(
        self,
        shot: Shot,
        landmarks: LandmarkTerm,
        own: SequenceFit,
        identity: Float[Tensor, " i"],
        light: Float[Tensor, "9 3"],
    ) -> list[Sighting]:
        pictures, timesteps = self.pictures(shot), shot.valid.nonzero()[:, 0]
        middle = own.state[:, :3].median(0).values
        away = (own.state[:, :3] - middle).norm(dim=1) / self.settings.reference_angle
        shares = 1 / (1 + away**4) + _LEAST_SHARE if len(own.cameras) == 1 else torch.ones_like(away)

        def sight(row: int) -> list[Sighting]:
            posed = self.model.pose(own.state[row], identity, derive=False)
            cameras = landmarks.views.seen_by(row)
            return [
                Sighting(
                    posed, pictures.picture(int(timesteps[row]), camera, own.cameras), light, float(shares[row])
                )
                for camera in cameras
            ]  # fmt: skip

        count = min(self.settings.texture_frames, len(own.state))
        rows = torch.linspace(0, len(own.state) - 1, count).round().long().unique().tolist()
        return [sighting for several in map_in_threads(sight, rows) for sighting in several]


def refine_photometrically(
    model: LandmarkModel,
    shots: Sequence[Shot],
    lenses: Sequence[int | None],
    fit: Fit,
    settings: TrackingSettings,
    cache: StageCache,
    watch: Watch,
) -> PhotometricFit:
    """Refine a fit to landmarks until the pictures agree with one texture that they all share.

    Each round fits identity and unknown focal lengths to keyframes (from the second round on), then the albedo by
    robust least squares per texel in turn with the light (spherical harmonics), then takes one Gauss-Newton step of all
    timesteps of each sequence under their smoothness cost. Landmarks stay in the cost with less weight; irises, lids
    and lips need them. At the end the lids are placed from the pictures (`place_lids`). The result is deterministic.

    Args:
        model: The face model reduced to its landmarks.
        shots: The sequences.
        lenses: Index of each sequence's unknown focal length (`lenses_of`).
        fit: The fit to landmarks.
        settings: Settings of the whole tracking.
        cache: Keeps the pieces from which an interrupted fit of the same input resumes.
        watch: Receives the progress.
    """
    own_settings = settings.photometric
    rounds = _rounds(model, shots, lenses, fit, settings)
    at = PhotometricFit(
        fit, unknown_texture(rounds[0].space), tuple(even_light() for _ in shots),
        tuple(torch.zeros(len(own.state), dtype=torch.bool) for own in fit.sequences),
    )  # fmt: skip
    frames = sum(len(own.state) for own in fit.sequences)
    several = any(len(own.cameras) > 1 for own in fit.sequences)
    shared_steps = own_settings.shared_steps_of_cameras if several else own_settings.shared_steps
    total = len(rounds) * (_APPEARANCE_COST + frames) + (len(rounds) - 1) * shared_steps * _SHARED_COST
    total += frames // _LIDS_PART
    with progress_bar("Fitting to pixels", total=total) as bar:
        course = Course("pixels", total, bar, watch)
        keep = partial(_keep, cache, course)
        for number, now in enumerate(rounds):
            status = f"round {number + 1} of {len(rounds)}"
            for step in range(shared_steps if number > 0 else 0):
                at = keep(f"round-{number}-shared-{step}", f"{status}, identity", partial(now.step_shared, at))
                course.advance(_SHARED_COST, f"{status}, identity")
            # The name of this piece is that of earlier releases, whose pieces stay readable.
            at = keep(f"round-{number}-looks", f"{status}, texture and light", partial(now.update_appearance, at))
            course.advance(_APPEARANCE_COST, f"{status}, texture and light")
            if not (at.texture.trust > 0).any():
                name = model.face_model.name
                say(f"{name}: the pictures show no part of its texture, so the fit to landmarks is kept")
                return replace(at, fit=fit)
            at = _step_round(now, at, number, status, settings, cache, course)
        at = keep("lids", "lids", lambda: replace(at, fit=place_lids(model, shots, at.fit, own_settings.lids)))
        course.advance(frames // _LIDS_PART, "lids")
    return _with_residuals(rounds[0], rounds[0].update_appearance(at))


def follow_photometrically(
    model: LandmarkModel,
    shots: Sequence[Shot],
    start: PhotometricFit,
    settings: TrackingSettings,
    cache: StageCache,
    watch: Watch,
) -> PhotometricFit:
    """Refine only the motion of sequences by pixels. The subject, cameras, texture and light of `start` stay.

    Args:
        model: The face model reduced to its landmarks.
        shots: The sequences.
        start: Their fit to landmarks, with a texture that other sequences show, and the light of each sequence.
        settings: Settings of the whole tracking.
        cache: Keeps the pieces from which an interrupted fit of the same input resumes.
        watch: Receives the progress.
    """
    rounds = _rounds(model, shots, [None] * len(shots), start.fit, settings)
    frames, at = sum(len(own.state) for own in start.fit.sequences), start
    total = len(rounds) * frames + frames // _LIDS_PART
    with progress_bar("Fitting held-out sequences to pixels", total=total) as bar:
        course = Course("pixels", total, bar, watch)
        for number, now in enumerate(rounds):
            at = _step_round(now, at, number, f"round {number + 1} of {len(rounds)}", settings, cache, course)
        lids, before = settings.photometric.lids, at
        at = _keep(
            cache, course, "lids", "lids", lambda: replace(before, fit=place_lids(model, shots, before.fit, lids))
        )
        course.advance(frames // _LIDS_PART, "lids")
    return _with_residuals(rounds[0], at)


def _step_round(
    now: _Round,
    at: PhotometricFit,
    number: int,
    status: str,
    settings: TrackingSettings,
    cache: StageCache,
    course: Course,
) -> PhotometricFit:
    """Take the step of all timesteps that ends a round."""
    advance = partial(course.advance, status=f"{status}, frames")
    step_all = partial(_step_sequences, now, at, settings, cache, f"step-{number}", advance)
    at = _keep(cache, course, f"round-{number}", status, step_all)
    cache.drop(f"step-{number}")
    return at


def _keep(
    cache: StageCache, course: Course, name: str, status: str, compute: Callable[[], PhotometricFit]
) -> PhotometricFit:
    """Return the cached fit of that name, or compute it, and show it to the watch."""
    found = photometric_fit_of(cache.get_or_compute(name, lambda: compute().tensors()))
    course.show(status, lambda: found)
    return found


def _rounds(
    model: LandmarkModel,
    shots: Sequence[Shot],
    lenses: Sequence[int | None],
    fit: Fit,
    settings: TrackingSettings,
) -> list[_Round]:
    own_settings = settings.photometric
    landmarks = [
        quiet_landmarks(all_landmarks(model, shot.views, own, settings), own_settings.landmark_share)
        for shot, own in zip(shots, fit.sequences, strict=True)
    ]
    surface = surface_model(model.face_model, model.layout)
    space = texture_space(surface.face_model, own_settings.texture_size)
    focals = torch.stack([own.cameras.K[0, 0, 0] for own in fit.sequences])
    prior = SharedPrior(lenses, focals, own_settings.focal_sigma, settings.identity_weight)
    outlines = [
        outline_term(
            surface, shot.capture, shot.valid.nonzero()[:, 0], shot.views,
            own_settings.outline_weight if len(shot.cameras) == 1 else 0.0,  # Several cameras see depth without it.
        )
        for shot in shots
    ]  # fmt: skip
    return [
        _Round(surface, space, shots, landmarks, outlines, prior, own_settings, size) for size in own_settings.sizes
    ]


def _with_residuals(now: _Round, at: PhotometricFit) -> PhotometricFit:
    found = [
        term.residuals(own.state, at.fit.subject, own.cameras).where(improved[:, None], torch.nan)
        for term, own, improved in zip(
            now.terms(at, now.settings.independent_pixels_of_frames), at.fit.sequences, at.improved, strict=True
        )
    ]
    return replace(at, residuals=tuple(found))


def _step_sequences(
    now: _Round,
    at: PhotometricFit,
    settings: TrackingSettings,
    cache: StageCache,
    name: str,
    advance: Callable[[int], None],
) -> PhotometricFit:
    """Take one step of all timesteps of every sequence. Its pieces are kept under names that begin with `name`."""
    sequences, improved = [], []
    terms = now.terms(at, now.settings.independent_pixels_of_frames)
    parts = zip(terms, now.shots, at.fit.sequences, at.improved, strict=True)
    for number, (term, shot, own, before) in enumerate(parts):
        smoothness = smoothness_of(term.layout, shot.valid, shot.fps, settings.smoothness, own.cameras)
        state, better = _step(term, at.fit.subject, own, smoothness, cache, f"{name}-{number}", advance)
        sequences.append(replace(own, state=state))
        improved.append(before | better)
    return replace(at, fit=replace(at.fit, sequences=tuple(sequences)), improved=tuple(improved))


def _equations(
    term: PhotometricTerm,
    subject: Subject,
    own: SequenceFit,
    cache: StageCache,
    name: str,
    advance: Callable[[int], None],
) -> NormalEquations:
    """The equations of all timesteps, computed in pieces. Pieces that an interrupted fit has kept are read."""

    def made(rows: Int[Tensor, " k"]) -> dict[str, Tensor]:
        found = term.equations(own.state, rows, subject, own.cameras)
        return {"cost": found.cost, "gradient": found.gradient, "hessian": found.hessian}

    v, p = own.state.shape
    whole = {"cost": own.state.new_empty(v), "gradient": own.state.new_empty(v, p),
             "hessian": own.state.new_empty(v, p, p)}  # fmt: skip
    for index, rows in enumerate(torch.arange(v).split(FRAMES_AT_ONCE)):
        for key, part in cache.get_or_compute(f"{name}-equations-{index}", partial(made, rows)).items():
            whole[key][rows] = part
        advance(len(rows))
    return NormalEquations(**whole)


def _step(
    term: PhotometricTerm,
    subject: Subject,
    own: SequenceFit,
    smoothness: Smoothness,
    cache: StageCache,
    name: str,
    advance: Callable[[int], None],
) -> tuple[Float[Tensor, "v p"], Bool[Tensor, " v"]]:
    """Move all timesteps by one Gauss-Newton step, except those that it makes worse; also returns which ones moved."""
    bounds, state = term.layout.bounds, own.state
    equations = _equations(term, subject, own, cache, name, advance)
    damping = torch.diag_embed(_FRAME_DAMPING * equations.hessian.diagonal(dim1=1, dim2=2))
    held = bounds.held(state, equations.gradient + smoothness.gradient(state))
    damped = replace(equations, hessian=equations.hessian + damping)
    candidate = bounds.clip(state + solve_chain(damped, smoothness, state, held))
    better = term.costs(candidate, subject, own.cameras) < _WORSE * equations.cost
    return torch.where(better[:, None], candidate, state), better
