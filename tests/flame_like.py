"""Make a head in FLAME's schema from the anny model, with other vertices, other joints and other bases.

Identity and expression are linear bases without names. The jaw is a joint that moves skin. Through pose correctives
the lids follow the eyes, and the lips follow the jaw. It contains nothing of FLAME's own."""

import pickle
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mien.face import FaceModel
from mien.face.model import Landmarks
from mien.rotation import matrix_from_axis_angle

IDENTITIES, EXPRESSIONS = 40, 24
_SHIFT = np.array([0.003, -0.021, -0.044])
"""Shift between FLAME's origin and mien's, in metres."""


def flame_like(anny: FaceModel) -> dict[str, np.ndarray]:
    order, faces, _ = _cut(anny)
    template = anny.template.double().numpy()[order]
    weights, jaw, hinge, residual = _joints(anny, order, template)
    posedirs = np.zeros((4, 3, 3, len(order), 3))
    angle = float(anny.joint_rotation_basis[_jaw_open(anny), 2].norm())
    posedirs[1, 2, 1] = residual / np.sin(angle)
    eyes = anny.pose_basis.double().numpy().reshape(3, 3, 3, -1, 3)[1:, :, :, order]  # type: ignore[union-attr]
    posedirs[2:] = eyes
    # The neck twists its skin a little, so that a transposed rotation is noticed.
    posedirs[0, 0, 2] = 0.01 * weights[:, :1] * weights[:, 1:2] * np.array([1.0, 0.3, 0.2])
    expression = _expression_basis(anny, order)
    identity = anny.identity_basis.double().numpy()[:IDENTITIES, order]
    return {
        "v_template": template + _SHIFT, "f": faces.astype(np.uint32),
        "shapedirs": np.moveaxis(np.concatenate([identity, expression]), 0, 2).astype(np.float32),
        "posedirs": np.moveaxis(posedirs.reshape(36, -1, 3), 0, 2).astype(np.float32),
        "J_regressor": _regressor(template, weights, hinge), "weights": weights,
        "kintree_table": np.array([[2**32 - 1, 0, 1, 1, 1], [0, 1, 2, 3, 4]], np.int64),
        "identities": np.array(IDENTITIES),
    }  # fmt: skip


