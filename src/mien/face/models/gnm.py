"""Read GNM Head (Google, Apache-2.0): the file `gnm_head.npz`, to its published schema.

GNM has a template, linear bases of identity and expression in standard deviations, four joints (the neck as the root,
the head on it, the eyes on the head), which follow identity, and linear blend skinning. It has no jaw joint, because
expressions open the mouth. Its users fetch the file themselves, and mien contains nothing of it.

GNM's chain starts at the shoulders, mien's at the head. As with FLAME, a head joint turned by R becomes a mien head
turned by R (after GNM's neck), with a neck turned by the inverse of R about the same point.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int

from mien.disk.reading import is_plain_name
from mien.errors import UserError
from mien.face.chart import find_outside, unwrap
from mien.face.model import EYE_BACK, FaceModel
from mien.face.models.npz import read_npz, readable
from mien.face.models.schema import (
    LARGEST_COEFFICIENT,
    check_arrays,
    check_head,
    check_indices,
    check_numbers,
    float_tensor,
    rounded,
)

REGIONS = ("skin", "neck", "eyes", "irises", "teeth", "tongue", "mouth")
"""Regions that follow from the groups of vertices. `mien.tracking.landmarks` finds more, by landmarks."""
_GROUPS = {
    "teeth": ("upper_teeth_and_gums", "lower_teeth_and_gums"),
    "tongue": ("tongue",),
    "mouth": ("mouth_sock",),
    "eyes": ("left_eye", "right_eye"),
    "irises": ("irises", "pupils"),
}
"""GNM's groups of vertices for each of the regions. Later ones win."""
_JOINTS, _PARENTS = ("neck", "head", "left_eye", "right_eye"), {"head": "neck", "left_eye": "head", "right_eye": "head"}
_SHAPES = {
    "template_vertex_positions": "v 3", "triangles": "f 3", "vertex_identity_basis": "i v 3",
    "expression_basis": "e v 3", "template_joint_positions": "4 3", "joint_identity_basis": "i 4 3",
    "skinning_weights": "4 v", "joint_parent_indices": "4",
}  # fmt: skip
_OPTIONAL = ("pose_correctives_regressor", "vertex_groups", "triangle_uvs")
_TEXTS = ("joint_names", "expression_names", "vertex_group_names")


@dataclass(frozen=True, eq=False)
class GnmFile:
    """The checked arrays of a file in GNM's schema, with the joints in the order neck, head, left and right eye."""

    template: Float[np.ndarray, "v 3"]
    """Positions in metres, +x to the subject's left, +y up, +z ahead."""
    faces: Int[np.ndarray, "f 3"]
    identity: Float[np.ndarray, "i v 3"]
    expression: Float[np.ndarray, "e v 3"]
    expression_names: tuple[str, ...]
    joints: Float[np.ndarray, "4 3"]
    joint_identity: Float[np.ndarray, "i 4 3"]
    weights: Float[np.ndarray, "v 4"]
    groups: dict[str, np.ndarray]
    """Vertices of each group."""
    corner_uv: Float[np.ndarray, "f 3 2"] | None
    """Texture coordinates of the triangles' corners."""


def is_gnm(names: list[str]) -> bool:
    """Whether an archive with these members is in GNM's schema."""
    return "template_vertex_positions" in names


def read_gnm(path: Path) -> GnmFile:
    """Read `gnm_head.npz`."""
    wanted = (*_SHAPES, *_OPTIONAL, *_TEXTS)
    with readable(path, "GNM Head", "download it again"):
        _, arrays = read_npz(path, wanted, texts=_TEXTS)
    missing = "it is not in GNM's schema; give gnm_head.npz of version 3"
    sizes = check_arrays(path, arrays, _SHAPES, missing, "download it again")
    joint_names = _names(path, "joint_names", arrays, 4)
    if sorted(joint_names) != sorted(_JOINTS):
        raise UserError(
            f"{path}: 'joint_names' are {', '.join(joint_names)[:200]}, but GNM Head has {', '.join(_JOINTS)}"
        )
    order = [joint_names.index(name) for name in _JOINTS]
    parents = dict(zip(joint_names, arrays["joint_parent_indices"].tolist(), strict=True))
    if any(parents[child] != joint_names.index(parent) for child, parent in _PARENTS.items()):
        raise UserError(f"{path}: 'joint_parent_indices' are not those of GNM Head; download it again")
    faces = check_indices(path, "triangles", arrays["triangles"], sizes["v"])
    gnm = GnmFile(
        arrays["template_vertex_positions"].astype(np.float64), faces,
        arrays["vertex_identity_basis"].astype(np.float32), arrays["expression_basis"].astype(np.float32),
        _names(path, "expression_names", arrays, sizes["e"]),
        arrays["template_joint_positions"].astype(np.float64)[order],
        arrays["joint_identity_basis"].astype(np.float64)[:, order],
        arrays["skinning_weights"].astype(np.float64)[order].T,
        _groups(path, arrays, sizes["v"]), _corner_uv(path, arrays, sizes["f"]),
    )  # fmt: skip
    _check_sense(path, gnm)
    if np.any(arrays.get("pose_correctives_regressor", 0)):
        raise UserError(f"{path}: has pose correctives, which version 3 has none of; give gnm_head.npz of version 3")
    return gnm


