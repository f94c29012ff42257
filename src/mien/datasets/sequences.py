"""Sequences made from the parts that datasets have: pictures, cameras, face parameters."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8

from mien.camera import Camera
from mien.capture.capture import Capture
from mien.capture.person.backend import choose_detector, detector_entry
from mien.capture.person.faces import LANDMARKS, LandmarkDetector
from mien.datasets.content import REMEDY
from mien.datasets.dataset import FilmedSequence, TrackedSequence
from mien.datasets.overlay import check_overlay
from mien.disk.limits import camera_fault
from mien.errors import UserError
from mien.face.checks import check_face_params
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.tracking.neck_line import fit_neck_lines
from mien.tracking.tracking import Tracking

_LANDMARKS = "mediapipe"


@torch.no_grad()
def tracked_sequence(
    path: Path, name: str, images: UInt8[np.ndarray, "t c h w 3"], mattes: UInt8[np.ndarray, "t c h w"],
    cameras: Mapping[str, Camera], face_model: FaceModel, face: FaceParams, fps: float,
) -> TrackedSequence:  # fmt: skip
    """Return a sequence whose every frame is tracked.

    Landmarks are those of the face model, projected, because no dataset has the points of mien's detector. Residuals
    are therefore 0. Training and scoring do not read landmarks.

    Args:
        path: The file or folder that it was read from.
        name: Name of the sequence.
        images: Decoded sRGB pixels. They may be a memory map.
        mattes: Opacity of the person; 255 is the person.
        cameras: Each camera by its id, in the order of the axis c, in one world, for pictures of this size.
        face_model: The face model of the parameters. It needs the landmarks of mien's detector.
        face: The person at the t timesteps, in the cameras' world.
        fps: Frames per second.
    """
    views = tuple(cameras.values())
    _check_cameras(path, cameras, fps)
    check_face_params(face_model, face, str(path), REMEDY)
    behind = torch.stack([camera.project(face.head_translation)[1] <= 0 for camera in views]).all(0)
    if behind.any():
        raise UserError(f"{path}: in frame {int(behind.int().argmax())} the head is behind every camera; {REMEDY}")
    if _LANDMARKS not in face_model.landmarks:
        raise UserError(f"{path}: the face model {face_model.name!r} has no landmarks; add it with `mien face-models`")
    landmarks, valid = _landmarks(face_model, face, views), np.ones(mattes.shape[:2], bool)
    capture = _capture(path, name, images, mattes, cameras, fps, landmarks, valid, {})
    tracking = Tracking(
        face_model=face_model.name, face_model_hash=face_model.content_hash, face=face,
        valid=torch.ones(len(mattes), dtype=torch.bool), cameras=views,
        neck_lines=fit_neck_lines(face_model, face, views), residuals=torch.zeros(mattes.shape[:2]),
    )  # fmt: skip
    return TrackedSequence(capture, tracking, face_model)


def filmed_sequence(
    path: Path, name: str, images: UInt8[np.ndarray, "t c h w 3"], mattes: UInt8[np.ndarray, "t c h w"],
    cameras: Mapping[str, Camera], fps: float, landmarks: Float[np.ndarray, "t c l 2"] | None = None,
) -> FilmedSequence:  # fmt: skip
    """Return a sequence without a tracking, for `mien track`: the arguments are those of `tracked_sequence`.

    `landmarks` are the 478 points of mien's detector in pixels, or None to detect them. A face with NaN is not valid.
    """
    _check_cameras(path, cameras, fps)
    found_by = detector_entry(choose_detector()) if landmarks is None else {}
    landmarks = detected_landmarks(images) if landmarks is None else landmarks
    valid = np.asarray(np.isfinite(landmarks).all((2, 3)))
    if not valid.any():
        raise UserError(f"{path}: no face is found in the pictures of {name}; {REMEDY}")
    marks = np.where(valid[..., None, None], landmarks, np.nan).astype(np.float32)
    return FilmedSequence(_capture(path, name, images, mattes, cameras, fps, marks, valid, found_by))


def _capture(
    path: Path, name: str, images: np.ndarray, mattes: np.ndarray, cameras: Mapping[str, Camera], fps: float,
    landmarks: np.ndarray, valid: np.ndarray, found_by: Mapping[str, Any],
) -> Capture:  # fmt: skip
    views = tuple(cameras.values())
    return Capture(
        name=name, camera_ids=tuple(cameras), fps=fps, timestamps=np.arange(len(mattes)) / fps, images=images,
        mattes=mattes, landmarks=landmarks, valid=valid,
        principal_point=np.stack([camera.K[:2, 2].double().numpy() for camera in views]),
        source={"file": path.name, **found_by}, calibration=views,
    )  # fmt: skip


def sequence_of(
    path: Path, name: str, pictures: tuple[np.ndarray, np.ndarray], cameras: Mapping[str, Camera], fps: float,
    tracked: tuple[FaceModel, FaceParams] | None, version: str,
) -> TrackedSequence | FilmedSequence:  # fmt: skip
    """Return a sequence, tracked if there is a face, after a check that its mesh lies on the person.

    `pictures` are images and mattes, and `version` names the face model that the tracking needs.
    """
    if tracked is None:
        return filmed_sequence(path, name, *pictures, cameras, fps)
    return check_overlay(path, tracked_sequence(path, name, *pictures, cameras, *tracked, fps), version)


def detected_landmarks(images: UInt8[np.ndarray, "t c h w 3"]) -> Float[np.ndarray, "t c l 2"]:
    """The points that mien's detector finds in pictures, in pixels; NaN in pictures without a face."""
    landmarks = np.full((*images.shape[:2], LANDMARKS, 2), np.nan, np.float32)
    for camera in range(images.shape[1]):
        with LandmarkDetector(several_faces=False) as detector:
            for timestep in range(len(images)):
                found = detector.detect(np.ascontiguousarray(images[timestep, camera]))
                if len(found):
                    landmarks[timestep, camera] = found[0]
    return landmarks


def _check_cameras(path: Path, cameras: Mapping[str, Camera], fps: float) -> None:
    for camera_id, camera in cameras.items():
        fault = camera_fault(camera.K.numpy(), camera.viewmat.numpy(), camera.width, camera.height)
        if fault is not None:
            raise UserError(f"{path}: camera {camera_id!r} is not valid ({fault}); {REMEDY}")
    if not 0 < fps <= 10_000:
        raise UserError(f"{path}: has {fps:g} frames per second, not a number above 0 and at most 10,000; {REMEDY}")


def _landmarks(face_model: FaceModel, face: FaceParams, cameras: tuple[Camera, ...]) -> Float[np.ndarray, "t c l 2"]:
    """The face model's landmarks in every picture, in pixels."""
    parts = []
    for start in range(0, len(face), 32):  # timesteps posed at once
        points = face_model.landmark_positions(face_model(face[start : start + 32]), _LANDMARKS)
        parts.append(torch.stack([camera.project(points)[0] for camera in cameras], dim=1))
    return torch.cat(parts).numpy()
