"""The result of a fit as a Tracking: in world space, for every timestep."""

import dataclasses
import json
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.rotation import axis_angle_from_matrix, matrix_from_axis_angle
from mien.tracking.fitting.fit import SequenceFit, Subject
from mien.tracking.fitting.shot import Shot
from mien.tracking.landmarks.model import LandmarkModel
from mien.tracking.landmarks.term import all_landmarks
from mien.tracking.neck_line import fit_neck_lines
from mien.tracking.settings import TrackingSettings
from mien.tracking.tracking import Tracking


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


def fill_gaps(face: FaceParams, valid: Bool[Tensor, " t"]) -> FaceParams:
    """Parameters of all t timesteps from those of the valid ones: linear between neighbours, constant at the ends.

    The rotation of a head in view is far from pi, so axis-angle vectors interpolate like any other parameter.
    """
    assert len(face) == int(valid.sum())
    known = valid.nonzero()[:, 0].numpy()
    every = np.arange(len(valid))

    def fill(values: Float[Tensor, "v ..."]) -> Float[Tensor, "t ..."]:
        flat = values.flatten(1).numpy()
        filled = [np.interp(every, known, flat[:, column]) for column in range(flat.shape[1])]
        return torch.from_numpy(np.stack(filled, axis=1)).to(values).reshape(-1, *values.shape[1:])

    return replace(
        face,
        expression=fill(face.expression),
        joints=fill(face.joints),
        head_rotation=fill(face.head_rotation),
        head_translation=fill(face.head_translation),
    )


def relative_rotation(rotations: Float[Tensor, "t 3"], R_new_old: Float[Tensor, "3 3"]) -> Float[Tensor, "t 3"]:
    """Axis-angle rotations in another frame, without jumps by whole turns from one timestep to the next."""
    turned = axis_angle_from_matrix(R_new_old @ matrix_from_axis_angle(rotations))
    for index in range(1, len(turned)):
        angle = turned[index].norm()
        if angle > 0:
            other = turned[index] * (1 - 2 * torch.pi / angle)
            nearer = (other - turned[index - 1]).norm() < (turned[index] - turned[index - 1]).norm()
            turned[index] = other if nearer else turned[index]
    return turned
