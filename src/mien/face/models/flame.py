"""Read a head model in FLAME's schema (Li et al. 2017, "Learning a model of facial shape and expression ...").

The schema is that of SMPL: a template; one linear basis whose first columns are identity and whose last are expression;
joints regressed from vertices; correctives linear in the joints' rotation matrices; linear blend skinning. Users have
to fetch FLAME's own files themselves (flame.is.tue.mpg.de) and follow their licence. Mien ships none of them, and
accepts any model in this schema.

FLAME's chain starts at the shoulders: root, neck (which turns the whole head), then jaw and eyes. A mien head starts at
the head, so that its pose is the head's pose. The same motions result from the other end. A FLAME neck joint turned by
R becomes a mien head turned by R (after FLAME's root), with a neck turned by the inverse of R about the same point.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int

from mien.errors import UserError
from mien.face.chart import find_outside, unwrap
from mien.face.model import EYE_BACK, JOINTS, FaceModel
from mien.face.models.inert_pickle import read_inert_pickle
from mien.face.models.npz import read_npz, readable
from mien.face.models.schema import (
    LARGEST_COEFFICIENT,
    check_arrays,
    check_head,
    check_indices,
    check_numbers,
    float_tensor,
    in_iris,
    rounded,
)

REGIONS = ("skin", "neck", "eyes", "irises")
"""Regions that follow from skinning weights, beside `teeth`. `mien.tracking.landmarks` finds more, by landmarks."""

_CHAIN = (-1, 0, 1, 1, 1)  # parents in FLAME's chain: the root, the neck on it, jaw and eyes on the neck
_TURNED = (1, 2, 3, 4)  # FLAME's joints about which mien's neck, jaw and eyes turn
_SPLITS = {400: 300}  # number of identity directions, by the number of columns of the basis: FLAME 2020 and 2023
_SHAPES = {
    "v_template": "v 3", "f": "f 3", "shapedirs": "v 3 n", "posedirs": "v 3 36", "J_regressor": "5 v", "weights": "v 5",
}  # fmt: skip

_KEYS = frozenset({*_SHAPES, "kintree_table", "identities", "vt", "ft"})
_OTHERS = frozenset({"lmk_face_idx", "lmk_bary_coords", "mean"})  # keys by which FLAME's other files are recognised
_MAX_NAME_LENGTH, _MAX_NAMES = 40, 20  # most characters of a name, and most names, that a message shows


@dataclass(frozen=True, eq=False)
class FlameFile:
    """The checked arrays of a file in FLAME's schema."""

    template: Float[np.ndarray, "v 3"]
    """Positions in metres, +x to the subject's left, +y up, +z ahead."""
    faces: Int[np.ndarray, "f 3"]
    identity: Float[np.ndarray, "i v 3"]
    expression: Float[np.ndarray, "e v 3"]
    correctives: Float[np.ndarray, "36 v 3"]
    """Factors of R - I, row by row, of neck, jaw, left eye, right eye."""
    regressor: Float[np.ndarray, "5 v"]
    weights: Float[np.ndarray, "v 5"]
    uv: Float[np.ndarray, "u 2"] | None
    """Texture coordinates, v upwards."""
    uv_faces: Int[np.ndarray, "f 3"] | None
    teeth: int = 0
    """Number of triangles of teeth, which are the last (`with_teeth`)."""


def read_flame(path: Path) -> FlameFile:
    """Read a .npz or .pkl in FLAME's schema. Reading a pickle runs none of its code."""
    names, arrays = _arrays_of(path)
    missing = f"it is not in FLAME's schema; {_remedy(names)}"
    sizes = check_arrays(path, arrays, _SHAPES, missing, "give a head model in FLAME's schema")
    _check_chain(path, arrays.get("kintree_table"))
    split = _identities(path, arrays, sizes["n"])
    faces = check_indices(path, "f", arrays["f"], sizes["v"])
    uv, uv_faces = (arrays["vt"], arrays["ft"]) if {"vt", "ft"} <= arrays.keys() else (None, None)
    if uv is not None and uv_faces is not None:
        numbers = uv.dtype.kind in "iuf" and uv_faces.dtype.kind in "iuf"
        if uv.ndim != 2 or uv.shape[1] != 2 or uv_faces.shape != faces.shape or not numbers:
            raise UserError(f"{path}: 'vt' {uv.shape} and 'ft' {uv_faces.shape} are not texture coordinates of 'f' "
                            f"{faces.shape}; leave both out, and mien makes them")  # fmt: skip
        check_numbers(path, "vt", uv)
        check_numbers(path, "ft", uv_faces)
        uv_faces = check_indices(path, "ft", uv_faces, len(uv))
    shapes = np.moveaxis(arrays["shapedirs"], 2, 0).astype(np.float64)
    flame = FlameFile(
        arrays["v_template"].astype(np.float64), faces, shapes[:split], shapes[split:],
        np.moveaxis(arrays["posedirs"], 2, 0).astype(np.float64), arrays["J_regressor"].astype(np.float64),
        arrays["weights"].astype(np.float64), uv, uv_faces,
    )  # fmt: skip
    _check_sense(path, flame)
    return flame


