"""Make a head in GNM's schema from the anny model: other vertices, whitened bases without names, no jaw joint.
It contains nothing of GNM's own. `posed_as_gnm` is a forward pass by GNM's published formulas."""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from flame_like import principal_directions
from mien.face import FaceModel
from mien.face.model import Landmarks
from mien.rotation import matrix_from_axis_angle

IDENTITIES, EXPRESSIONS = 30, 26
_SHIFT = np.array([0.001, 0.24, -0.02])
"""Shift between GNM's origin and mien's, in metres."""
_ORDER = ("neck", "head", "left_eye", "right_eye")


def gnm_like(anny: FaceModel) -> dict[str, Any]:
    """Return the arrays of a file in GNM's schema. Its joints are stored in another order than GNM's documentation."""
    order, faces = _order(anny)
    template = anny.template.double().numpy()[order]
    theirs = anny.skinning_weights.double().numpy()[order]
    weights = np.stack([theirs[:, 1], theirs[:, 0] + theirs[:, 2], theirs[:, 3], theirs[:, 4]])
    joints = anny.joint_template.double().numpy()
    head = joints[1]  # mien's neck turns about GNM's head joint
    root = head - [0, 0.05, 0.01]
    basis = anny.joint_identity_basis.double().numpy()[:IDENTITIES]
    regions = np.array(anny.region_names)[anny.face_regions.numpy()]

    def group(mask: np.ndarray) -> np.ndarray:
        members = np.zeros(len(anny.template), bool)
        members[anny.faces.numpy()[mask].ravel()] = True
        return members[order].astype(np.float32)

    lower = theirs[:, 2] > 0.5
    teeth = group(regions == "teeth")
    groups = {
        "skin": group(regions == "skin"), "upper_teeth_and_gums": teeth * ~lower, "lower_teeth_and_gums": teeth * lower,
        "tongue": group(regions == "tongue"), "mouth_sock": group(regions == "mouth"),
        "left_eye": (theirs[:, 3] > 0.5) * 1.0, "right_eye": (theirs[:, 4] > 0.5) * 1.0,
        "irises": group(regions == "irises"), "pupils": group(regions == "irises"),
    }  # fmt: skip
    parents = np.array([-1, 0, 1, 1], np.int32)
    return {
        "version": np.array("3.0"), "variant": np.array("head"),
        "template_vertex_positions": (template + _SHIFT).astype(np.float32),
        "triangles": faces.astype(np.uint16),
        "vertex_identity_basis": anny.identity_basis.numpy()[:IDENTITIES, order],
        "expression_basis": _expressions(anny)[:, order].astype(np.float32),
        "expression_names": np.array([f"lower_face_region_{index:03d}" for index in range(EXPRESSIONS)]),
        "template_joint_positions": (np.stack([root, head, joints[3], joints[4]]) + _SHIFT).astype(np.float32),
        "joint_identity_basis": basis[:, [1, 1, 3, 4]].astype(np.float32),
        "joint_names": np.array(_ORDER), "joint_parent_indices": parents,
        "skinning_weights": weights.astype(np.float32),
        "pose_correctives_regressor": np.zeros((36, template.size), np.float32),
        "vertex_groups": np.stack(list(groups.values())).astype(np.float32),
        "vertex_group_names": np.array(list(groups)),
    }  # fmt: skip


def gnm_landmarks(anny: FaceModel) -> dict[str, Landmarks]:
    """Return anny's landmarks on the other mesh, whose triangles have the same order."""
    return dict(anny.landmarks)


def write_gnm(path: Path, arrays: dict[str, Any]) -> Path:
    np.savez(path, **arrays)
    return path


def posed_as_gnm(
    arrays: dict[str, Any], rotations: np.ndarray, identity: np.ndarray, expression: np.ndarray, shift: np.ndarray
) -> np.ndarray:
    """Return vertices [v, 3] in float64. `rotations` [4, 3] are axis-angles of neck, head, left and right eye."""
    bind = arrays["template_vertex_positions"].astype(np.float64)
    bind = bind + np.tensordot(identity, arrays["vertex_identity_basis"].astype(np.float64), 1)
    bind = bind + np.tensordot(expression, arrays["expression_basis"].astype(np.float64), 1)
    joints = arrays["template_joint_positions"] + np.tensordot(identity, arrays["joint_identity_basis"], 1)
    turns = matrix_from_axis_angle(torch.from_numpy(rotations)).numpy()
    world: list[tuple[np.ndarray, np.ndarray]] = []
    for joint, parent in enumerate(arrays["joint_parent_indices"]):
        if parent < 0:
            world.append((turns[joint], joints[joint] + shift))
            continue
        rotation, place = world[parent]
        world.append((rotation @ turns[joint], rotation @ (joints[joint] - joints[parent]) + place))
    weights = arrays["skinning_weights"].astype(np.float64)
    return sum(
        weights[joint][:, None] * ((bind - joints[joint]) @ rotation.T + place)
        for joint, (rotation, place) in enumerate(world)
    )  # type: ignore[return-value]


def _order(anny: FaceModel) -> tuple[np.ndarray, np.ndarray]:
    order = np.random.default_rng(8).permutation(len(anny.template))
    new_index = np.empty(len(order), np.int64)
    new_index[order] = np.arange(len(order))
    return order, new_index[anny.faces.numpy()]


def _expressions(anny: FaceModel) -> np.ndarray:
    """Principal directions of random expressions, with the jaw and its teeth, without gaze."""
    use = [i for i, n in enumerate(anny.expression_names) if not n.startswith(("eyeLook", "mouthClose", "tongue"))]
    one = anny.neutral(len(use))
    expression = torch.zeros_like(one.expression)
    expression[torch.arange(len(use)), torch.tensor(use)] = 1
    moved = anny.head_vertices(type(one)(**{**one.tensors(), "expression": expression})) - anny.template
    return principal_directions(moved.double().numpy(), EXPRESSIONS, 9)
