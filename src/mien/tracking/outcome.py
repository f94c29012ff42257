"""Results of a fit as Trackings: in world space, for every timestep, with the results of the fit to pixels."""

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from mien.face import FaceModel, FaceParams
from mien.progress import say
from mien.tracking.head_pose import relative_rotation
from mien.tracking.interpolation import fill_gaps
from mien.tracking.landmark_model import LandmarkModel
from mien.tracking.landmark_term import Subject
from mien.tracking.model_pictures import looks_in_world, model_pictures
from mien.tracking.neck_line import fit_neck_lines
from mien.tracking.photometric_fit import PhotometricFit
from mien.tracking.photometric_threads import in_threads
from mien.tracking.settings import TrackingSettings
from mien.tracking.shot import Shot
from mien.tracking.stages import SequenceFit, all_landmarks
from mien.tracking.tracking import Looks, Tracking

_SOME = 8
"""Largest number of frames that a message lists."""


def as_tracking(
    shot: Shot,
    face_model: FaceModel,
    model: LandmarkModel,
    subject: Subject,
    own: SequenceFit,
    settings: TrackingSettings,
) -> Tracking:
    """The tracking of one sequence from a fit to landmarks."""
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
    """Settings as json can hold them. Infinity becomes a string, because json has no infinity."""
    return json.loads(json.dumps(settings).replace("Infinity", '"inf"'))


def with_pixels(
    trackings: Sequence[Tracking],
    shots: Sequence[Shot],
    refined: PhotometricFit,
    face_model: FaceModel,
    settings: TrackingSettings,
) -> list[Tracking]:
    """The trackings with the results of the fit to pixels: looks and pixel residuals."""
    complete = []
    for index, (tracking, shot) in enumerate(zip(trackings, shots, strict=True)):
        tracking = replace(tracking, looks=looks_of(refined, index, shot, settings))
        found = refined.residuals[index] if refined.residuals else _residuals(tracking, shot, face_model)
        found = found.where(refined.improved[index][:, None], torch.nan)
        complete.append(_with_pixel_residuals(tracking, shot, found))
    return complete


def _residuals(tracking: Tracking, shot: Shot, face_model: FaceModel) -> Float[Tensor, "v c"]:
    """Colour differences of the pictures with a face (`Comparison.rms`); NaN where a camera found none."""
    pictures = model_pictures(shot.capture, tracking, face_model)
    assert pictures is not None
    found = torch.full((int(shot.valid.sum()), len(tracking.cameras)), torch.nan)
    timesteps, views = shot.valid.nonzero()[:, 0].tolist(), shot.views

    def compare(row: int) -> None:
        vertices = face_model(tracking.face[timesteps[row]])[0]
        for camera in views.seen_by(row):
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


def looks_of(refined: PhotometricFit, sequence: int, shot: Shot, settings: TrackingSettings) -> Looks:
    """The texture, and the light of one of the sequences."""
    extent = settings.photometric.light_extent if settings.schedule == "fast" else settings.paper.light_extent
    return looks_in_world(refined.appearance, refined.lights[sequence], shot.T_world_fit, extent)
