"""Sequences made from the parts that datasets have: pictures, cameras, face parameters."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8

from mien.camera import Camera
from mien.capture.capture import Capture
from mien.capture.person.backend import choose_detector, detector_entry
from mien.capture.person.faces import LANDMARKS, LandmarkDetector
from mien.datasets.content import REMEDY
from mien.datasets.dataset import FilmedSequence, TrackedSequence
from mien.disk.limits import camera_fault
from mien.errors import UserError
from mien.face.checks import check_face_params
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.tracking.neck_line import fit_neck_lines
from mien.tracking.tracking import Tracking

_LANDMARKS = "mediapipe"
_CHUNK = 32
"""Number of timesteps posed at once."""
_MAX_FPS = 10_000


@torch.no_grad()
def tracked_sequence(
    path: Path,
    name: str,
    images: UInt8[np.ndarray, "t c h w 3"],
    mattes: UInt8[np.ndarray, "t c h w"],
    cameras: Mapping[str, Camera],
    face_model: FaceModel,
    face: FaceParams,
    fps: float,
) -> TrackedSequence:
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
    _check_places(path, cameras, face_model, face)
    _check_fps(path, fps)
    if _LANDMARKS not in face_model.landmarks:
        raise UserError(f"{path}: the face model {face_model.name!r} has no landmarks; add it with `mien face-models`")
    capture = Capture(
        name=name,
        camera_ids=tuple(cameras),
        fps=fps,
        timestamps=np.arange(len(mattes)) / fps,
        images=images,
        mattes=mattes,
        landmarks=_landmarks(face_model, face, views),
        valid=np.ones(mattes.shape[:2], bool),
        principal_point=np.stack([camera.K[:2, 2].double().numpy() for camera in views]),
        source={"file": path.name},
        calibration=views,
    )
    tracking = Tracking(
        face_model=face_model.name,
        face_model_hash=face_model.content_hash,
        face=face,
        valid=torch.ones(len(mattes), dtype=torch.bool),
        cameras=views,
        neck_lines=fit_neck_lines(face_model, face, views),
        residuals=torch.zeros(mattes.shape[:2]),
    )
    return TrackedSequence(capture, tracking, face_model)


def filmed_sequence(
    path: Path,
    name: str,
    images: UInt8[np.ndarray, "t c h w 3"],
    mattes: UInt8[np.ndarray, "t c h w"],
    cameras: Mapping[str, Camera],
    fps: float,
    landmarks: Float[np.ndarray, "t c l 2"] | None = None,
) -> FilmedSequence:
    """Return a sequence without a tracking, for `mien track`.

    Args:
        path: The file or folder that it was read from.
        name: Name of the sequence.
        images: Decoded sRGB pixels. They may be a memory map.
        mattes: Opacity of the person; 255 is the person.
        cameras: Each camera by its id, in the order of the axis c, in one world, for pictures of this size.
        fps: Frames per second.
        landmarks: The 478 points of mien's detector in pixels, or None to detect them. A face with NaN is not valid.
    """
    _check_cameras(path, cameras)
    _check_fps(path, fps)
    found_by = detector_entry(choose_detector()) if landmarks is None else {}
    landmarks = detected_landmarks(images) if landmarks is None else landmarks
    valid = np.asarray(np.isfinite(landmarks).all((2, 3)))
    if not valid.any():
        raise UserError(f"{path}: no face is found in the pictures of {name}; {REMEDY}")
    views = tuple(cameras.values())
    return FilmedSequence(
        Capture(
            name=name,
            camera_ids=tuple(cameras),
            fps=fps,
            timestamps=np.arange(len(mattes)) / fps,
            images=images,
            mattes=mattes,
            landmarks=np.where(valid[..., None, None], landmarks, np.nan).astype(np.float32),
            valid=valid,
            principal_point=np.stack([camera.K[:2, 2].double().numpy() for camera in views]),
            source={"file": path.name, **found_by},
            calibration=views,
        )
    )


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


def _check_fps(path: Path, fps: float) -> None:
    if not 0 < fps <= _MAX_FPS:
        raise UserError(f"{path}: has {fps:g} frames per second, not a number above 0 and at most {_MAX_FPS}; {REMEDY}")


def _check_cameras(path: Path, cameras: Mapping[str, Camera]) -> None:
    for camera_id, camera in cameras.items():
        fault = camera_fault(camera.K.numpy(), camera.viewmat.numpy(), camera.width, camera.height)
        if fault is not None:
            raise UserError(f"{path}: camera {camera_id!r} is not valid ({fault}); {REMEDY}")


def _check_places(path: Path, cameras: Mapping[str, Camera], face_model: FaceModel, face: FaceParams) -> None:
    """Check cameras and face parameters, and that a camera sees the head at every timestep."""
    _check_cameras(path, cameras)
    check_face_params(face_model, face, str(path), REMEDY)
    depths = torch.stack([camera.project(face.head_translation)[1] for camera in cameras.values()])
    behind = (depths <= 0).all(0)
    if behind.any():
        raise UserError(f"{path}: in frame {int(behind.int().argmax())} the head is behind every camera; {REMEDY}")


def _landmarks(face_model: FaceModel, face: FaceParams, cameras: tuple[Camera, ...]) -> Float[np.ndarray, "t c l 2"]:
    """The face model's landmarks in every picture, in pixels."""
    parts = []
    for start in range(0, len(face), _CHUNK):
        points = face_model.landmark_positions(face_model(face[start : start + _CHUNK]), _LANDMARKS)
        parts.append(torch.stack([camera.project(points)[0] for camera in cameras], dim=1))
    return torch.cat(parts).numpy()
