"""Read ICT-FaceKit Light (Li et al. 2020, "Learning formation of physically-based face attributes"; MIT licence).

Its file is a packed copy of the model's folder `FaceXModel`, or that folder itself. The model has ARKit's expressions
by name, whole teeth, a tongue and eyeballs, and no joints: neck, jaw and eyes are placed here. The jaw turns teeth and
tongue as the expressions move them, and the lids follow the eyes, as in the default model. Transparent shells around
the eyes, lashes, and the inner layer of the eyeballs are left out.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int

from mien.disk.reading import listed, read_bytes
from mien.errors import UserError
from mien.face.chart import find_outside, unwrap
from mien.face.model import EYE_BACK, FaceModel
from mien.face.models.arkit_head import (
    JAW_EXPRESSIONS,
    PINNED,
    jaw_motion,
    joint_fields,
    lid_correctives,
    skinning,
)
from mien.face.models.npz import read_npz, readable
from mien.face.models.schema import in_iris, rounded

VERTICES, QUADS = 26719, 26384
"""Vertices and faces of the model. Faces are quads; a triangle has -1 as its last corner."""
REGIONS = ("skin", "neck", "eyes", "irises", "teeth", "tongue", "mouth", "eye_sockets")
"""Regions that follow from the order of the vertices. `mien.tracking.landmarks` finds more, by landmarks."""
PACKED_KEYS = ("v", "f_quad", "identity", "expression", "expression_names")
NEUTRAL = "generic_neutral_mesh.obj"
"""File of the folder FaceXModel that holds the mean head."""

_METERS = 0.01  # metres in the model's unit
_MOUTH, _SOCKETS, _GUMS, _TEETH = (11248, 13294), (13294, 14062), (14062, 17039), (17039, 21451)
_EYEBALLS = {"left_eye": (21451, 22221), "right_eye": (23021, 23791)}
"""Ranges of vertices, as the model's documentation lists them. Of each eyeball, the outer layer."""
_KEPT = ((0, 21451), *_EYEBALLS.values())
_UNSEEN = ("PupilDilate_L", "PupilDilate_R")  # expressions of the inner layer of the eyeballs, which is left out
_WHOLE = ("browInnerUp", "cheekPuff")  # expressions of ARKit that the model has as two halves, which add up to them
_NECK_PLANES = (-0.1185, -0.1688)
"""Values of y + 0.5 z, in metres in the head frame, at which the neck's weight is 0 and 1: the default model's."""
_NECK_PIVOT = (-0.1359, -0.0136)  # height and depth of the neck joint in the head frame, in metres: the default model's
_LOWER_MOTION = 1.0
"""Motion in the model's unit, for a jaw that is wide open, from which teeth and tongue belong to the jaw."""
_MAX_IDENTITIES = 200
_MAX_VALUE = 1e3


@dataclass(frozen=True, eq=False)
class IctFile:
    """The checked arrays of ICT-FaceKit, in its own units and its own order of vertices."""

    template: Float[np.ndarray, "v 3"]
    quads: Int[np.ndarray, "q 4"]
    identity: Float[np.ndarray, "i v 3"]
    expression: dict[str, Float[np.ndarray, "v 3"]]


def is_ict_folder(path: Path) -> bool:
    """Whether a folder is FaceXModel of ICT-FaceKit."""
    return (path / NEUTRAL).is_file()


def read_ict(path: Path) -> IctFile:
    """Read the packed .npz, or the folder FaceXModel."""
    ict = _read_folder(path) if path.is_dir() else _read_packed(path)
    if ict.template.shape != (VERTICES, 3) or ict.quads.shape != (QUADS, 4):
        raise UserError(
            f"{path}: has {len(ict.template):,} vertices and {len(ict.quads):,} faces, and ICT-FaceKit Light has "
            f"{VERTICES:,} and {QUADS:,}; download it again"
        )
    if ict.quads.min() < -1 or ict.quads.max() >= VERTICES or ict.quads[:, :3].min() < 0:
        raise UserError(f"{path}: a face has a corner that is no vertex; download it again")
    wanted = {"eyeBlink_L", "eyeBlink_R", *JAW_EXPRESSIONS}
    wanted |= {f"eyeLook{way}_{side}" for way in ("Up", "Down", "In", "Out") for side in "LR"}
    if missing := sorted(wanted - ict.expression.keys()):
        raise UserError(f"{path}: has no expression {missing[0]}; download it again")
    if not len(ict.identity):
        raise UserError(f"{path}: has no identity directions; download it again")
    for values in (ict.template, ict.identity, *ict.expression.values()):
        if values.shape[-2:] != (VERTICES, 3) or not np.isfinite(values).all() or np.abs(values).max() > _MAX_VALUE:
            raise UserError(f"{path}: holds numbers that are not those of a head; download it again")
    return ict