def _cut(anny: FaceModel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the order of the kept vertices, their triangles, and the index of each triangle in the anny model."""
    random = np.random.default_rng(5)
    kept = np.flatnonzero(~anny.region_mask("teeth", "tongue").numpy())
    order = random.permutation(np.unique(anny.faces.numpy()[kept]))
    new_index = np.full(len(anny.template), -1)
    new_index[order] = np.arange(len(order))
    source = random.permutation(kept)
    return order, np.roll(new_index[anny.faces.numpy()[source]], 1, axis=1), source


def exact_landmarks(anny: FaceModel) -> dict[str, Landmarks]:
    """Return anny's landmarks on the other mesh, so that tests need no detector."""
    _, _, source = _cut(anny)
    triangle = torch.full((len(anny.faces),), -1)
    triangle[torch.from_numpy(source)] = torch.arange(len(source))
    return {name: Landmarks(triangle[m.faces], m.barycentric.roll(1, 1)) for name, m in anny.landmarks.items()}


def true_regions(anny: FaceModel) -> np.ndarray:
    """Return the name of the anny region that each triangle belongs to."""
    return np.array(anny.region_names)[anny.face_regions.numpy()[_cut(anny)[2]]]


def write_npz(path: Path, arrays: dict[str, np.ndarray]) -> Path:
    np.savez(path, **arrays)  # pyright: ignore[reportArgumentType]
    return path


def write_pickle(path: Path, arrays: dict[str, np.ndarray]) -> Path:
    """Write the arrays as in FLAME's own files: in chumpy's variables, with a compressed matrix of scipy."""
    variable, matrix = _class("chumpy.ch", "Ch"), _class("scipy.sparse.csc", "csc_matrix")
    content: dict[str, Any] = dict(arrays)
    for name in ("v_template", "shapedirs", "posedirs", "weights"):
        content[name] = variable(x=arrays[name])
    regressor = arrays["J_regressor"]
    column, row = np.nonzero(regressor.T)
    starts = np.concatenate([[0], np.cumsum(np.bincount(column, minlength=regressor.shape[1]))]).astype(np.int32)
    content["J_regressor"] = matrix(
        data=regressor[row, column], indices=row.astype(np.int32), indptr=starts, _shape=regressor.shape, maxprint=50
    )
    content["bs_style"], content["bs_type"] = "lbs", "lrotmin"
    try:
        path.write_bytes(pickle.dumps(content, protocol=2))
    finally:
        for module in ("chumpy.ch", "chumpy", "scipy.sparse.csc", "scipy.sparse", "scipy"):
            sys.modules.pop(module, None)
    return path


def _class(module: str, name: str) -> type:
    """Return a class that a pickle names by a module that does not exist on the reader's machine."""

    class Holder:
        def __init__(self, **state: Any):
            self.__dict__.update(state)

    Holder.__module__, Holder.__qualname__, Holder.__name__ = module, name, name
    parts = module.split(".")
    for end in range(1, len(parts) + 1):
        sys.modules.setdefault(".".join(parts[:end]), types.ModuleType(".".join(parts[:end])))
    setattr(sys.modules[module], name, Holder)
    return Holder


def _jaw_open(anny: FaceModel) -> int:
    return anny.expression_names.index("jawOpen")


def _joints(anny: FaceModel, order: np.ndarray, template: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the weights (root, neck, jaw, eyes), and the jaw's weights, hinge and residual motion of the skin."""
    theirs = anny.skinning_weights.double().numpy()[order]
    hinge = anny.joint_template[2].double().numpy()
    opened = matrix_from_axis_angle(anny.joint_rotation_basis[_jaw_open(anny), 2].double()[None])[0].numpy()
    rigid = (template - hinge) @ (opened - np.eye(3)).T
    moved = anny.expression_basis[_jaw_open(anny)].double().numpy()[order]
    jaw = np.clip((moved * rigid).sum(1) / np.maximum((rigid * rigid).sum(1), 1e-9), 0, 1)
    jaw *= theirs[:, 0]  # neck and eyes keep their weights
    weights = np.stack([theirs[:, 1], theirs[:, 0] - jaw, jaw, theirs[:, 3], theirs[:, 4]], axis=1)
    return weights, jaw, hinge, (moved - jaw[:, None] * rigid) * (theirs[:, 0] > 0.999)[:, None]


def _regressor(template: np.ndarray, weights: np.ndarray, hinge: np.ndarray) -> np.ndarray:
    regressor = np.zeros((5, len(template)))
    regressor[0, np.argsort(template[:, 1])[:40]] = 1 / 40
    between = (weights[:, 0] > 0.3) & (weights[:, 0] < 0.7)
    regressor[1, between] = 1 / between.sum()
    # The smallest mixture of a few dozen vertices that hits the hinge of the jaw.
    near = np.argsort(np.linalg.norm(template - hinge, axis=1))[:60]
    rows = np.concatenate([template[near].T, np.ones((1, 60))])
    regressor[2, near] = np.linalg.lstsq(rows, np.append(hinge, 1), rcond=None)[0]
    for joint in (3, 4):
        ball = weights[:, joint] > 0.5
        regressor[joint, ball] = 1 / ball.sum()
    return regressor


def _expression_basis(anny: FaceModel, order: np.ndarray) -> np.ndarray:
    """Return principal directions of random expressions without jaw and gaze."""
    names = anny.expression_names
    use = [i for i, n in enumerate(names) if not n.startswith(("jaw", "eyeLook", "mouthClose", "tongue"))]
    return principal_directions(anny.expression_basis.double().numpy()[use][:, order], EXPRESSIONS, 6)


def principal_directions(offsets: np.ndarray, count: int, seed: int) -> np.ndarray:
    """Return directions of unit variance [count, v, 3] of random mixtures of offsets [n, v, 3]."""
    random, deltas = np.random.default_rng(seed), offsets.reshape(len(offsets), -1)
    strength = random.uniform(0, 1, (600, len(deltas))) * (random.uniform(0, 1, (600, len(deltas))) < 0.3)
    values, vectors = np.linalg.eigh(deltas @ deltas.T)
    roots = (vectors * np.sqrt(np.maximum(values, 0))) @ vectors.T  # symmetric root of the Gram matrix
    _, sizes, directions = np.linalg.svd(strength @ roots, full_matrices=False)
    mixtures = directions[:count] @ np.linalg.pinv(roots, rcond=1e-6)
    mixtures *= (sizes[:count] / np.sqrt(600))[:, None]
    return (mixtures @ deltas).reshape(count, -1, 3)


def shaped_as_flame(arrays: dict[str, np.ndarray], shape: np.ndarray, offsets: np.ndarray | float = 0.0) -> np.ndarray:
    """Return the vertices at rest [v, 3] with identity, expression and static offsets."""
    return arrays["v_template"] + arrays["shapedirs"].astype(np.float64) @ shape + offsets


def posed_as_flame(
    arrays: dict[str, np.ndarray], pose: np.ndarray, shape: np.ndarray, shift: np.ndarray,
    offsets: np.ndarray | float = 0.0,
) -> np.ndarray:  # fmt: skip
    """Return vertices [v, 3] by the formulas of GaussianAvatars (methods.md A.1), in float64.
    `pose` [5, 3] holds the axis-angles of root, neck, jaw and eyes; `shape` holds all coefficients. Joints are
    regressed from the shaped vertices: identity, expression and static offsets [v, 3]."""
    shaped = shaped_as_flame(arrays, shape, offsets)
    joints = arrays["J_regressor"] @ shaped
    turns = matrix_from_axis_angle(torch.from_numpy(pose)).numpy()
    posed = shaped + arrays["posedirs"].astype(np.float64) @ (turns[1:] - np.eye(3)).ravel()
    chain: list[tuple[np.ndarray, np.ndarray]] = []
    for joint, parent in enumerate((-1, 0, 1, 1, 1)):
        # x -> R x + t, about the joint, then the parent's motion.
        rotation, offset = turns[joint], joints[joint] - turns[joint] @ joints[joint]
        if parent >= 0:
            above, beside = chain[parent]
            rotation, offset = above @ rotation, above @ offset + beside
        chain.append((rotation, offset))
    moved = sum(
        arrays["weights"][:, k, None] * (posed @ rotation.T + offset) for k, (rotation, offset) in enumerate(chain)
    )
    return moved + shift
