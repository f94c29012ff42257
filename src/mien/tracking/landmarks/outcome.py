"""The result of a fit as a Tracking: in world space, for every timestep, after a last correction of expressions."""

import dataclasses
import json
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mien.camera import Camera
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.rotation import axis_angle_from_matrix, matrix_from_axis_angle
from mien.tracking.fitting.fit import SequenceFit, Subject
from mien.tracking.fitting.sequence import SequenceData
from mien.tracking.landmarks.problem import Problem
from mien.tracking.landmarks.term import LandmarkTerm, all_landmarks
from mien.tracking.neck_line import fit_neck_lines
from mien.tracking.tracking import Tracking

_MIN_TURN = 1e-4
"""Standard deviation of a rotation below which the head counts as still, in radians."""


def as_tracking(
    problem: Problem, face_model: FaceModel, data: SequenceData, subject: Subject, own: SequenceFit
) -> Tracking:
    """The tracking of one sequence from a fit to landmarks."""
    views, model, settings = data.views, problem.model, problem.settings
    residuals = torch.full((len(data.valid), len(own.cameras)), torch.nan)
    distances = all_landmarks(model, views, own, settings).residuals(own.state, subject, own.cameras)
    residuals[data.timesteps[views.row], views.camera] = distances.median(1).values.float()
    face = fill_gaps(model.layout.face_params(own.state, subject.identity), data.valid)
    face = replace(face, vertex_offsets=subject.vertex_offsets)
    if data.T_world_fit is not None:
        R_world_fit, origin = data.T_world_fit[:3, :3], data.T_world_fit[:3, 3]
        face = replace(
            face,
            head_rotation=_relative_rotation(face.head_rotation, R_world_fit),
            head_translation=face.head_translation @ R_world_fit.T + origin,
        )
    face = face.to(torch.zeros(()))
    cameras, size = data.capture.calibration, (data.capture.width, data.capture.height)
    if cameras is None:
        pairs = zip(own.cameras.K, own.cameras.viewmat, strict=True)
        cameras = tuple(Camera(K, viewmat, *size).to(torch.zeros(())) for K, viewmat in pairs)
    return Tracking(
        face_model=face_model.name,
        face_model_hash=face_model.content_hash,
        face=face,
        valid=data.valid,
        cameras=cameras,
        neck_lines=fit_neck_lines(face_model, face, cameras),
        residuals=residuals,
        # Infinity becomes a string, because json has no infinity.
        settings=json.loads(json.dumps(dataclasses.asdict(settings.in_effect())).replace("Infinity", '"inf"')),
    )


def fill_gaps(face: FaceParams, valid: Bool[Tensor, " t"]) -> FaceParams:
    """Parameters of all timesteps: linear between valid ones (rotations in view are far from pi), constant at ends."""
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


def _relative_rotation(rotations: Float[Tensor, "t 3"], R_new_old: Float[Tensor, "3 3"]) -> Float[Tensor, "t 3"]:
    """Axis-angle rotations in another frame, without jumps by whole turns from one timestep to the next."""
    turned = axis_angle_from_matrix(R_new_old @ matrix_from_axis_angle(rotations))
    for index in range(1, len(turned)):
        angle = turned[index].norm()
        if angle > 0:
            other = turned[index] * (1 - 2 * torch.pi / angle)
            nearer = (other - turned[index - 1]).norm() < (turned[index] - turned[index - 1]).norm()
            turned[index] = other if nearer else turned[index]
    return turned


def without_turn_habits(term: LandmarkTerm, subject: Subject, own: SequenceFit) -> SequenceFit:
    """Shrink the part of a sequence's expressions that is linear in the head's turns to what one frame supports.

    The fit treats errors of frames as independent. But errors of light, shape, focal length and detector follow the
    head's turns and recur whenever the head turns the same way, and expressions that explain them move with the head.
    So all frames together know no better than a single frame how far a coefficient follows the turns. The landmarks'
    information of one frame is weighed against the prior of one frame: a jaw that drops as the head tips back remains,
    and a cheek that seems to rise by half a millimetre does not. Coefficients are weighed together, so those that
    cancel each other on the face vanish first, and lips that they close stay closed. Poses and joints do not change.
    """
    layout, state = term.model.layout, own.state
    # An orthonormal basis of the turns up and down, left and right, with fewer columns if the head hardly turns.
    left, lengths, _ = torch.linalg.svd(state[:, :2] - state[:, :2].mean(0), full_matrices=False)
    turns = left[:, lengths > _MIN_TURN * len(state) ** 0.5]
    columns = layout.expression_columns
    if turns.shape[1] == 0 or columns.start == columns.stop:
        return own
    expression, prior = state[:, columns], layout.precision[columns, columns]
    middle = (state[:, :3] - state[:, :3].median(0).values).norm(dim=1).argmin()[None]
    known = term.at(middle).equations(state[middle], subject, own.cameras).hessian[0, columns, columns] - prior
    following = turns.T @ expression
    kept = torch.linalg.solve(known + prior, known @ following.T).T
    changed = state.clone()
    changed[:, columns] = expression - turns @ (following - kept)
    return replace(own, state=layout.bounds.clip(changed))