def ict_face_model(ict: IctFile, name: str, path: Path) -> FaceModel:
    """Convert ICT-FaceKit to a face model without landmarks."""
    kept = np.concatenate([np.arange(start, end) for start, end in _KEPT])
    new_index = np.full(VERTICES + 1, -1)
    new_index[kept] = np.arange(len(kept))
    faces = _triangles(ict.quads)
    faces = new_index[faces[np.isin(faces, kept).all(1)]]
    template = _METERS * ict.template[kept]
    parts = {name: _among(kept, *ends) for name, ends in _EYEBALLS.items()}
    centers = np.stack([(template[eye].min(0) + template[eye].max(0)) / 2 for eye in parts.values()])
    origin = centers.mean(0) - np.array([0.0, 0.0, EYE_BACK])
    template, centers = template - origin, centers - origin
    if centers[0, 0] <= 0 or not find_outside(template, faces).any():
        raise UserError(f"{path}: its vertices do not have the order of ICT-FaceKit; download it again")
    raw = _by_arkit({key: _METERS * delta[kept] for key, delta in ict.expression.items()})
    inside = _among(kept, _GUMS[0], _TEETH[1])
    lower = inside & (np.linalg.norm(raw["jawOpen"], axis=1) > _LOWER_MOTION * _METERS)
    parts |= {"lower": lower, "inside": inside, "sockets": _among(kept, *_SOCKETS), "mouth": _among(kept, *_MOUTH)}
    parts["teeth"] = _among(kept, *_TEETH)
    parts["head"] = ~(inside | parts["left_eye"] | parts["right_eye"] | parts["mouth"] | parts["sockets"])
    names = tuple(raw)
    hinge, rotations, translations = jaw_motion(template, raw, lower & parts["teeth"])
    joints = np.stack([np.zeros(3), np.array([0.0, *_NECK_PIVOT]), hinge, *centers])
    identity = _METERS * ict.identity[:, kept]
    correctives = lid_correctives(template, raw, parts)
    deltas = np.stack(list(raw.values()))
    deltas[:, inside | parts["left_eye"] | parts["right_eye"]] = 0
    deltas[[each.startswith("eyeLook") for each in names]] = 0
    eyes = {"left_eye": parts["left_eye"], "right_eye": parts["right_eye"]}
    rigid = {"head": inside | parts["mouth"], "jaw": lower, **eyes}
    weights = skinning(template[:, 1] + 0.5 * template[:, 2], _NECK_PLANES, rigid)
    ring = (weights[:, 1] > 0.3) & (weights[:, 1] < 0.7)
    pivots = {"neck": ring, "jaw": lower & parts["teeth"], **eyes}
    uv, uv_faces = unwrap(template, faces)
    return FaceModel(
        name=name,
        template=rounded(template),
        faces=torch.from_numpy(faces),
        uv=rounded(uv),
        uv_faces=torch.from_numpy(uv_faces),
        region_names=REGIONS,
        face_regions=torch.from_numpy(_regions(template, faces, weights, parts, centers)),
        identity_basis=rounded(identity),
        expression_basis=rounded(deltas),
        expression_names=names,
        expression_bounds=torch.tensor(
            [[0.0, 0.0 if each in PINNED or each.startswith("eyeLook") else 1.0] for each in names]
        ),
        joint_template=rounded(joints),
        **joint_fields(identity, names, (rotations, translations), pivots),
        skinning_weights=rounded(weights),
        pose_basis=rounded(correctives),
        landmarks={},
    )


def _read_packed(path: Path) -> IctFile:
    with readable(path, "ICT-FaceKit", "give its folder FaceXModel"):
        _, found = read_npz(path, PACKED_KEYS, texts=("expression_names",))
        for key in PACKED_KEYS:
            if key not in found:
                raise ValueError(f"has no {key!r}")
        names, expression = found["expression_names"], found["expression"].astype(np.float32)
        if names.ndim != 1 or len(names) != len(expression) or found["identity"].ndim != 3:
            raise ValueError("its expressions do not fit their names")
        if len(found["identity"]) > _MAX_IDENTITIES or found["f_quad"].dtype.kind not in "iu":
            raise ValueError("its arrays do not have the shapes of the packed copy")
        by_name = {str(each): delta for each, delta in zip(names, expression, strict=True)}
        identity = found["identity"].astype(np.float32)
        return IctFile(found["v"].astype(np.float64), found["f_quad"].astype(np.int64), identity, by_name)