def flame_face_model(flame: FlameFile, name: str, shareable: bool = False) -> FaceModel:
    """Convert a file in FLAME's schema to a face model without landmarks; `shareable` as in `FaceModel`."""
    eyes, centers = _eyeballs(flame)
    origin = _origin(centers)
    correctives = flame.correctives.reshape(4, 3, 3, -1, 3).copy()
    correctives[0] = correctives[0].swapaxes(0, 1)  # for the inverse of the neck's rotation
    if flame.uv is None or flame.uv_faces is None:
        uv, uv_faces = unwrap(flame.template - origin, flame.faces)
    else:
        uv, uv_faces = flame.uv, flame.uv_faces
    e = len(flame.expression)
    return FaceModel(
        name=name,
        template=rounded(flame.template - origin),
        faces=torch.from_numpy(flame.faces),
        uv=rounded(uv),
        uv_faces=torch.from_numpy(uv_faces),
        region_names=(*REGIONS, "teeth") if flame.teeth else REGIONS,
        face_regions=torch.from_numpy(_regions(flame, eyes, centers)),
        identity_basis=float_tensor(flame.identity),
        expression_basis=float_tensor(flame.expression),
        expression_names=tuple(f"expression_{index:03d}" for index in range(e)),
        expression_bounds=LARGEST_COEFFICIENT * torch.tensor([[-1.0, 1.0]]).repeat(e, 1),
        expression_sigmas=torch.ones(e),
        pose_basis=float_tensor(correctives.reshape(36, -1, 3)),
        landmarks={},
        shareable=shareable,
        flame_origin=float_tensor(origin),
        **_skeleton(flame, origin),
    )


def _skeleton(flame: FlameFile, origin: Float[np.ndarray, " 3"]) -> dict[str, Any]:
    """Return the joints of the face model and their skinning weights, as fields of `FaceModel`.

    FLAME's root segment is mien's neck and its neck segment is mien's head. Both turn about FLAME's neck joint.

    FLAME regresses its joints from the vertices with their expression, so that an expression moves the joint about
    which a part turns. Three joints in a chain do that here. The first, `to_NAME`, shifts by the joint's motion m, the
    second, NAME, turns about the joint at rest, and the third, `from_NAME`, shifts by -m and moves the skin:
    x -> R (x - m - joint) + joint + m. The last joint, `root`, moves nothing. It is FLAME's root joint, which other
    programs need to place the head.
    """
    names, parents, free = ["head"], [-1], [False]
    # FLAME's joint, and the sign of the shift by its motion. None for the head, which stays where it is.
    sources: list[tuple[int, int] | None] = [None]
    for name, joint in zip(JOINTS[1:], _TURNED, strict=True):
        first = len(names)
        names += [f"to_{name}", name, f"from_{name}"]
        parents += [0, first, first + 1]
        free += [False, True, False]
        sources += [(joint, 1), (joint, 0), (joint, -1)]
    names, parents, free, sources = [*names, "root"], [*parents, 0], [*free, False], [*sources, (0, 1)]
    e, i, v, k = len(flame.expression), len(flame.identity), len(flame.template), len(names)
    template, identity, regressor = np.zeros((k, 3)), np.zeros((i, k, 3)), np.zeros((k, v))
    shifts, weights = np.zeros((e, k, 3)), np.zeros((v, k))
    weights[:, 0] = flame.weights[:, 1]
    for index, (source, name) in enumerate(zip(sources, names, strict=True)):
        if source is None:
            continue
        joint, sign = source
        shifts[:, index] = sign * np.einsum("v,evc->ec", flame.regressor[joint], flame.expression)
        # Joints that only shift need no place of their own, which would only cost precision.
        if free[index] or name == "root":
            template[index] = flame.regressor[joint] @ flame.template - origin
            identity[:, index] = np.einsum("v,ivc->ic", flame.regressor[joint], flame.identity)
            regressor[index] = flame.regressor[joint]
        if sign == -1:
            weights[:, index] = flame.weights[:, 0 if name == "from_neck" else joint]
    return {
        "joint_names": tuple(names),
        "joint_parents": tuple(parents),
        "joint_free": tuple(free),
        "joint_template": rounded(template),
        "joint_identity_basis": rounded(identity),
        "joint_rotation_basis": torch.zeros(e, k, 3),
        "joint_translation_basis": rounded(shifts),
        "skinning_weights": float_tensor(weights),
        "joint_regressor": float_tensor(regressor),
    }


def _regions(flame: FlameFile, eyes: list[np.ndarray], centers: Float[np.ndarray, "2 3"]) -> Int[np.ndarray, " f"]:
    regions = np.zeros(len(flame.faces), np.int64)
    regions[len(regions) - flame.teeth :] = len(REGIONS)
    regions[(flame.weights[:, 0] > 0.5)[flame.faces].all(1)] = REGIONS.index("neck")
    for ball, center in zip(eyes, centers, strict=True):
        triangles = ball[flame.faces].all(1)
        regions[triangles] = REGIONS.index("eyes")
        regions[triangles & in_iris(flame.template, center)[flame.faces].all(1)] = REGIONS.index("irises")
    return regions


