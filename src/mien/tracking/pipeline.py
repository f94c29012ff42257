"""Capture -> Tracking: the stages in their order."""

import dataclasses
import json
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mien.camera import Camera
from mien.capture.capture import Capture
from mien.errors import UserError
from mien.face import FaceModel
from mien.progress import progress_bar
from mien.tracking.interpolation import fill_gaps
from mien.tracking.landmark_groups import LANDMARKS
from mien.tracking.landmark_model import LandmarkModel, reduce_face_model
from mien.tracking.landmark_term import Subject
from mien.tracking.neck_line import fit_neck_lines
from mien.tracking.parameters import layout_of
from mien.tracking.settings import TrackingSettings
from mien.tracking.stages import (
    Fit,
    all_landmarks,
    choose_keyframes,
    fit_frames,
    fit_head_pose,
    fit_keyframes,
    fit_sequence,
    smoothness_of,
    widen,
)
from mien.tracking.tracking import Tracking

DEFAULTS = TrackingSettings()
_LEAST_FRAMES = 3
_DEFAULT_FOCAL = 1.5
"""Times the larger side of the source picture: between a telephone's wide lens and a portrait lens."""


def track(capture: Capture, face_model: FaceModel, settings: TrackingSettings = DEFAULTS) -> Tracking:
    """The face model fitted to a capture's landmarks.

    Stages: head pose of every frame alone; identity (and focal length) from keyframes; every frame alone; all frames
    together, smooth over time. Deterministic.

    Raises:
        UserError: the capture has several cameras or too few frames with a face, or the model lacks the landmarks.
    """
    _check(capture, face_model)
    valid = torch.from_numpy(np.asarray(capture.valid[:, 0], dtype=bool)).clone()
    detected = torch.from_numpy(np.asarray(capture.landmarks[:, 0], dtype=np.float64))
    valid &= detected.isfinite().all(-1).all(-1)
    camera = initial_camera(capture, settings)
    with torch.no_grad():
        model = reduce_face_model(face_model, layout_of(face_model))
        fit = _fit_landmarks(model, detected[valid], valid, camera, capture.fps, settings)
        # A photometric stage refines `fit` here.
        return _as_tracking(capture, face_model, model, fit, valid, detected, settings)


def initial_camera(capture: Capture, settings: TrackingSettings) -> Camera:
    """The camera of the captured pictures, float64, with a given or assumed focal length."""
    focal_x, focal_y = _source_focal(capture) if settings.focal is None else (settings.focal, settings.focal)
    x, y = (float(value) for value in capture.principal_point[0])
    K = torch.tensor([[focal_x, 0, x], [0, focal_y, y], [0, 0, 1]], dtype=torch.float64)
    viewmat = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
    return Camera(K, viewmat, capture.width, capture.height)


def _fit_landmarks(
    model: LandmarkModel,
    detected: Float[Tensor, "v l 2"],
    valid: Bool[Tensor, " t"],
    camera: Camera,
    fps: float,
    settings: TrackingSettings,
) -> Fit:
    subject = Subject(detected.new_zeros(len(model.identity_basis)), detected.new_zeros(LANDMARKS, 3), camera)
    with progress_bar("Tracking", total=4) as advance:
        pose = fit_head_pose(model, detected, subject, settings)
        advance(status="head pose")

        fit = Fit(subject, widen(pose, model.layout))
        keyframes = choose_keyframes(pose, settings.keyframes)
        term = all_landmarks(model, detected, fit, settings)
        subject = fit_keyframes(term.at(keyframes), replace(fit, state=fit.state[keyframes]), settings).subject
        advance(status="identity")

        pose = fit_head_pose(model, detected, subject, settings)
        fit = Fit(subject, widen(pose, model.layout))
        term = all_landmarks(model, detected, fit, settings)
        fit = fit_frames(term, fit)
        advance(status="frames")

        fit = fit_sequence(term, fit, smoothness_of(model.layout, valid, fps, settings.smoothness), settings)
        advance(status="sequence")
    return fit


def _as_tracking(
    capture: Capture,
    face_model: FaceModel,
    model: LandmarkModel,
    fit: Fit,
    valid: Bool[Tensor, " t"],
    detected: Float[Tensor, "t l 2"],
    settings: TrackingSettings,
) -> Tracking:
    term = all_landmarks(model, detected[valid], fit, settings)
    residuals = torch.full((len(valid), 1), torch.nan)
    residuals[valid, 0] = term.residuals(fit.state, fit.subject).median(1).values.float()
    face = fill_gaps(model.layout.face_params(fit.state, fit.subject.identity), valid).to(torch.zeros(()))
    camera = fit.subject.camera.to(torch.zeros(()))
    return Tracking(
        face_model=face_model.name,
        face_model_hash=face_model.content_hash,
        face=face,
        valid=valid,
        cameras=(camera,),
        neck_lines=fit_neck_lines(face_model, face, (camera,)),
        residuals=residuals,
        settings=_jsonable(dataclasses.asdict(settings)),
    )


def _check(capture: Capture, face_model: FaceModel) -> None:
    if len(capture.camera_ids) != 1:
        raise UserError(f"{capture.name}: has {len(capture.camera_ids)} cameras, tracking takes one; capture one video")
    if "mediapipe" not in face_model.landmarks:
        raise UserError(f"face model {face_model.name!r}: has no MediaPipe landmarks; calibrate them for it first")
    found = int(np.asarray(capture.valid).sum())
    if found < _LEAST_FRAMES:
        raise UserError(
            f"{capture.name}: a face was found in {found} frames, tracking needs {_LEAST_FRAMES}; film longer"
        )


def _source_focal(capture: Capture) -> tuple[float, float]:
    """The assumed focal lengths along x and y in pixels of the capture: it may be a shrunk crop of what was filmed."""
    crop = capture.source.get("crop", {"width": capture.width, "height": capture.height})
    side = max(capture.source.get("picture_size", (crop["width"], crop["height"])))
    assumed = _DEFAULT_FOCAL * float(side)
    return assumed * capture.width / crop["width"], assumed * capture.height / crop["height"]


def _jsonable(settings: dict) -> dict:
    """Settings as json holds them: it has no infinity."""
    return json.loads(json.dumps(settings).replace("Infinity", '"inf"'))
