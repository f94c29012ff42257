"""Landmarks of faces in consecutive pictures, or in single ones."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from mien.capture.person.litert.boxes import BoxNetwork
from mien.capture.person.litert.networks import Network, cut_out, to_picture

_LANDMARKS = 478
_ROOM = 1.5
"""Side of the square that the network sees, in sides of the face's box."""
_OUTER_CORNERS = (33, 263)
"""Landmarks whose line is the square's x axis: the outer corners of the right and the left eye."""
_LEAST_PRESENCE = 0.5
_SAME_FACE = 0.5
"""Overlap from which on a found box is a face that is followed already."""


@dataclass(frozen=True, eq=False)
class _Square:
    center: Float[np.ndarray, " 2"]
    extent: float
    angle: float


class Mesh:
    """Finds 478 landmarks of each face.

    The square of a face is placed by its landmarks in the previous picture. Faces are searched if fewer than
    `most_faces` are followed.
    """

    def __init__(self, most_faces: int, follows: bool, least_score: float = 0.5) -> None:
        self._boxes, self._network = BoxNetwork("near_faces", least_score), Network("landmarks")
        self._most, self._follows = most_faces, follows
        self._squares: list[_Square] = []

    def find(self, image: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "n 478 3"]:
        """Return the landmarks of all faces in pixels. z points away from the camera, in the same unit."""
        followed = [self._read(image, square) for square in self._squares if self._follows]
        faces = [face for face in followed if face is not None]
        if len(faces) < self._most:
            found = self._boxes.find(image)
            for box, eyes in zip(found.boxes, found.eyes, strict=True):
                square = _square(box.reshape(2, 2), eyes)
                if len(faces) < self._most and not any(_is_same(square, _around(face)) for face in faces):
                    face = self._read(image, square)
                    faces += [] if face is None else [face]
        self._squares = [_around(face) for face in faces]
        return np.array(faces).reshape(-1, _LANDMARKS, 3)

    def _read(self, image: np.ndarray, square: _Square) -> Float[np.ndarray, "478 3"] | None:
        side = self._network.side
        seen = cut_out(image, square.center, square.extent, square.angle, side)
        points, presence = self._network.run(seen.astype(np.float32) / 255)[:2]
        if 1 / (1 + np.exp(-float(presence.ravel()[0]))) < _LEAST_PRESENCE:
            return None
        points = points.reshape(-1, 3).astype(float) / side
        across = to_picture(points[:, :2], square.center, square.extent, square.angle)
        return np.column_stack([across, square.extent * points[:, 2]])


def _square(corners: Float[np.ndarray, "2 2"], eyes: Float[np.ndarray, "2 2"]) -> _Square:
    extent, along = (corners[1] - corners[0]).max(), eyes[1] - eyes[0]
    return _Square(corners.mean(0), _ROOM * float(extent), float(np.arctan2(along[1], along[0])))


def _around(face: Float[np.ndarray, "478 3"]) -> _Square:
    across = face[:, :2]
    return _square(np.stack([across.min(0), across.max(0)]), across[list(_OUTER_CORNERS)])


def _is_same(one: _Square, other: _Square) -> bool:
    reach = (one.extent + other.extent) / 2 - np.abs(one.center - other.center)
    area = float(reach.clip(0, min(one.extent, other.extent)).prod())
    return area / (one.extent**2 + other.extent**2 - area) > _SAME_FACE
