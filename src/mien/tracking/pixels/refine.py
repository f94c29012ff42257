"""The photometric stage: it moves faces that were tracked from landmarks until one texture fits all pictures."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mien.machine.parallel import map_in_threads
from mien.machine.progress import say
from mien.tracking.fitting.fit import Fit, Progress, SequenceFit, Subject, show_progress
from mien.tracking.fitting.resume import StageCache
from mien.tracking.fitting.sequence import SequenceData
from mien.tracking.fitting.solver import NormalEquations, Smoothness, solve_chain
from mien.tracking.landmarks.problem import Problem
from mien.tracking.landmarks.shared_fit import fit_bias
from mien.tracking.landmarks.term import LandmarkTerm, quiet_landmarks
from mien.tracking.pixels.eyelids import place_lids
from mien.tracking.pixels.outline import OutlineTerm, outline_term
from mien.tracking.pixels.pictures import Pictures
from mien.tracking.pixels.shared import step_shared
from mien.tracking.pixels.surface import SurfaceModel, surface_model
from mien.tracking.pixels.term import PhotometricTerm
from mien.tracking.pixels.texture import (
    LIGHT_EXTENT,
    PhotometricFit,
    SurfaceView,
    TextureSpace,
    estimate_appearance,
    photometric_fit_of,
    texture_space,
)

_FRAME_DAMPING = 1e-3  # damping of a frame's step, as a share of the diagonal
_WORSE = 1.02  # a step of a frame is undone if it multiplies the frame's cost by this factor or more
_SHARED_STEPS_OF_CAMERAS = 8
"""Steps of identity in each iteration with several cameras. They see depth, so the shape keeps improving for longer."""
_LEAST_KEYFRAMES = 3
"""Fewest keyframes for any number of cameras, because the mouth must be seen open and closed. Measured: with 16
cameras, 3 are as good as 24 (log, "Several cameras in the fit")."""
_INDEPENDENT_PIXELS = 100.0
"""Number of independent pixels that all pixels of a picture are worth in the steps of identity and focal length,
because their errors are correlated. It weighs them against landmarks and priors."""
_INDEPENDENT_PIXELS_OF_FRAMES = 50.0
"""The same for the steps of frames. If it is much larger, errors of texture, light and shape become expressions, most
of which follow the head's turns. If it is much smaller, only landmarks determine the shape."""
_REFERENCE_ANGLE = 0.12
"""Head rotation from the median pose, in radians, within which frames decide the texture; others hardly count. With
equal weights every pose would keep its own error, because the texture would reproduce it wherever only such frames see
the skin. With several cameras all frames count alike, because each pose is seen from many sides."""
_LEAST_SHARE = 0.03  # least weight of a frame in the texture, however far from the middle pose

FRAMES_AT_ONCE = 256
"""Number of timesteps whose equations are stored as one piece: a few seconds of work, about 10 MB."""
_SHARED_COST, _APPEARANCE_COST, _LIDS_PART = 100, 40, 4
"""Costs for the progress bar. The first two are the durations of a step of identity and an estimate of the
appearance, in timesteps of a step of all frames. The third is how many times longer such a step takes than the lids."""