def _read_folder(path: Path) -> IctFile:
    """Read the .obj files of the folder FaceXModel: the mean, identity000.obj and so on, and expressions by name."""
    template, quads = read_obj(path / NEUTRAL)
    identity = []
    while (path / f"identity{len(identity):03d}.obj").is_file() and len(identity) < _MAX_IDENTITIES:
        identity.append(read_obj_positions(path / f"identity{len(identity):03d}.obj", len(template)) - template)
    expression = {
        file.stem: (read_obj_positions(file, len(template)) - template).astype(np.float32)
        for file in listed(path, "*.obj")
        if file.name != NEUTRAL and not file.stem.startswith("identity")
    }
    shape = (0, *template.shape)
    return IctFile(template, quads, np.array(identity or np.zeros(shape), np.float32), expression)


def _triangles(quads: Int[np.ndarray, "q 4"]) -> Int[np.ndarray, "f 3"]:
    whole = quads[quads[:, 3] >= 0]
    return np.concatenate([quads[:, :3], whole[:, [0, 2, 3]]])


def _among(kept: Int[np.ndarray, " v"], start: int, end: int) -> np.ndarray:
    return (kept >= start) & (kept < end)


def _by_arkit(raw: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the expressions by ARKit's names, in alphabetical order. Names that ARKit lacks keep their sides."""
    found: dict[str, np.ndarray] = {}
    for name, delta in raw.items():
        if name in _UNSEEN:
            continue
        stem, _, side = name.partition("_")
        ours = stem if stem in _WHOLE or not side else stem + {"L": "Left", "R": "Right"}.get(side, side)
        found[ours] = found[ours] + delta if ours in found else delta.astype(np.float64)
    return {name: found[name] for name in sorted(found)}


def _regions(
    template: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], weights: Float[np.ndarray, "v 5"],
    parts: dict[str, np.ndarray], centers: Float[np.ndarray, "2 3"],
) -> Int[np.ndarray, " f"]:  # fmt: skip
    regions = np.zeros(len(faces), np.int64)
    tongue = parts["inside"] & ~parts["teeth"]
    named = {"neck": weights[:, 1] > 0.5, "teeth": parts["teeth"], "tongue": tongue, "mouth": parts["mouth"]}
    for name, part in {**named, "eye_sockets": parts["sockets"]}.items():
        regions[part[faces].all(1)] = REGIONS.index(name)
    for side, center in zip(("left_eye", "right_eye"), centers, strict=True):
        ball = parts[side][faces].all(1)
        regions[ball] = REGIONS.index("eyes")
        regions[ball & in_iris(template, center)[faces].all(1)] = REGIONS.index("irises")
    return regions


def read_obj(path: Path) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "q 4"]]:
    """Return positions and faces of three or four corners; -1 is the last corner of a triangle."""
    with readable(path, ".obj", "download it again"):
        lines = _lines(path)
        corners = [[int(part.split(b"/")[0]) - 1 for part in line.split()[1:]] for line in lines if line[:2] == b"f "]
        if not corners or not all(len(each) in (3, 4) for each in corners):
            raise ValueError("its faces do not have three or four corners")
        return _positions(lines), np.array([(*each, -1)[:4] for each in corners], np.int64)


def read_obj_positions(path: Path, count: int) -> Float[np.ndarray, "v 3"]:
    """Return the positions of a file that has `count` of them."""
    with readable(path, ".obj", "download it again"):
        lines = _lines(path)
        positions = _positions(lines)
        if len(positions) != count:
            raise ValueError(f"{len(positions):,} vertices instead of {count:,}")
        return positions


def _lines(path: Path) -> list[bytes]:
    return read_bytes(path, 64 << 20).splitlines()  # those of ICT-FaceKit have 3 MB


def _positions(lines: list[bytes]) -> Float[np.ndarray, "v 3"]:
    rows = (line.split()[1:4] for line in lines if line[:2] == b"v ")
    positions = np.array([[float(value) for value in row] for row in rows])
    if positions.ndim != 2 or positions.shape[1] != 3:
        raise ValueError("a vertex does not have three coordinates")
    return positions