def gnm_face_model(gnm: GnmFile, name: str) -> FaceModel:
    """Convert a file in GNM's schema to a face model without landmarks."""
    neck, left, right = (_JOINTS.index(each) for each in ("head", "left_eye", "right_eye"))
    moving = [neck, left, right]
    origin = gnm.joints[[left, right]].mean(0) - np.array([0.0, 0.0, EYE_BACK])
    e, i = len(gnm.expression), len(gnm.identity)
    joints, joint_identity, weights = np.zeros((4, 3)), np.zeros((i, 4, 3)), np.zeros((len(gnm.template), 4))
    joints[1:] = gnm.joints[moving] - origin
    joint_identity[:, 1:] = gnm.joint_identity[:, moving]
    # GNM's head is mien's head, and GNM's root is mien's neck. Both turn about GNM's head joint.
    weights[:, 0], weights[:, 1] = gnm.weights[:, neck], gnm.weights[:, 0]
    weights[:, 2:] = gnm.weights[:, [left, right]]
    if gnm.corner_uv is None:
        uv, uv_faces = unwrap(gnm.template - origin, gnm.faces)
    else:
        flat, places = np.unique(gnm.corner_uv.reshape(-1, 2), axis=0, return_inverse=True)
        uv, uv_faces = flat, places.reshape(-1, 3).astype(np.int64)
    return FaceModel(
        name=name,
        template=rounded(gnm.template - origin),
        faces=torch.from_numpy(gnm.faces),
        uv=rounded(uv),
        uv_faces=torch.from_numpy(uv_faces),
        region_names=REGIONS,
        face_regions=torch.from_numpy(_regions(gnm)),
        identity_basis=float_tensor(gnm.identity),
        expression_basis=float_tensor(gnm.expression),
        expression_names=gnm.expression_names,
        expression_bounds=LARGEST_COEFFICIENT * torch.tensor([[-1.0, 1.0]]).repeat(e, 1),
        expression_sigmas=torch.ones(e),
        joint_names=("head", "neck", "left_eye", "right_eye"),
        joint_parents=(-1, 0, 0, 0),
        joint_free=(False, True, True, True),
        joint_template=rounded(joints),
        joint_identity_basis=rounded(joint_identity),
        joint_rotation_basis=torch.zeros(e, 4, 3),
        joint_translation_basis=torch.zeros(e, 4, 3),
        skinning_weights=float_tensor(weights),
        landmarks={},
    )


def _names(path: Path, key: str, arrays: dict[str, np.ndarray], count: int) -> tuple[str, ...]:
    names = tuple(map(str, arrays[key].ravel().tolist())) if key in arrays else ()
    plain = all(is_plain_name(name) and len(name) <= 60 for name in names)
    if len(names) != count or len(set(names)) != count or not plain:
        raise UserError(f"{path}: {key!r} should be {count} different names; download it again")
    return names


def _groups(path: Path, arrays: dict[str, np.ndarray], vertices: int) -> dict[str, np.ndarray]:
    groups = arrays.get("vertex_groups")
    if groups is None or groups.ndim != 2 or groups.shape[1] != vertices or groups.dtype.kind not in "iufb":
        raise UserError(f"{path}: has no 'vertex_groups' [g {vertices}]; download it again")
    names = _names(path, "vertex_group_names", arrays, len(groups))
    found = dict(zip(names, groups > 0.5, strict=True))
    for name in (each for named in _GROUPS.values() for each in named):
        if name not in found or not found[name].any():
            raise UserError(f"{path}: 'vertex_groups' has no group {name!r}; give gnm_head.npz of version 3")
    return found


def _corner_uv(path: Path, arrays: dict[str, np.ndarray], faces: int) -> Float[np.ndarray, "f 3 2"] | None:
    """Texture coordinates of corners. None if the file has none, or some in other tiles than the first."""
    given = arrays.get("triangle_uvs")
    if given is None:
        return None
    if given.shape != (faces, 3, 2) or given.dtype.kind != "f":
        raise UserError(
            f"{path}: 'triangle_uvs' is {list(given.shape)}, but should be [{faces}, 3, 2]; download it again"
        )
    check_numbers(path, "triangle_uvs", given)
    return given.astype(np.float64) if given.min() >= 0 and given.max() <= 1 else None


def _check_sense(path: Path, gnm: GnmFile) -> None:
    check_head(path, ("template_vertex_positions", "skinning_weights"), gnm.template, gnm.weights)
    eyes = gnm.joints[2:]
    ahead = eyes[:, 2].mean() > gnm.template[gnm.weights[:, 1] > 0.5][:, 2].mean()
    if eyes[0, 0] <= eyes[1, 0] or not ahead:
        raise UserError(f"{path}: the eyes are not where GNM's are: +x is the subject's left, +z is ahead")
    origin = eyes.mean(0) - np.array([0.0, 0.0, EYE_BACK])
    if not find_outside(gnm.template - origin, gnm.faces).any():
        raise UserError(f"{path}: 'triangles' has none that faces outwards; download it again")


def _regions(gnm: GnmFile) -> Int[np.ndarray, " f"]:
    regions = np.zeros(len(gnm.faces), np.int64)
    regions[(gnm.weights[:, 0] > 0.5)[gnm.faces].all(1)] = REGIONS.index("neck")
    for region, names in _GROUPS.items():
        members = np.any([gnm.groups[name] for name in names], axis=0)
        regions[members[gnm.faces].all(1)] = REGIONS.index(region)
    return regions
