"""The networks: read from mien's own files, and run by ai-edge-litert on one thread."""

import functools
import lzma
import struct
from importlib import resources
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from mien.capture.person.quiet_mediapipe import quiet_mediapipe

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
    return _member(_first_part(), _IN_TASK[name])


@functools.cache
def _first_part() -> bytes:
    """The start of face_landmarker.task. Its end, which only pages need, may be missing (`formats.shared.webcam`)."""
    return lzma.decompress(
        (resources.files("mien.formats") / "shared" / "landmarker" / "face_landmarker.task.xz.1").read_bytes()
    )


def _member(archive: bytes, name: str) -> bytes:
    """Return a file of a zip archive that holds it as it is. `zipfile` would need the archive's end."""
    at = archive.index(name.encode())  # The local header: 18 bytes, two sizes, two lengths, then the name.
    size, _, name_length, extra_length = struct.unpack("<IIHH", archive[at - 12 : at])
    start = at + name_length + extra_length
    return archive[start : start + size]


def cut_out(
    image: UInt8[np.ndarray, "h w 3"], center: Float[np.ndarray, " 2"], extent: float, angle: float, side: int
) -> UInt8[np.ndarray, "side side 3"]:
    """Return a turned square of the picture, scaled to `side` pixels; black where it leaves the picture.

    Args:
        image: the picture.
        center: the square's middle in pixels.
        extent: its width and height in pixels.
        angle: radians from the picture's x axis to the square's, clockwise as seen.
        side: width and height of the result.
    """
    scale = side / extent
    axes = scale * np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    matrix = np.column_stack([axes, side / 2 - axes @ center])
    return cv2.warpAffine(image, matrix, (side, side), flags=cv2.INTER_LINEAR)


def to_picture(
    points: Float[np.ndarray, "n 2"], center: Float[np.ndarray, " 2"], extent: float, angle: float
) -> Float[np.ndarray, "n 2"]:
    """Return points of a turned square, given as fractions of it, in pixels of the picture."""
    axes = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    return center + extent * (points - 0.5) @ axes
