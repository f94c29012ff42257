"""Repairs of the source's mesh where it does not suit a head that is cut from it: collar, mouth and lids."""

import numpy as np
from jaxtyping import Bool, Float, Int

BLINK = 0.8
"""Factor on the source's eyeBlink. It closes the eye at this value (the eyeball is hidden); beyond it the upper lid
runs through the lower one, by up to 2.3 mm. ARKit's 1 means closed."""

# The helper geometry's lower teeth and tongue are as wide as the upper teeth and run through lip and cheeks. Slightly
# narrower and further back (in metres), they close behind the upper teeth.
_LOWER_TEETH_WIDTH, _LOWER_TEETH_BACK = 0.93, 0.002
# Its tongue fills the closed mouth up to the palate and looks like a slab in an open one.
_TONGUE_HEIGHT, _TONGUE_BACK = 0.6, 0.003

_COLLAR_STEPS, _COLLAR_RINGS = 24, 5
"""Smoothing steps along the jagged edge of the cut over the shoulders, and number of vertex rings above it that
follow."""


def mend_mouth(people: Float[np.ndarray, "s v 3"], parts: dict[str, Bool[np.ndarray, " v"]]) -> None:
    """Move the lower teeth behind the upper ones and the tongue between them, in place."""
    bite = parts["lower_teeth"] | parts["tongue"]
    people[:, bite] *= np.array([_LOWER_TEETH_WIDTH, 1.0, 1.0])
    people[:, bite] -= np.array([0.0, 0.0, _LOWER_TEETH_BACK])
    tongue = people[:, parts["tongue"]]
    lowest = tongue[:, [tongue[..., 1].mean(0).argmin()], 1]
    tongue[..., 1] = lowest + _TONGUE_HEIGHT * (tongue[..., 1] - lowest)
    tongue[..., 2] -= _TONGUE_BACK
    people[:, parts["tongue"]] = tongue


def mend_collar(people: Float[np.ndarray, "s v 3"], faces: Int[np.ndarray, "f 3"]) -> None:
    """Smooth the lower edge of the neck in place; the rings above follow like a membrane.

    The change is linear, so identity stays linear.
    """
    edges, times = np.unique(np.sort(_edges(faces), axis=1), axis=0, return_counts=True)
    loop = _lowest_loop(edges[times == 1], people[..., 1].mean(0))
    step = 0.5 * np.eye(len(loop)) + 0.25 * (np.roll(np.eye(len(loop)), 1, 1) + np.roll(np.eye(len(loop)), -1, 1))
    move = np.linalg.matrix_power(step, _COLLAR_STEPS) - np.eye(len(loop))
    ring = np.full(people.shape[1], _COLLAR_RINGS + 1)
    ring[loop] = 0
    for _ in range(_COLLAR_RINGS):
        for here, there in (edges.T, edges.T[::-1]):
            np.minimum.at(ring, here, ring[there] + 1)
    follows = np.flatnonzero((ring > 0) & (ring <= _COLLAR_RINGS))
    stiffness = np.zeros((people.shape[1], people.shape[1]), np.float32)
    stiffness[edges[:, 0], edges[:, 1]] = stiffness[edges[:, 1], edges[:, 0]] = -1
    diagonal = -stiffness[follows].sum(1).astype(np.float64)
    inner = stiffness[np.ix_(follows, follows)] + np.diag(diagonal)
    spread = np.linalg.solve(inner, -stiffness[np.ix_(follows, loop)].astype(np.float64))
    shift = np.einsum("nm,smc->snc", move, people[:, loop])
    people[:, loop] += shift
    people[:, follows] += np.einsum("nm,smc->snc", spread, shift)


def _edges(faces: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, "e 2"]:
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def _lowest_loop(border: Int[np.ndarray, "b 2"], height: Float[np.ndarray, " v"]) -> Int[np.ndarray, " n"]:
    """Return the vertices, in order, of the open border that holds the lowest vertex."""
    neighbours: dict[int, list[int]] = {}
    for first, second in border.tolist():
        neighbours.setdefault(first, []).append(second)
        neighbours.setdefault(second, []).append(first)
    start = min(neighbours, key=lambda vertex: height[vertex])
    loop = [start, min(neighbours[start])]
    while (following := next(v for v in neighbours[loop[-1]] if v != loop[-2])) != start:
        loop.append(following)
    return np.array(loop)
