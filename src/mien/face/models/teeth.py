"""The teeth that VHAP and GaussianAvatars add to FLAME: two troughs of triangles behind the lips.

Their 120 vertices are made from the outer ring of the lips, eight rows of 15 each, and their 168 triangles have a fixed
order, by which Gaussians of their avatars are bound. FLAME itself has no teeth. The order is that of GaussianAvatars
since May 2024; before that, one triangle (133 of the 168) had another corner.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from mien.errors import UserError
from mien.face.models.flame import FlameFile

VERTICES, FACES = 5023, 9976
"""Vertices and triangles of FLAME."""
TOOTH_VERTICES = 120
_COUNT = 15  # vertices of a row
UPPER_LIP = (1713, 1715, 1716, 1735, 1696, 1694, 1657, 3543, 2774, 2811, 2813, 2850, 2833, 2832, 2830)
LOWER_LIP = (1576, 1577, 1773, 1774, 1795, 1802, 1865, 3503, 2948, 2905, 2898, 2881, 2880, 2713, 2712)
"""FLAME's vertices on the outer ring of the upper and the lower lip, from the subject's left to the right."""
_U, _V = (0.62, 0.38), (0.9917, 0.9575)  # texture coordinates at the ends of rows, and of the first and the last row
_V_OF_ROW = (3, 2, 0, 1, 3, 4, 6, 5)  # index among seven equal steps of v, for each row
_UPPER_ROWS = (0, 2, 4, 5)
"""Rows that belong to the upper teeth, which move with the neck joint. The others move with the jaw."""
_STRIPS = (
    (((0, 31, 30), (0, 1, 31)), ((0, 1, 30), (1, 31, 30))),
    (((60, 75, 76), (60, 76, 61)), ((60, 75, 61), (61, 75, 76))),
    (((75, 30, 76), (76, 30, 31)), ((75, 30, 31), (75, 31, 76))),
    (((45, 46, 15), (46, 16, 15)), ((45, 16, 15), (45, 46, 16))),
    (((90, 106, 105), (90, 91, 106)), ((90, 91, 105), (91, 106, 105))),
    (((105, 106, 45), (106, 46, 45)), ((105, 46, 45), (105, 106, 46))),
)
"""The strips: front, back and bottom of the upper teeth, then front, back and top of the lower. Each has the corners of
the two triangles of its first square, on the left half and on the right. The next square: plus 1."""


def with_teeth(flame: FlameFile, name: str) -> FlameFile:
    """Return FLAME with teeth: 120 vertices and 168 triangles more, in the order of GaussianAvatars.

    FLAME has its own 5,023 vertices in their order. `name` is the file, for messages.
    """
    if flame.template.shape != (VERTICES, 3) or flame.faces.shape != (FACES, 3):
        raise UserError(
            f"{name}: has {len(flame.template):,} vertices and {len(flame.faces):,} triangles, and teeth belong to "
            f"FLAME's {VERTICES:,} and {FACES:,}; add it without --teeth"
        )
    upper, lower = np.array(UPPER_LIP), np.array(LOWER_LIP)
    template = np.concatenate([flame.template, _places(flame.template[upper], flame.template[lower])])
    added = TOOTH_VERTICES
    rows = np.repeat(np.arange(8), _COUNT)
    is_upper = np.isin(rows, _UPPER_ROWS)
    weights = np.zeros((added, flame.weights.shape[1]))
    weights[is_upper, 1], weights[~is_upper, 2] = 1, 1
    identity = np.tile((flame.identity[:, upper] + flame.identity[:, lower]) / 2, (1, 8, 1))
    uv, uv_faces = flame.uv, flame.uv_faces
    if uv is not None and uv_faces is not None:
        uv_faces = np.concatenate([uv_faces, tooth_triangles() + len(uv)])
        uv = np.concatenate([uv, _texture_coordinates()])
    return replace(
        flame,
        template=template,
        faces=np.concatenate([flame.faces, tooth_triangles() + VERTICES]),
        identity=np.concatenate([flame.identity, identity], axis=1),
        expression=_padded(flame.expression, added),
        correctives=_padded(flame.correctives, added),
        regressor=np.concatenate([flame.regressor, np.zeros((len(flame.regressor), added))], axis=1),
        weights=np.concatenate([flame.weights, weights]),
        uv=uv,
        uv_faces=uv_faces,
        teeth=len(tooth_triangles()),
    )


def tooth_triangles() -> Int[np.ndarray, "168 3"]:
    """Return the triangles, with indices into the added vertices."""
    found = [
        np.array(corners) + place
        for strip in _STRIPS
        for place in range(_COUNT - 1)
        for corners in strip[place >= (_COUNT - 1) // 2]
    ]
    return np.stack(found).astype(np.int64)


def _places(upper: Float[np.ndarray, "15 3"], lower: Float[np.ndarray, "15 3"]) -> Float[np.ndarray, "120 3"]:
    """The places of the added vertices at rest, from the rings of the lips."""
    gap = float(np.linalg.norm(upper - lower, axis=1).mean())
    middle = (upper + lower) / 2
    middle[:, 1] = middle[:, 1].mean()
    middle[:, 2] -= 1.5 * gap
    upper_edge, lower_edge = middle + (0, 0.1 * gap, 0), middle - (0, 0.1 * gap, 0.4 * gap)
    upper_root, lower_root = upper_edge + (0, 2 * gap, 0), lower_edge - (0, 2 * gap, 0)
    back = np.array([0, 0, gap])
    return np.concatenate([
        upper_root, lower_root, upper_edge, lower_edge,
        upper_root - back, upper_edge - back, lower_root - back, lower_edge - back,
    ])  # fmt: skip


def _texture_coordinates() -> Float[np.ndarray, "120 2"]:
    u, steps = np.linspace(*_U, _COUNT), np.linspace(*_V, 7)
    return np.concatenate([np.stack([u, np.full(_COUNT, steps[row])], axis=1) for row in _V_OF_ROW])


def _padded(basis: Float[np.ndarray, "n v 3"], added: int) -> Float[np.ndarray, "n w 3"]:
    return np.concatenate([basis, np.zeros((len(basis), added, 3))], axis=1)
