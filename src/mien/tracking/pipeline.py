"""Captures -> Trackings: the stages in their order. What is the subject's is shared by all of its sequences."""

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from mien.capture.capture import Capture
from mien.errors import UserError
from mien.face import FaceModel, FaceParams
from mien.progress import progress_bar, say
from mien.tracking.head_pose import fit_head_pose, relative_rotation
from mien.tracking.interpolation import fill_gaps
from mien.tracking.landmark_groups import LANDMARKS
from mien.tracking.landmark_model import LandmarkModel, reduce_face_model
from mien.tracking.landmark_term import Subject
from mien.tracking.model_pictures import looks_in_world, model_pictures
from mien.tracking.neck_line import fit_neck_lines
from mien.tracking.paper import fit_by_descent
from mien.tracking.parameters import layout_of
from mien.tracking.photometric import PhotometricFit, refine_photometrically
from mien.tracking.photometric_threads import in_threads
from mien.tracking.resume import Keeper
from mien.tracking.settings import TrackingSettings
from mien.tracking.shared_fit import fit_shared
from mien.tracking.shot import Shot, lenses_of, shot_of
from mien.tracking.stages import (
    SEQUENCE_ITERATIONS,
    Fit,
    SequenceFit,
    all_landmarks,
    choose_keyframes,
    fit_frames,
    fit_of,
    fit_sequences,
    smoothness_of,
    widen,
)
from mien.tracking.tracking import Tracking

DEFAULTS = TrackingSettings()
_COSTS = {"head pose": 10, "identity": 10, "frames": 140, "sequence": 100}
"""About how long each stage takes a timestep, for the progress bar: so in a clip of 15,000; multiples of ten."""
_SOME = 8
"""Frames that are named where there are many."""


def track(capture: Capture, face_model: FaceModel, settings: TrackingSettings = DEFAULTS) -> Tracking:
    """The face model fitted to one capture: `track_subject` of a single sequence."""
    return track_subject([capture], face_model, settings)[0]


def track_subject(
    captures: Sequence[Capture],
    face_model: FaceModel,
    settings: TrackingSettings = DEFAULTS,
    keep: Path | None = None,
) -> list[Tracking]:
    """The face model fitted to landmarks and pixels of all sequences of one person, with one identity.

    Stages: head pose of every timestep alone; identity (and unknown focal lengths) from keyframes of all sequences;
    every timestep alone; all timesteps of each sequence together, smooth over time; then, unless the schedule is
    `landmarks`, the fit to pixels (`refine_photometrically`). Deterministic.

    Sequences may differ in size, frame rate and number of cameras. Several cameras have to be calibrated
    (`Capture.calibration`): they stay as they are, give the metric scale, and a camera that found no face at a timestep
    adds nothing to it. With one uncalibrated camera, metric scale comes from the identity prior.

    `keep` is a folder of its own for finished parts, from which interrupted tracking of the same captures with the
    same settings goes on, to the same numbers. It is removed at the end.

    Raises:
        UserError: a capture has several cameras without calibration, too few timesteps with a face, or landmarks that
            no face could have; or the model lacks the landmarks.
    """
    assert captures, "nothing to track"
    if "mediapipe" not in face_model.landmarks:
        raise UserError(f"face model {face_model.name!r}: has no MediaPipe landmarks; calibrate them for it first")
    shots, keeper = [shot_of(capture, settings) for capture in captures], Keeper(keep)
    with torch.no_grad():
        model = reduce_face_model(face_model, layout_of(face_model))
        lenses = lenses_of(captures, settings)
        try:
            fit = _fit_landmarks(model, shots, lenses, settings, keeper)
        except torch.linalg.LinAlgError:
            names = ", ".join(capture.name for capture in captures)
            raise UserError(
                f"{names}: no face fits the landmarks; look at the pictures, and capture it again"
            ) from None
        refined: PhotometricFit | None = None
        if settings.schedule == "fast":
            refined = refine_photometrically(model, shots, lenses, fit, settings, keeper)
        if settings.schedule == "paper":
            refined = fit_by_descent(model, shots, lenses, fit, settings, keeper)
        fit = fit if refined is None else refined.fit
        trackings = [
            _as_tracking(shot, face_model, model, fit.subject, own, settings)
            for shot, own in zip(shots, fit.sequences, strict=True)
        ]
        if refined is not None and (refined.appearance.trust > 0).any():
            trackings = _with_pixels(trackings, shots, refined, face_model, settings)
    keeper.forget()
    return trackings


def _with_pixels(
    trackings: Sequence[Tracking],
    shots: Sequence[Shot],
    refined: PhotometricFit,
    face_model: FaceModel,
    settings: TrackingSettings,
) -> list[Tracking]:
    """The trackings with what pixels said."""
    extent = settings.photometric.light_extent if settings.schedule == "fast" else settings.paper.light_extent
    complete = []
    for index, (tracking, shot) in enumerate(zip(trackings, shots, strict=True)):
        looks = looks_in_world(refined.appearance, refined.lights[index], shot.T_world_fit, extent)
        tracking = replace(tracking, looks=looks)
        found = refined.residuals[index] if refined.residuals else _residuals(tracking, shot, face_model)
        found = found.where(refined.improved[index][:, None], torch.nan)
        complete.append(_with_pixel_residuals(tracking, shot, found))
    return complete


