"""Track captures: all stages in their order. All sequences of a subject share the subject's parameters."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import torch

from mien.capture.capture import Capture
from mien.capture.person.backend import detector_of
from mien.disk.reading import remove_tree
from mien.errors import UserError
from mien.face.loading import head_only
from mien.face.model import FaceModel
from mien.face.torso import has_torso
from mien.machine.progress import say
from mien.tracking.descent.fit import fit_by_descent
from mien.tracking.fitting.parameters import layout_of
from mien.tracking.fitting.resume import StageCache
from mien.tracking.fitting.sequence import SequenceData, explaining_singular, sequence_data
from mien.tracking.landmarks.detector_response import OFFSET_SIGMA, read_response
from mien.tracking.landmarks.model import LandmarkModel, reduce_face_model
from mien.tracking.landmarks.outcome import as_tracking, without_turn_habits
from mien.tracking.landmarks.problem import Problem, lenses_of
from mien.tracking.landmarks.stages import fit_landmarks
from mien.tracking.pipeline.held_out import StageFits, follow_held_out
from mien.tracking.pipeline.torso import place_torsos
from mien.tracking.pixels.outcome import with_pixels
from mien.tracking.pixels.refine import refine_photometrically
from mien.tracking.pixels.texture import even_light, photometric_start, unknown_texture
from mien.tracking.report.preview import DONE, Preview
from mien.tracking.settings import TrackingSettings
from mien.tracking.tracking import Tracking

DEFAULTS = TrackingSettings()


def track(capture: Capture, face_model: FaceModel, settings: TrackingSettings = DEFAULTS) -> Tracking:
    """Fit a face model to one capture: `track_subject` of a single sequence."""
    return track_subject([capture], face_model, settings)[0]


def track_subject(
    captures: Sequence[Capture],
    face_model: FaceModel,
    settings: TrackingSettings = DEFAULTS,
    keep: Path | None = None,
    preview: Path | None = None,
    held_out: Sequence[Capture] = (),
) -> list[Tracking]:
    """Fit a face model to all sequences of one person, with one identity. Those of `held_out` are the last of the list.

    The stages are: the head pose of every timestep alone; identity (and unknown focal lengths) from keyframes of all
    sequences; every timestep alone; all timesteps of each sequence together, smooth over time; then, unless the
    schedule is `landmarks`, the fit to pixels (`refine_photometrically`, `fit_by_descent`). It is deterministic.

    Sequences may differ in size, frame rate and number of cameras. Several cameras must be calibrated
    (`Capture.calibration`). They stay as they are and give the metric scale, and a camera that found no face at a
    timestep adds nothing to it. With one uncalibrated camera, the metric scale comes from the identity prior.

    Held-out sequences have no part in identity, offsets of landmarks and vertices, texture, light and focal length. The
    result for `captures` has the same bytes as without them. Then only their motion is fitted (`follow_held_out`).

    A face model with a torso is tracked by the head-only model that has its head, to the same bytes. Torsos are placed
    afterwards (`place_torsos`).

    Args:
        captures: The sequences of one person.
        face_model: The face model.
        settings: The settings.
        keep: A folder of its own for finished pieces, which is removed at the end. Interrupted tracking of the same
            captures with the same settings resumes from it and gives the same numbers. If its pieces do not fit,
            tracking starts again.
        preview: An .html file that shows the state of the fit. It is written again every few seconds.
        held_out: Further sequences of the person, which are tracked apart.
    """
    assert captures, "nothing to track"
    settings.check()
    if has_torso(face_model):
        head = head_only(face_model)
        trackings = track_subject(captures, head, settings, keep, preview, held_out)
        return place_torsos(face_model, head, [*captures, *held_out], trackings, len(captures))
    begun = keep is not None and keep.is_dir()
    try:
        return track_once(captures, face_model, settings, keep, preview, held_out)
    except (LookupError, TypeError, ValueError, AttributeError, RuntimeError, AssertionError, cv2.error):
        if keep is None or not begun:
            raise
    say("The stored pieces of an interrupted tracking cannot be used, so tracking starts again")
    remove_tree(keep)
    return track_once(captures, face_model, settings, keep, preview, held_out)


def track_once(
    captures: Sequence[Capture],
    face_model: FaceModel,
    settings: TrackingSettings,
    keep: Path | None,
    preview: Path | None,
    held_out: Sequence[Capture],
) -> list[Tracking]:
    """Track as `track_subject` does, but without a second try if stored pieces cannot be used."""
    if "mediapipe" not in face_model.landmarks:
        raise UserError(f"face model {face_model.name!r}: has no MediaPipe landmarks; place them on it first")
    data, cache = [sequence_data(capture, settings) for capture in captures], StageCache(keep)
    apart = [sequence_data(capture, settings) for capture in held_out]
    with torch.no_grad():
        model = _landmark_model(face_model, data)
        problem = Problem(model, data, lenses_of(captures, settings), settings, cache)
        problem = replace(problem, callback=preview and Preview(preview, face_model, problem))
        fits = _fit(problem)
        trackings = _trackings(face_model, replace(problem, callback=None) if apart else problem, fits)
        if apart:
            model = _landmark_model(face_model, [*data, *apart])
            pieces = StageCache(None if keep is None else keep / "held_out", resumed=cache.resumed)
            motion = Problem(model, apart, [None] * len(apart), settings, pieces)
            motion = replace(motion, callback=preview and Preview(preview, face_model, motion))
            trackings += _trackings(face_model, motion, follow_held_out(motion, data, fits))
    cache.forget()
    return trackings


def _landmark_model(face_model: FaceModel, sequences: Sequence[SequenceData]) -> LandmarkModel:
    """The face model's landmarks as the detector sees them."""
    # Sequences of one subject are captured alike. If they are not, the first decides.
    response = read_response(face_model, OFFSET_SIGMA, detector_of(sequences[0].capture.source))
    if any(len(data.cameras) > 1 for data in sequences):
        # The response to turns was measured for one camera. With several cameras no one of them defines the turn.
        response = response.without_turns()
    return reduce_face_model(face_model, layout_of(face_model), response)


def _fit(problem: Problem) -> StageFits:
    """Run the stages of the schedule."""
    settings = problem.settings
    with explaining_singular(problem.data):
        landmarks = fit_landmarks(problem)
    pixels, descent = None, None
    if settings.schedule != "landmarks" and not settings.published:
        texture, lights = unknown_texture(settings.photometric.texture_size), [even_light() for _ in problem.data]
        pixels = refine_photometrically(problem, photometric_start(landmarks, texture, lights))
    if settings.schedule == "paper":
        descent = fit_by_descent(problem, landmarks if pixels is None else pixels.fit, pixels)
    return StageFits(landmarks, pixels, descent)


def _trackings(face_model: FaceModel, problem: Problem, fits: StageFits) -> list[Tracking]:
    """The results as trackings, after the last correction. The callback receives the end."""
    parts = zip(problem.landmark_terms(fits.fit), fits.fit.sequences, strict=True)
    calm = [without_turn_habits(term, fits.fit.subject, sequence) for term, sequence in parts]
    fit = replace(fits.fit, sequences=tuple(calm))
    refined = None if fits.refined is None else replace(fits.refined, fit=fit)
    if problem.callback is not None:
        problem.callback(DONE, 1.0, lambda: refined or fit)
    trackings = [as_tracking(problem, face_model, data, fit.subject, own) for data, own in problem.pairs(fit)]
    if refined is not None and (refined.texture.trust > 0).any():
        trackings = with_pixels(trackings, problem.data, refined, face_model)
    return trackings
