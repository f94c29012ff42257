"""Faces, landmarks and mattes by MediaPipe's published networks, run by ai-edge-litert in place of mediapipe.

It serves where mediapipe 0.10.21 has no package: Python 3.13 and later, and Linux on ARM. What stands before and after
the networks is written here, from the networks' published descriptions. `mien.capture.person.backend` chooses between
both.
"""

import functools
import lzma
import struct
from dataclasses import dataclass
from importlib import resources
from typing import Literal, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from mien.capture.person.backend import quiet_mediapipe

NetworkName = Literal["near_faces", "far_faces", "landmarks", "person"]
_IN_TASK = {"near_faces": "face_detector.tflite", "landmarks": "face_landmarks_detector.tflite"}
_IN_DATA = {"far_faces": "face_detection_full_range_sparse.tflite", "person": "selfie_segmentation.tflite"}


class Network:
    """A network with one input, a picture of floats."""

    def __init__(self, name: NetworkName) -> None:
        with quiet_mediapipe():
            from ai_edge_litert.interpreter import Interpreter

            self._interpreter = Interpreter(model_content=network_content(name), num_threads=1)
            self._interpreter.allocate_tensors()
        given, found = self._interpreter.get_input_details()[0], self._interpreter.get_output_details()
        self._input, self._outputs = given["index"], [each["index"] for each in found]
        self.side = int(given["shape"][1])
        """Width and height of the input, in pixels."""

    def run(self, picture: Float[np.ndarray, "side side 3"]) -> list[np.ndarray]:
        """Return all outputs without the axis of batches, in the network's order."""
        self._interpreter.set_tensor(self._input, picture[None])
        self._interpreter.invoke()
        return [self._interpreter.get_tensor(index)[0] for index in self._outputs]


@functools.cache
def network_content(name: NetworkName) -> bytes:
    """Return the bytes of a network, a .tflite file."""
    if name in _IN_DATA:
        return lzma.decompress((resources.files("mien.capture") / "data" / f"{_IN_DATA[name]}.xz").read_bytes())
    # A zip archive that holds its files as they are. `zipfile` would need its end.
    archive = _first_part()
    at = archive.index(_IN_TASK[name].encode())  # The local header: 18 bytes, two sizes, two lengths, then the name.
    size, _, name_length, extra_length = struct.unpack("<IIHH", archive[at - 12 : at])
    start = at + name_length + extra_length
    return archive[start : start + size]


@functools.cache
def _first_part() -> bytes:
    """The start of face_landmarker.task. Its end, which only pages need, may be missing (`formats.shared.webcam`)."""
    return lzma.decompress(
        (resources.files("mien.formats") / "shared" / "landmarker" / "face_landmarker.task.xz.1").read_bytes()
    )


def cut_out(
    image: UInt8[np.ndarray, "h w 3"], center: Float[np.ndarray, " 2"], extent: float, angle: float, side: int
) -> UInt8[np.ndarray, "side side 3"]:
    """Return a square of the picture (center and extent in pixels, turned clockwise by radians); black outside."""
    scale = side / extent
    axes = scale * _axes(angle)
    matrix = np.column_stack([axes, side / 2 - axes @ center])
    return cv2.warpAffine(image, matrix, (side, side), flags=cv2.INTER_LINEAR)


def _axes(angle: float) -> Float[np.ndarray, "2 2"]:
    return np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])


def find_person(network: Network, image: UInt8[np.ndarray, "256 256 3"]) -> Float[np.ndarray, "256 256"]:
    """Return the probability of a person in each pixel, 0..1, by the network `person`."""
    return network.run(image.astype(np.float32) / 255)[0][..., 0]


_CELLS: dict[str, tuple[tuple[int, int], ...]] = {"near_faces": ((16, 2), (8, 6)), "far_faces": ((48, 1),)}
"""Grids of a network's guesses: cells along each side, and guesses in each cell."""
_SAME_FACE = 0.3  # overlap (intersection over union) from which on two guesses are of one face


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
        scores = 1 / (1 + np.exp(-np.clip(logits[:, 0].astype(float), -100, 100)))
        sure = np.flatnonzero(scores >= self._least_score)
        sure = sure[np.argsort(-scores[sure], kind="stable")]
        points = raw[sure].astype(float).reshape(-1, 8, 2) / side
        # Row 0 is the middle, row 1 the size, and rows 2 and 3 are the eyes; positions count from the guess's cell.
        points[:, [0, 2, 3]] += self._cells[sure][:, None]
        corners = np.stack([points[:, 0] - points[:, 1] / 2, points[:, 0] + points[:, 1] / 2], axis=1)
        return _merge((np.concatenate([corners, points[:, 2:4]], axis=1) - 0.5) * extent + center, scores[sure])


def _centers(cells: int, guesses: int) -> Float[np.ndarray, "n 2"]:
    along = (np.arange(cells) + 0.5) / cells
    return np.repeat(np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2), guesses, axis=0)


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


_ROOM = 1.5  # side of the square that the network sees, in sides of the face's box
_OUTER_CORNERS = (33, 263)
"""Landmarks whose line is the square's x axis: the outer corners of the right and the left eye."""


class _Square(NamedTuple):
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
        return np.array(faces).reshape(-1, 478, 3)

    def _read(self, image: np.ndarray, square: _Square) -> Float[np.ndarray, "478 3"] | None:
        side = self._network.side
        points, presence = self._network.run(cut_out(image, *square, side).astype(np.float32) / 255)[:2]
        if 1 / (1 + np.exp(-float(presence.ravel()[0]))) < 0.5:
            return None
        points = points.reshape(-1, 3).astype(float) / side
        across = square.center + square.extent * (points[:, :2] - 0.5) @ _axes(square.angle)
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
    return area / (one.extent**2 + other.extent**2 - area) > 0.5  # a face that is followed already