@dataclass(frozen=True, eq=False)
class _PixelProblem:
    """A problem with what the fit to pixels adds to it, for pictures of one size."""

    problem: Problem
    model: SurfaceModel
    space: TextureSpace
    landmarks: Sequence[LandmarkTerm]
    outlines: Sequence[OutlineTerm]
    focals: Float[Tensor, " q"]
    """The focal length of each sequence from the fit to landmarks, in pixels."""
    size: int

    def pictures(self, data: SequenceData) -> Pictures:
        """The pictures of a sequence at this size."""
        return Pictures(data.capture, max(round(min(data.capture.width, data.capture.height) / self.size), 1))

    def light_radius(self, data: SequenceData, sequence: SequenceFit) -> int:
        """Radius in pixels over which a smooth difference counts as light."""
        cameras = sequence.cameras
        depth = (sequence.state[:, 3:6] @ cameras.viewmat[0, 2, :3] + cameras.viewmat[0, 2, 3]).median()
        extent = LIGHT_EXTENT * float(cameras.K[0, 0, 0] / depth)
        return max(round(extent / self.pictures(data).shrink), 2)

    def terms(self, at: PhotometricFit, independent_pixels: float) -> list[PhotometricTerm]:
        """The cost of every sequence. All pixels of a picture are worth `independent_pixels` independent ones."""
        surface = self.space.native(at.texture, self.problem.settings.photometric.outlier)
        return [
            PhotometricTerm(
                self.model, marks, self.pictures(data), data.timesteps, surface, light, self.light_radius(data, own),
                independent_pixels, at.texture.sigma,
            )
            for (data, own), marks, light in zip(self.problem.pairs(at.fit), self.landmarks, at.lights, strict=True)
        ]  # fmt: skip

    def update_appearance(self, at: PhotometricFit) -> PhotometricFit:
        """Estimate texture and light again, from the present positions of the faces."""
        identity, pairs = at.fit.subject.identity, self.problem.pairs(at.fit)
        views = [self._views(*pair, identity, light) for pair, light in zip(pairs, at.lights, strict=True)]
        radius = self.light_radius(self.problem.data[0], at.fit.sequences[0])
        outlier = self.problem.settings.photometric.outlier
        texture, lights = estimate_appearance(self.space, views, at.texture, outlier, radius)
        return replace(at, texture=texture, lights=tuple(lights))

    def step_shared(self, at: PhotometricFit) -> PhotometricFit:
        """Estimate texture and light again, then take one step of identity and unknown focal lengths."""
        at, settings = self.update_appearance(at), self.problem.settings.photometric
        most = 2 * settings.keyframes // max(data.capture.valid.shape[1] for data in self.problem.data)
        keyframes = min(settings.keyframes, max(most, _LEAST_KEYFRAMES))
        terms = self.terms(at, _INDEPENDENT_PIXELS)
        moved = step_shared(self.problem, terms, self.outlines, at.fit, self.focals, keyframes)
        return replace(at, fit=fit_bias(self.landmarks, moved))

    def _views(
        self, data: SequenceData, sequence: SequenceFit, identity: Float[Tensor, " i"], light: Float[Tensor, "9 3"]
    ) -> list[SurfaceView]:
        """The pictures of a sequence that the texture is estimated from."""
        pictures, state, cameras = self.pictures(data), sequence.state, sequence.cameras
        away = (state[:, :3] - state[:, :3].median(0).values).norm(dim=1) / _REFERENCE_ANGLE
        shares = 1 / (1 + away**4) + _LEAST_SHARE if len(cameras) == 1 else torch.ones_like(away)

        def of_row(row: int) -> list[SurfaceView]:
            posed = self.model.pose(state[row], identity, derive=False)
            timestep, share = int(data.timesteps[row]), float(shares[row])
            return [
                SurfaceView(posed, pictures.picture(timestep, camera, cameras), light, share)
                for camera in data.views.seen_by(row)
            ]

        count = min(48, len(state))  # frames of each sequence that the texture is estimated from
        rows = torch.linspace(0, len(state) - 1, count).round().long().unique().tolist()
        return [view for several in map_in_threads(of_row, rows) for view in several]

    def residuals(self, at: PhotometricFit) -> PhotometricFit:
        """The fit with the residuals of the frames that were improved."""
        terms = self.terms(at, _INDEPENDENT_PIXELS_OF_FRAMES)
        residuals = [
            term.residuals(sequence.state, at.fit.subject, sequence.cameras).where(improved[:, None], torch.nan)
            for term, sequence, improved in zip(terms, at.fit.sequences, at.improved, strict=True)
        ]
        return replace(at, residuals=tuple(residuals))