def _arrays_of(path: Path) -> tuple[list[str], dict[str, np.ndarray]]:
    """Return the names of all entries of the file, and those of its arrays that the schema has."""
    if not path.is_file():
        raise UserError(f"{path}: no such file; give FLAME's own .pkl (generic_model.pkl, flame2023.pkl) or a .npz")
    if path.suffix.lower() == ".npz":
        with readable(path, ".npz", "save plain arrays with numpy.savez"):
            return read_npz(path, _KEYS)
    if path.suffix.lower() in (".pkl", ".pickle"):
        found = {key: np.asarray(value) for key, value in read_inert_pickle(path, _KEYS | _OTHERS).items()}
        return list(found), found
    raise UserError(f"{path}: is neither .npz nor .pkl; give a head model in FLAME's schema as one of these")


def _remedy(names: list[str]) -> str:
    if {"lmk_face_idx", "lmk_bary_coords"} & set(names):
        return "this is a landmark embedding: give the model itself (generic_model.pkl or flame2023.pkl)"
    if {"mean", "tex_dir"} & set(names):
        return "this is FLAME's texture space: give the model itself (generic_model.pkl or flame2023.pkl)"
    here = ", ".join(name[:_MAX_NAME_LENGTH] for name in sorted(names)[:_MAX_NAMES]) or "nothing"
    return f"it needs {', '.join(_SHAPES)} and kintree_table (here: {here})"


def _check_chain(path: Path, table: np.ndarray | None) -> None:
    if table is None:
        raise UserError(f"{path}: has no 'kintree_table', the list of each joint's parent; add FLAME's")
    # The root's parent is -1, or 2**32 - 1 if it was written as unsigned.
    fits = table.ndim == 2 and len(table) > 0 and table.dtype.kind in "iuf" and bool((np.abs(table) < 2**33).all())
    parents = table[0].astype(np.int64) if fits else np.zeros(0)
    parents = np.where(parents == 2**32 - 1, -1, parents)
    if tuple(parents) != _CHAIN:
        raise UserError(
            f"{path}: 'kintree_table' gives the joints the parents {tuple(parents.tolist())}, but FLAME's are {_CHAIN} "
            "(root; neck; jaw, left and right eye on the neck); body models (SMPL, SMPL-X) do not fit: give a head"
        )


def _identities(path: Path, arrays: dict[str, np.ndarray], columns: int) -> int:
    given = arrays.get("identities")
    if given is not None and (given.size != 1 or given.dtype.kind not in "iu"):
        raise UserError(f"{path}: 'identities' is {given.dtype} {list(given.shape)}, but should be one whole number")
    split = _SPLITS.get(columns) if given is None else int(given.item())
    if split is None:
        raise UserError(
            f"{path}: 'shapedirs' has {columns} directions; FLAME's 400 are 300 of identity, then 100 of expression. "
            "Say how many of yours are identity: add a number 'identities' to the .npz"
        )
    if not 0 < split < columns:
        raise UserError(
            f"{path}: 'identities' takes {split} of the {columns} directions of 'shapedirs', but identity and "
            "expression need at least one each; correct it"
        )
    return split


def _check_sense(path: Path, flame: FlameFile) -> None:
    check_head(path, ("v_template", "weights"), flame.template, flame.weights)
    left, right = (flame.weights[:, joint] > 0.5 for joint in (3, 4))
    if not left.any() or not right.any():
        raise UserError(f"{path}: 'weights' assign no vertex to one of the eyes: the model needs both eyeballs")
    ahead = flame.template[left | right].mean(0) - flame.template[flame.weights[:, 1] > 0.5].mean(0)
    if flame.template[left, 0].mean() <= flame.template[right, 0].mean() or ahead[2] <= 0:
        raise UserError(
            f"{path}: the eyes are not where FLAME's are; 'v_template' needs +x to the subject's left, +y up, +z ahead"
        )
    if not find_outside(flame.template - _origin(_eyeballs(flame)[1]), flame.faces).any():
        raise UserError(f"{path}: 'f' has no triangle that faces outwards; give FLAME's triangles")


def _eyeballs(flame: FlameFile) -> tuple[list[np.ndarray], Float[np.ndarray, "2 3"]]:
    """Masks [v] of the vertices of the left and the right eyeball, and their centres in metres."""
    eyes = [flame.weights[:, joint] > 0.5 for joint in (3, 4)]
    return eyes, np.stack([flame.template[eye].mean(0) for eye in eyes])


def _origin(centers: Float[np.ndarray, "2 3"]) -> Float[np.ndarray, " 3"]:
    """The head frame's origin in FLAME's coordinates, in metres: behind the midpoint of the eyeballs' centres."""
    return centers.mean(0) - np.array([0.0, 0.0, EYE_BACK])
