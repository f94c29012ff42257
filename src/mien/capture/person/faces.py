"""Find faces in pictures: boxes of all faces (step 2, to choose the crop) and landmarks (step 4).

The classes here are seams: behind them, mediapipe or `mien.capture.person.litert` runs MediaPipe's networks, as
`mien.capture.person.backend` chooses.
"""

from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from mien.capture.person.backend import DetectorChoice, Networks, load_solution, quiet_mediapipe

_FACE_CONFIDENCE = 0.5  # least score of a found face. MediaPipe's default

LANDMARKS = 478
"""Points of MediaPipe's face mesh with irises: 468 of the mesh and 5 of each iris."""
IBUG68 = (
    127, 234, 93, 58, 172, 136, 149, 148, 152, 377, 378, 365, 397, 288, 323, 454, 356,  # contour, right to left ear
    70, 63, 105, 66, 107, 336, 296, 334, 293, 300,  # brows
    168, 197, 5, 4, 98, 97, 2, 326, 327,  # nose
    33, 160, 158, 133, 153, 144, 362, 385, 387, 263, 373, 380,  # eyes
    61, 39, 37, 0, 267, 269, 291, 405, 314, 17, 84, 181,  # outer lips
    78, 82, 13, 312, 308, 317, 14, 87,  # inner lips
)  # fmt: skip
"""MediaPipe's landmark for each of 300-W's 68 points. The first 17 are a silhouette there, but fixed points here."""
MAX_FACES = 4
"""Most faces of a frame that are kept, the largest first."""

_Boxes = tuple[np.ndarray, np.ndarray]
"""Boxes [n, 4] as fractions of the picture, and their scores [n]."""


class FaceFinder(Networks):
    """Finds the boxes of all faces in a picture, by MediaPipe's network for near faces or else by that for far ones."""

    def _open(self, by_mediapipe: bool) -> None:
        self._finds = _mediapipe_boxes(self._stack) if by_mediapipe else _litert_boxes()

    def find(self, image: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "n 4"]:
        """Return left, top, right, bottom of each face (eyebrows to chin) as fractions of the picture's size."""
        for find in self._finds:
            boxes, _ = find(image)
            if len(boxes):
                return boxes
        return np.zeros((0, 4))

    def surest(self, image: UInt8[np.ndarray, "h w 3"]) -> float:
        """Return the higher of the two detectors' confidences that there is a face, 0..1; 0 if neither finds one."""
        return max((float(score) for find in self._finds for score in find(image)[1]), default=0.0)


def _mediapipe_boxes(stack: ExitStack) -> list[Callable[[np.ndarray], _Boxes]]:
    module = load_solution("face_detection")
    with quiet_mediapipe():
        detectors = [
            module.FaceDetection(model_selection=model, min_detection_confidence=_FACE_CONFIDENCE) for model in (0, 1)
        ]
        blank = np.zeros((64, 64, 3), np.uint8)
        for detector in detectors:
            stack.callback(detector.close)
            detector.process(blank)

    return [partial(_found_by_mediapipe, detector) for detector in detectors]


def _found_by_mediapipe(detector: Any, image: np.ndarray) -> _Boxes:
    found = detector.process(image).detections or ()
    boxes = [detection.location_data.relative_bounding_box for detection in found]
    corners = [(b.xmin, b.ymin, b.xmin + b.width, b.ymin + b.height) for b in boxes]
    return np.array(corners).reshape(-1, 4), np.array([detection.score[0] for detection in found])


def _litert_boxes() -> list[Callable[[np.ndarray], _Boxes]]:
    from mien.capture.person.litert import BoxNetwork

    def find(network: BoxNetwork, image: np.ndarray) -> _Boxes:
        found = network.find(image)
        return found.boxes / np.tile([image.shape[1], image.shape[0]], 2), found.scores

    names = ("near_faces", "far_faces")
    return [partial(find, BoxNetwork(name, _FACE_CONFIDENCE)) for name in names]


class MeshReader(Networks):
    """Finds landmarks of up to `most_faces` faces. In consecutive pictures (`is_video`), faces are followed."""

    def __init__(self, most_faces: int, is_video: bool, detector: DetectorChoice = "auto") -> None:
        super().__init__(detector)
        self._most, self._is_video = most_faces, is_video

    def _open(self, by_mediapipe: bool) -> None:
        self.read = self._mediapipe() if by_mediapipe else self._litert()
        """Returns the landmarks [n, 478, 3] of a picture's faces in pixels; z points away from the camera."""

    def _litert(self) -> Callable[[np.ndarray], np.ndarray]:
        from mien.capture.person.litert import Mesh

        return Mesh(self._most, self._is_video).find

    def _mediapipe(self) -> Callable[[np.ndarray], np.ndarray]:
        module = load_solution("face_mesh")
        with quiet_mediapipe():
            mesh = module.FaceMesh(
                static_image_mode=not self._is_video, max_num_faces=self._most, refine_landmarks=True
            )
            self._stack.callback(mesh.close)
            # The graph starts in its own threads and prints warnings. It has started when it has processed a picture.
            mesh.process(np.zeros((64, 64, 3), np.uint8))
        has_seen_face = False

        def read(image: np.ndarray) -> np.ndarray:
            nonlocal has_seen_face
            if has_seen_face:
                faces = mesh.process(image).multi_face_landmarks
            else:
                # MediaPipe prints its last warning at the first face.
                with quiet_mediapipe():
                    faces = mesh.process(image).multi_face_landmarks
                has_seen_face = bool(faces)
            height, width = image.shape[:2]
            points = [[(point.x, point.y, point.z) for point in face.landmark] for face in faces or ()]
            return np.array(points).reshape(-1, LANDMARKS, 3) * (width, height, width)

        return read


class LandmarkDetector(MeshReader):
    """Finds face-mesh landmarks in consecutive pictures of one clip. Use one for each clip.

    The region of interest is placed by the landmarks of the previous picture. That is steadier than a new detection,
    but a result then depends on about four earlier pictures: pass those first.
    """

    def __init__(self, several_faces: bool, detector: DetectorChoice = "auto") -> None:
        super().__init__(MAX_FACES if several_faces else 1, True, detector)

    def detect(self, image: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "n l 2"]:
        """Return the landmarks of all faces in the next picture of the clip, in pixels."""
        return self.read(image)[..., :2]


def second_difference_jitter(landmarks: Float[np.ndarray, "t l 2"]) -> float:
    """Return the median length in pixels of the landmarks' second difference; NaN for fewer than three frames."""
    lengths = np.linalg.norm(landmarks[2:] - 2 * landmarks[1:-1] + landmarks[:-2], axis=-1)
    return float(np.nanmedian(lengths)) if np.isfinite(lengths).any() else float("nan")