def refine_photometrically(problem: Problem, start: PhotometricFit, known_person: bool = False) -> PhotometricFit:
    """Refine a fit until the pictures agree with one texture that they all share.

    Each iteration fits identity and unknown focal lengths to keyframes (from the second one on), then the albedo by
    robust least squares per texel in turn with the light (spherical harmonics), then takes one Gauss-Newton step of all
    timesteps of each sequence under their smoothness cost. Landmarks stay in the cost with less weight; irises, lids
    and lips need them. At the end the lids are placed from the pictures (`place_lids`). The result is deterministic.

    If the person is known, only the motion is refined: subject, cameras, texture and light of `start` stay.
    """
    settings, at, frames = problem.settings.photometric, start, problem.frames
    several = any(len(sequence.cameras) > 1 for sequence in start.fit.sequences)
    shared_steps = _SHARED_STEPS_OF_CAMERAS if several else settings.shared_steps
    iterations = _pixel_problems(problem, start.fit)
    total = len(iterations) * frames + frames // _LIDS_PART
    if not known_person:
        total += len(iterations) * _APPEARANCE_COST + (len(iterations) - 1) * shared_steps * _SHARED_COST
    title = "Fitting held-out sequences to pixels" if known_person else "Fitting to pixels"
    with show_progress(title, "pixels", total, problem.callback) as progress:
        keep = partial(_keep, problem, progress)
        for number, now in enumerate(iterations):
            name, status = f"iteration-{number}", f"iteration {number + 1} of {len(iterations)}"
            for step in range(0 if known_person or number == 0 else shared_steps):
                at = keep(f"{name}-shared-{step}", f"{status}, identity", partial(now.step_shared, at))
                progress.advance(_SHARED_COST, f"{status}, identity")
            if not known_person:
                at = keep(f"{name}-appearance", f"{status}, texture and light", partial(now.update_appearance, at))
                progress.advance(_APPEARANCE_COST, f"{status}, texture and light")
                if not (at.texture.trust > 0).any():
                    model = problem.model.face_model.name
                    say(f"{model}: the pictures show no part of its texture, so the fit to landmarks is kept")
                    return replace(at, fit=start.fit)
            advance = partial(progress.advance, status=f"{status}, frames")
            at = keep(name, status, partial(_step_frames, now, at, f"step-{number}", advance))
            problem.cache.drop(f"step-{number}")
        place = partial(place_lids, problem.model, problem.data, at.fit, settings.lids)
        at = keep("lids", "lids", lambda: replace(at, fit=place()))
        progress.advance(frames // _LIDS_PART, "lids")
    return iterations[0].residuals(at if known_person else iterations[0].update_appearance(at))


def _keep(
    problem: Problem, progress: Progress, name: str, status: str, compute: Callable[[], PhotometricFit]
) -> PhotometricFit:
    """Return the cached fit of that name, or compute it, and show it."""
    fit = photometric_fit_of(problem.cache.get_or_compute(name, lambda: compute().tensors()))
    progress.show(status, lambda: fit)
    return fit


def _pixel_problems(problem: Problem, fit: Fit) -> list[_PixelProblem]:
    """The problem of each iteration."""
    settings = problem.settings.photometric
    landmarks = [quiet_landmarks(term) for term in problem.landmark_terms(fit)]
    surface = surface_model(problem.model.face_model, problem.model.layout)
    space = texture_space(surface.face_model, settings.texture_size)
    focals = torch.stack([sequence.cameras.K[0, 0, 0] for sequence in fit.sequences])
    outlines = [
        outline_term(
            surface, data.capture, data.timesteps, data.views,
            settings.outline_weight if len(data.cameras) == 1 else 0.0,  # Several cameras see depth without it.
        )
        for data in problem.data
    ]  # fmt: skip
    return [_PixelProblem(problem, surface, space, landmarks, outlines, focals, size) for size in settings.sizes]


def _step_frames(now: _PixelProblem, at: PhotometricFit, name: str, advance: Callable[[int], None]) -> PhotometricFit:
    """Take one step of all timesteps of every sequence. Its pieces are kept under names that begin with `name`."""
    sequences, improved, problem = [], [], now.problem
    terms = now.terms(at, _INDEPENDENT_PIXELS_OF_FRAMES)
    parts = zip(terms, at.fit.sequences, problem.smoothness(at.fit), at.improved, strict=True)
    for number, (term, sequence, smoothness, before) in enumerate(parts):
        pieces = f"{name}-{number}-equations"
        equations = _equations(term, at.fit.subject, sequence, problem.cache, pieces, advance)
        state, better = _step(term, at.fit.subject, sequence, equations, smoothness)
        sequences.append(replace(sequence, state=state))
        improved.append(before | better)
    return replace(at, fit=replace(at.fit, sequences=tuple(sequences)), improved=tuple(improved))


def _equations(
    term: PhotometricTerm,
    subject: Subject,
    sequence: SequenceFit,
    cache: StageCache,
    name: str,
    advance: Callable[[int], None],
) -> NormalEquations:
    """The equations of all timesteps, computed in pieces, of which the whole is the only copy in memory."""

    def computed(rows: Int[Tensor, " k"]) -> dict[str, Tensor]:
        return vars(term.equations(sequence.state, rows, subject, sequence.cameras))

    v, p = sequence.state.shape
    whole = {key: sequence.state.new_empty(shape) for key, shape in
             (("cost", (v,)), ("gradient", (v, p)), ("hessian", (v, p, p)))}  # fmt: skip
    for index, rows in enumerate(torch.arange(v).split(FRAMES_AT_ONCE)):
        for key, part in cache.get_or_compute(f"{name}-{index}", partial(computed, rows)).items():
            whole[key][rows] = part
        advance(len(rows))
    return NormalEquations(**whole)


def _step(
    term: PhotometricTerm, subject: Subject, sequence: SequenceFit, equations: NormalEquations, smoothness: Smoothness
) -> tuple[Float[Tensor, "v p"], Bool[Tensor, " v"]]:
    """Move all timesteps by one Gauss-Newton step, except those that it makes worse; also returns which ones moved."""
    bounds, state = term.layout.bounds, sequence.state
    damping = torch.diag_embed(_FRAME_DAMPING * equations.hessian.diagonal(dim1=1, dim2=2))
    held = bounds.held(state, equations.gradient + smoothness.gradient(state))
    damped = replace(equations, hessian=equations.hessian + damping)
    candidate = bounds.clip(state + solve_chain(damped, smoothness, state, held))
    better = term.costs(candidate, subject, sequence.cameras) < _WORSE * equations.cost
    return torch.where(better[:, None], candidate, state), better
