"""Make texture coordinates for a head without any: its outside seen from its middle, the rest in cells."""

import numpy as np
from jaxtyping import Bool, Float, Int

_CHART_FROM = (-0.03, 0.02)  # height and depth of the point from which the outside is seen, in metres in the head frame
_CHART_FLAT = 0.02  # cosine below which a triangle is seen edge-on

_HEAD_BOX = (0.005, 0.255, 0.99, 0.74)
_CELLS_BOX = (0.005, 0.005, 0.99, 0.24)
"""Boxes in the texture for the outside and for the cells: left, bottom, width, height."""


def find_outside(template: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Bool[np.ndarray, " f"]:
    """Return which triangles form the outside of the head's largest piece, without mouth, nostrils and inner lids."""
    return _outside(*_seen_from_within(template), faces)


def unwrap(
    template: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Float[np.ndarray, "u 2"], Int[np.ndarray, "f 3"]]:
    """Return texture coordinates (v upwards), practically without overlaps, and every triangle's indices into them.

    The outside of the largest piece is mapped by angle from a point inside the head, which keeps neighbours together.
    Every other triangle gets a cell of its own: hidden surfaces (inside mouth, nostrils and lids), back-facing
    triangles, separate pieces such as eyeballs, and triangles across the seam at the back of the head.
    """
    rays, flat = _seen_from_within(template)
    outside = _outside(rays, flat, faces)
    uv = _fit(flat, outside, faces)
    boxed = faces.copy()
    cells = np.flatnonzero(~outside)
    boxed[cells] = len(template) + np.arange(3 * len(cells)).reshape(-1, 3)
    return np.concatenate([uv, _cells(len(cells))]), boxed


def _seen_from_within(template: Float[np.ndarray, "v 3"]) -> tuple[Float[np.ndarray, "v 3"], Float[np.ndarray, "v 2"]]:
    """Return rays from a point in the head to all vertices, and their angles."""
    rays = template - np.array([0.0, *_CHART_FROM])
    azimuth = np.arctan2(rays[:, 0], rays[:, 2])
    elevation = np.arctan2(rays[:, 1], np.hypot(rays[:, 0], rays[:, 2]))
    # More texels for the face: the back of the head gets half as many.
    return rays, np.stack([np.sign(azimuth) * (np.abs(azimuth) - 0.08 * azimuth**2), elevation], axis=1)


def _outside(
    rays: Float[np.ndarray, "v 3"], flat: Float[np.ndarray, "v 2"], faces: Int[np.ndarray, "f 3"]
) -> Bool[np.ndarray, " f"]:
    pieces = _components(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]]), len(rays))[faces[:, 0]]
    a, b, c = rays[faces].swapaxes(0, 1)
    normal = np.cross(b - a, c - a)
    middle = (a + b + c) / 3
    facing = (normal * middle).sum(1)
    facing /= np.maximum(np.linalg.norm(normal, axis=1) * np.linalg.norm(middle, axis=1), 1e-12)
    names, counts = np.unique(pieces, return_counts=True)
    seen = (pieces == names[counts.argmax()]) & (facing > _CHART_FLAT) & (np.ptp(flat[faces, 0], axis=1) < 1.0)
    if not seen.any():
        return seen
    # Inner layers such as a mouth's back wall also face outwards, but triangles that face inwards separate them from
    # the outside.
    together = edge_connected(faces, seen)
    names, counts = np.unique(together[seen], return_counts=True)
    return together == names[counts.argmax()]


def edge_connected(faces: Int[np.ndarray, "f 3"], chosen: Bool[np.ndarray, " f"]) -> Int[np.ndarray, " f"]:
    """Label each chosen triangle with its component, connected over shared edges; -1 for the others."""
    every, faces = np.full(len(faces), -1), faces[chosen]
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    owner = np.tile(np.arange(len(faces)), 3)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    edges, owner = edges[order], owner[order]
    same = (edges[1:] == edges[:-1]).all(1)
    every[chosen] = _components(np.stack([owner[:-1][same], owner[1:][same]], axis=1), len(faces))
    return every


def _components(pairs: Int[np.ndarray, "p 2"], count: int) -> Int[np.ndarray, " n"]:
    """Label `count` things with their connected component; a component with a lower first member has a lower label."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    return connected_components(coo_array((np.ones(len(pairs)), pairs.T), (count, count)), directed=False)[1]


def _fit(
    flat: Float[np.ndarray, "v 2"], outside: Bool[np.ndarray, " f"], faces: Int[np.ndarray, "f 3"]
) -> Float[np.ndarray, "v 2"]:
    used = flat[np.unique(faces[outside])]
    low, high = used.min(0), used.max(0)
    box = np.array(_HEAD_BOX)
    return np.clip(box[:2] + (flat - low) / (high - low) * box[2:], box[:2], box[:2] + box[2:])


def _cells(count: int) -> Float[np.ndarray, "n 2"]:
    """Return the corners of `count` right-angled triangles, two in a square cell."""
    left, bottom, width, height = _CELLS_BOX
    squares = max(1, (count + 1) // 2)
    rows = max(1, int(np.sqrt(squares * height / width)))
    columns = -(-squares // rows)
    index = np.arange(count)
    row, column = np.divmod(index // 2, columns)
    lower = np.array([[0.1, 0.1], [0.7, 0.1], [0.1, 0.7]])
    corners = np.where((index % 2 == 0)[:, None, None], lower, 1 - lower)
    place = np.stack([column, row], axis=1)[:, None]
    return (np.array([left, bottom]) + (place + corners) / np.array([columns, rows]) * [width, height]).reshape(-1, 2)
