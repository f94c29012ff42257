"""Vertices and landmarks of a face model for drawing, in arithmetic that gives the same result on every machine.

`FaceModel.head_vertices_reference` uses matrix products, and the native core has kernels that differ between
instruction sets. This module uses neither. It agrees with both to a micrometre, and handles one timestep at a time.
"""

import numpy as np
import torch
from jaxtyping import Float

from mien.camera import Camera
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.machine import exact
from mien.runtime.rotation import matrix_from_axis_angle


def rest_vertices(model: FaceModel, identity: Float[torch.Tensor, " i"]) -> Float[np.ndarray, "v 3"]:
    """Return a person's vertices without expression, in the head frame, in metres, float32."""
    return (model.template.numpy() + exact.combined(identity.numpy(), model.identity_basis.numpy())).astype(np.float32)


def rest_joints(model: FaceModel, identity: Float[torch.Tensor, " i"]) -> Float[np.ndarray, "k 3"]:
    """Return a person's joints without expression, in the head frame, in metres, float64."""
    return model.joint_template.numpy() + exact.combined(identity.numpy(), model.joint_identity_basis.numpy())


def head_pose(face: FaceParams) -> Float[np.ndarray, "4 4"]:
    """Return `FaceParams.T_world_head` of one timestep, float32."""
    T = np.eye(4, dtype=np.float32)
    T[:3, :3] = matrix_from_axis_angle(face.head_rotation[0].numpy())
    T[:3, 3] = face.head_translation[0].numpy()
    return T


def landmark_positions(model: FaceModel, vertices: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "l 3"]:
    """Return MediaPipe's 478 points on a mesh of the model."""
    marks = model.landmarks["mediapipe"]
    return exact.mixed(marks.barycentric.numpy(), vertices[model.faces.numpy()[marks.faces.numpy()]])


def project(
    camera: Camera, points: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, " n"]]:
    """Project points like `Camera.project`: pixels, and depths in metres."""
    K, viewmat = camera.K.numpy(), camera.viewmat.numpy()
    seen = exact.rotated(exact.rotated(points, viewmat[:3, :3], viewmat[:3, 3]), K)
    return seen[:, :2] / seen[:, 2:], seen[:, 2]


class HeadPoser:
    """Poses one person's head."""

    def __init__(self, model: FaceModel, identity: Float[torch.Tensor, " i"]) -> None:
        self._model = model
        self._rest = rest_vertices(model, identity)
        self._rest_joints = rest_joints(model, identity)
        # One row per joint, since a column of an array is slow to read.
        self._weights = np.ascontiguousarray(model.skinning_weights.numpy().T)

    def __call__(self, face: FaceParams) -> Float[np.ndarray, "v 3"]:
        """Return `FaceModel.head_vertices` of one timestep (`face` has a batch of one, of this person), float32."""
        model = self._model
        expression, joints = face.expression[0].numpy(), face.joints[0].numpy().astype(np.float64)
        shaped = self._rest + exact.combined(expression, model.expression_basis.numpy())
        if face.vertex_offsets is not None:
            shaped += face.vertex_offsets.numpy()
        if model.pose_basis is not None:
            turned = matrix_from_axis_angle(joints) - np.eye(3)
            shaped += exact.combined(turned.reshape(-1), model.pose_basis.numpy())
        planes, posed = np.ascontiguousarray(shaped.T), np.zeros(shaped.shape[::-1])
        for weights, transform in zip(self._weights, self._joint_transforms(expression, joints), strict=True):
            posed += weights * exact.rotated(planes.T, transform[:3, :3], transform[:3, 3]).T
        return posed.T.astype(np.float32, order="C")

    def _joint_transforms(self, expression: np.ndarray, joints: np.ndarray) -> list[Float[np.ndarray, "4 4"]]:
        """Return `FaceModel.joint_transforms`, float64."""
        model, rest = self._model, self._rest_joints
        turns = exact.combined(expression, model.joint_rotation_basis.numpy())
        shifts = exact.combined(expression, model.joint_translation_basis.numpy())
        turns[np.array(model.joint_free)] = joints
        chained: list[np.ndarray] = []
        for index, (parent, rotation) in enumerate(
            zip(model.joint_parents, matrix_from_axis_angle(turns), strict=True)
        ):
            local = np.eye(4)
            local[:3, :3] = rotation
            local[:3, 3] = rest[index] + shifts[index] - exact.dot(rotation, rest[index])
            chained.append(local if parent < 0 else exact.product(chained[parent], local))
        return chained
