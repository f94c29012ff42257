"""Boxes and eyes of all faces in a picture: the networks for near and for far faces."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from mien.capture.person.litert.networks import Network, NetworkName, cut_out

_CELLS: dict[str, tuple[tuple[int, int], ...]] = {"near_faces": ((16, 2), (8, 6)), "far_faces": ((48, 1),)}
"""Grids of a network's guesses: cells along each side, and guesses in each cell."""
_SAME_FACE = 0.3
"""Overlap (intersection over union) from which on two guesses are of one face."""
_LARGEST_LOGIT = 100.0


@dataclass(frozen=True, eq=False)
class Faces:
    """The faces of a picture, the surest first."""

    boxes: Float[np.ndarray, "n 4"]
    """Left, top, right, bottom in pixels, from eyebrows to chin."""
    eyes: Float[np.ndarray, "n 2 2"]
    """The right and the left eye of the person, in pixels."""
    scores: Float[np.ndarray, " n"]
    """Probabilities, 0..1."""


class BoxNetwork:
    """Finds faces with one of the two networks."""

    def __init__(self, name: NetworkName, least_score: float) -> None:
        self._network, self._least_score = Network(name), least_score
        self._cells = np.concatenate([_centers(cells, guesses) for cells, guesses in _CELLS[name]])

    def find(self, image: UInt8[np.ndarray, "h w 3"]) -> Faces:
        """Return the faces that are sure enough."""
        height, width = image.shape[:2]
        center, extent, side = np.array([width, height]) / 2, float(max(height, width)), self._network.side
        picture = cut_out(image, center, extent, 0.0, side).astype(np.float32) / 127.5 - 1
        raw, logits = self._network.run(picture)
        scores = 1 / (1 + np.exp(-np.clip(logits[:, 0].astype(float), -_LARGEST_LOGIT, _LARGEST_LOGIT)))
        sure = np.flatnonzero(scores >= self._least_score)
        sure = sure[np.argsort(-scores[sure], kind="stable")]
        points = raw[sure].astype(float).reshape(-1, 8, 2) / side
        # Row 0 is the middle, row 1 the size, and rows 2 and 3 are the eyes; positions count from the guess's cell.
        points[:, [0, 2, 3]] += self._cells[sure][:, None]
        corners = np.stack([points[:, 0] - points[:, 1] / 2, points[:, 0] + points[:, 1] / 2], axis=1)
        guesses = (np.concatenate([corners, points[:, 2:4]], axis=1) - 0.5) * extent + center
        return _merge(guesses, scores[sure])


def _centers(cells: int, guesses: int) -> Float[np.ndarray, "n 2"]:
    along = (np.arange(cells) + 0.5) / cells
    grid = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
    return np.repeat(grid, guesses, axis=0)


def _merge(guesses: Float[np.ndarray, "n 4 2"], scores: Float[np.ndarray, " n"]) -> Faces:
    """Join guesses of one face to their mean, weighted by score. The surest of them decides which belong to it."""
    merged, best = [], []
    left = np.arange(len(guesses))
    while len(left):
        same = _overlap(guesses[left[0], :2], guesses[left, :2]) > _SAME_FACE
        same[0] = True
        merged.append(np.average(guesses[left[same]], axis=0, weights=scores[left[same]]))
        best.append(scores[left[0]])
        left = left[~same]
    faces = np.array(merged).reshape(-1, 4, 2)
    return Faces(faces[:, :2].reshape(-1, 4), faces[:, 2:], np.array(best))


def _overlap(box: Float[np.ndarray, "2 2"], others: Float[np.ndarray, "n 2 2"]) -> Float[np.ndarray, " n"]:
    shared = (np.minimum(box[1], others[:, 1]) - np.maximum(box[0], others[:, 0])).clip(0).prod(-1)
    areas = (others[:, 1] - others[:, 0]).clip(0).prod(-1) + (box[1] - box[0]).clip(0).prod()
    return shared / np.maximum(areas - shared, 1e-12)
