"""Track captures: all stages in their order. All sequences of a subject share the subject's parameters."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import torch

from mien.capture.capture import Capture
from mien.capture.person.backend import detector_of
from mien.disk.inside import remove_tree
from mien.errors import UserError
from mien.face.model import FaceModel
from mien.machine.progress import say
from mien.tracking.descent.schedule import fit_by_descent
from mien.tracking.fitting.fit import Fit, Watch, ignore_progress
from mien.tracking.fitting.parameters import layout_of
from mien.tracking.fitting.resume import StageCache
from mien.tracking.fitting.shot import Shot, explaining_singular, lenses_of, shot_of
from mien.tracking.held_out import Stages, follow_held_out
from mien.tracking.landmarks.detector_response import DetectorResponse, read_response
from mien.tracking.landmarks.model import LandmarkModel, reduce_face_model
from mien.tracking.landmarks.outcome import as_tracking
from mien.tracking.landmarks.stages import fit_landmarks
from mien.tracking.landmarks.term import all_landmarks
from mien.tracking.landmarks.turn_habits import without_turn_habits
from mien.tracking.pixels.outcome import with_pixels
from mien.tracking.pixels.refine import refine_photometrically
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
    """Fit a face model to landmarks and pixels of all sequences of one person, with one identity.

    The stages are: the head pose of every timestep alone; identity (and unknown focal lengths) from keyframes of all
    sequences; every timestep alone; all timesteps of each sequence together, smooth over time; then, unless the
    schedule is `landmarks`, the fit to pixels (`refine_photometrically`, `fit_by_descent`). The result is
    deterministic.

    Sequences may differ in size, frame rate and number of cameras. Several cameras must be calibrated
    (`Capture.calibration`). They stay as they are and give the metric scale, and a camera that found no face at a
    timestep adds nothing to it. With one uncalibrated camera, the metric scale comes from the identity prior.

    Held-out sequences have no part in identity, offsets of landmarks and vertices, texture, light and focal length. The
    result for `captures` has the same bytes as without them. Then only their motion is fitted (`follow_held_out`).

    Args:
        captures: The sequences of one person.
        face_model: The face model.
        settings: The settings.
        keep: A folder of its own for finished pieces, which is removed at the end. Interrupted tracking of the same
            captures with the same settings resumes from it and gives the same numbers. If its pieces do not fit,
            tracking starts again.
        preview: An .html file (with a .png beside it) that shows the state of the fit. It is written again every few
            seconds.
        held_out: Further sequences of the person, which are tracked apart.

    Returns:
        The trackings of `captures`, then those of `held_out`.

    Raises:
        UserError: A capture has several cameras without calibration, too few timesteps with a face, or landmarks that
            no face could have; or the model lacks the landmarks.
    """
    assert captures, "nothing to track"
    settings.check()
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
    shots, cache = [shot_of(capture, settings) for capture in captures], StageCache(keep)
    others = [shot_of(capture, settings) for capture in held_out]
    with torch.no_grad():
        layout = layout_of(face_model)
        model = reduce_face_model(face_model, layout, _response(face_model, shots, settings))
        watch = ignore_progress if preview is None else Preview(preview, face_model, model, shots, settings)
        found = _fit(model, shots, lenses_of(captures, settings), settings, cache, watch)
        trackings = _trackings(face_model, model, shots, found, settings, ignore_progress if others else watch)
        if others:
            both = reduce_face_model(face_model, layout, _response(face_model, [*shots, *others], settings))
            watch = ignore_progress if preview is None else Preview(preview, face_model, both, others, settings)
            apart = StageCache(None if keep is None else keep / "held_out", resumed=cache.resumed)
            followed = follow_held_out(both, others, shots, found, settings, apart, watch)
            trackings += _trackings(face_model, both, others, followed, settings, watch)
    cache.forget()
    return trackings


def _fit(
    model: LandmarkModel,
    shots: Sequence[Shot],
    lenses: Sequence[int | None],
    settings: TrackingSettings,
    cache: StageCache,
    watch: Watch,
) -> Stages:
    """Run the stages of the schedule."""
    with explaining_singular(shots):
        landmarks = fit_landmarks(model, shots, lenses, settings, cache, watch)
    pixels, descent = None, None
    if settings.schedule == "fast" or (settings.schedule == "paper" and settings.paper.start == "fast"):
        pixels = refine_photometrically(model, shots, lenses, landmarks, settings, cache, watch)
    if settings.schedule == "paper":
        start = landmarks if pixels is None else pixels.fit
        descent = fit_by_descent(model, shots, lenses, start, settings, cache, watch, pixels)
    return Stages(landmarks, pixels, descent)


def _trackings(
    face_model: FaceModel,
    model: LandmarkModel,
    shots: Sequence[Shot],
    found: Stages,
    settings: TrackingSettings,
    watch: Watch,
) -> list[Tracking]:
    """The results as trackings, after the last correction. The watch receives the end."""
    fit = _without_turn_habits(model, shots, found.fit, settings)
    refined = None if found.refined is None else replace(found.refined, fit=fit)
    watch(DONE, 1.0, lambda: refined or fit)
    trackings = [
        as_tracking(shot, face_model, model, fit.subject, own, settings)
        for shot, own in zip(shots, fit.sequences, strict=True)
    ]
    if refined is not None and (refined.texture.trust > 0).any():
        trackings = with_pixels(trackings, shots, refined, face_model, settings)
    return trackings


def _without_turn_habits(model: LandmarkModel, shots: Sequence[Shot], fit: Fit, settings: TrackingSettings) -> Fit:
    calm = [without_turn_habits(all_landmarks(model, shot.views, own, settings), fit.subject, own)
            for shot, own in zip(shots, fit.sequences, strict=True)]  # fmt: skip
    return replace(fit, sequences=tuple(calm))


def _response(face_model: FaceModel, shots: Sequence[Shot], settings: TrackingSettings) -> DetectorResponse:
    # Sequences of one subject are captured alike. If they are not, the first decides.
    response = read_response(face_model, settings.bias_sigma, detector_of(shots[0].capture.source))
    # The response to turns was measured for one camera. With several cameras no one of them defines the turn.
    return response if all(len(shot.cameras) == 1 for shot in shots) else response.without_turns()