def _residuals(tracking: Tracking, shot: Shot, face_model: FaceModel) -> Float[Tensor, "v c"]:
    """By how much colours differ in pictures with a face; NaN where a camera found none."""
    pictures = model_pictures(shot.capture, tracking, face_model)
    assert pictures is not None
    found = torch.full((int(shot.valid.sum()), len(tracking.cameras)), torch.nan)
    timesteps, views = shot.valid.nonzero()[:, 0].tolist(), shot.views

    def compare(row: int) -> None:
        vertices = face_model(tracking.face[timesteps[row]])[0]
        for camera in views.camera[views.row == row].tolist():
            found[row, camera] = pictures.compare(timesteps[row], camera, vertices).rms

    in_threads(compare, list(range(len(found))))
    return found


def _with_pixel_residuals(tracking: Tracking, shot: Shot, found: Float[Tensor, "v c"]) -> Tracking:
    residuals = torch.full_like(tracking.residuals, torch.nan)
    residuals[shot.valid] = found
    left = (shot.valid & residuals.isnan().all(1)).nonzero()[:, 0].tolist()
    if left:
        some = ", ".join(map(str, left[:_SOME])) + (", ..." if len(left) > _SOME else "")
        say(f"{shot.capture.name}: in {len(left)} of {int(shot.valid.sum())} frames with a face pixels were no help, "
            f"so landmarks alone decided: {some}")  # fmt: skip
    return replace(tracking, pixel_residuals=residuals)


def _fit_landmarks(
    model: LandmarkModel,
    shots: Sequence[Shot],
    lenses: Sequence[int | None],
    settings: TrackingSettings,
    keeper: Keeper,
) -> Fit:
    subject = Subject(torch.zeros(len(model.identity_basis)).double(), torch.zeros(LANDMARKS, 3).double())
    frames = sum(int(shot.valid.sum()) for shot in shots)
    with progress_bar("Tracking", total=frames * sum(_COSTS.values())) as advance:

        def advance_by(stage: str, timesteps: int, share: int = 1) -> None:
            advance(timesteps * _COSTS[stage] // share, status=stage)

        def identify() -> dict[str, Tensor]:
            starts = []
            for shot in shots:
                pose = fit_head_pose(model, shot.views, shot.cameras, subject, settings)
                starts.append(SequenceFit(shot.cameras, widen(pose, model.layout)))
                advance_by("head pose", len(pose))
            terms, keyframes = [], []
            for shot, own in zip(shots, starts, strict=True):
                chosen = choose_keyframes(own.state[:, :6], settings.keyframes)
                terms.append(all_landmarks(model, shot.views, own, settings).at(chosen))
                keyframes.append(replace(own, state=own.state[chosen]))
            return fit_shared(terms, Fit(subject, tuple(keyframes)), lenses, settings).tensors()

        known = fit_of(keeper.once("identity", identify))
        advance_by("identity", frames)

        terms, sequences = [], []
        for number, (shot, key) in enumerate(zip(shots, known.sequences, strict=True)):
            pose = fit_head_pose(model, shot.views, key.cameras, known.subject, settings)
            own = SequenceFit(key.cameras, widen(pose, model.layout))
            terms.append(all_landmarks(model, shot.views, own, settings))
            advance_frames, name = partial(advance_by, "frames"), f"frames-{number}"
            sequences.append(fit_frames(terms[-1], known.subject, own, advance_frames, keeper, name))

        smoothness = [smoothness_of(model.layout, shot.valid, shot.fps, settings.smoothness, own.cameras)
                      for shot, own in zip(shots, sequences, strict=True)]  # fmt: skip
        advance_one = partial(advance_by, "sequence", share=SEQUENCE_ITERATIONS)
        return fit_sequences(terms, Fit(known.subject, tuple(sequences)), smoothness, settings, advance_one, keeper)


def _as_tracking(
    shot: Shot,
    face_model: FaceModel,
    model: LandmarkModel,
    subject: Subject,
    own: SequenceFit,
    settings: TrackingSettings,
) -> Tracking:
    views = shot.views
    residuals = torch.full((len(shot.valid), len(own.cameras)), torch.nan)
    distances = all_landmarks(model, views, own, settings).residuals(own.state, subject, own.cameras)
    residuals[shot.valid.nonzero()[views.row, 0], views.camera] = distances.median(1).values.float()
    face = fill_gaps(model.layout.face_params(own.state, subject.identity), shot.valid)
    face = replace(face, vertex_offsets=subject.vertex_offsets)
    face = _in_world(face, shot.T_world_fit).to(torch.zeros(()))
    cameras = shot.cameras_in_world(own.cameras)
    return Tracking(
        face_model=face_model.name,
        face_model_hash=face_model.content_hash,
        face=face,
        valid=shot.valid,
        cameras=cameras,
        neck_lines=fit_neck_lines(face_model, face, cameras),
        residuals=residuals,
        settings=_jsonable(dataclasses.asdict(settings)),
    )


def _in_world(face: FaceParams, T_world_fit: Float[Tensor, "4 4"] | None) -> FaceParams:
    if T_world_fit is None:
        return face
    R_world_fit, origin = T_world_fit[:3, :3], T_world_fit[:3, 3]
    return replace(
        face,
        head_rotation=relative_rotation(face.head_rotation, R_world_fit),
        head_translation=face.head_translation @ R_world_fit.T + origin,
    )


def _jsonable(settings: dict) -> dict:
    """Settings as json holds them: it has no infinity."""
    return json.loads(json.dumps(settings).replace("Infinity", '"inf"'))
