"""Find faces in pictures: boxes of all faces (step 2, to choose the crop) and landmarks (step 4)."""

from types import TracebackType
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from mien.capture.constants import CAPTURE
from mien.capture.quiet_mediapipe import load_solution, quiet_mediapipe

LANDMARKS = 478
"""Points of MediaPipe's face mesh with irises: 468 of the mesh and 5 of each iris."""
MAX_FACES = 4
"""Most faces of a frame that are kept, the largest first."""


class FaceFinder:
    """Finds the boxes of all faces in a picture.

    It uses MediaPipe's detector for near faces and, if that finds none, the one for far faces.

    Use as a context manager.
    """

    def __enter__(self) -> "FaceFinder":
        module = load_solution("face_detection")
        with quiet_mediapipe():
            self._detectors = [
                module.FaceDetection(model_selection=model, min_detection_confidence=CAPTURE.face_confidence)
                for model in (0, 1)
            ]
            blank = np.zeros((64, 64, 3), np.uint8)
            for detector in self._detectors:
                detector.process(blank)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        for detector in self._detectors:
            detector.close()

    def find(self, image: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "n 4"]:
        """Return left, top, right, bottom of each face (eyebrows to chin) as fractions of the picture's size."""
        for detector in self._detectors:
            found = detector.process(image).detections
            if found:
                boxes = [detection.location_data.relative_bounding_box for detection in found]
                return np.array([(b.xmin, b.ymin, b.xmin + b.width, b.ymin + b.height) for b in boxes])
        return np.zeros((0, 4))

    def surest(self, image: UInt8[np.ndarray, "h w 3"]) -> float:
        """Return the higher of the two detectors' confidences that there is a face, 0..1; 0 if neither finds one."""
        found = [detection for detector in self._detectors for detection in detector.process(image).detections or ()]
        return max((float(detection.score[0]) for detection in found), default=0.0)


class LandmarkDetector:
    """Finds face-mesh landmarks in consecutive pictures of one clip. Use as a context manager, one for each clip.

    MediaPipe places its region of interest by the landmarks of the previous picture. That is steadier than a new
    detection, but a result then depends on about four earlier pictures: pass those first.
    """

    def __init__(self, several_faces: bool) -> None:
        self._several_faces = several_faces

    def __enter__(self) -> "LandmarkDetector":
        module = load_solution("face_mesh")
        with quiet_mediapipe():
            self._mesh = module.FaceMesh(max_num_faces=MAX_FACES if self._several_faces else 1, refine_landmarks=True)
            # The graph starts in its own threads and prints warnings. It has started when it has processed a picture.
            self._mesh.process(np.zeros((64, 64, 3), np.uint8))
        self._has_seen_face = False
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._mesh.close()

    def detect(self, image: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "n l 2"]:
        """Return the landmarks of all faces in the next picture of the clip, in pixels."""
        faces = self._process(image)
        if not faces:
            return np.zeros((0, LANDMARKS, 2))
        height, width = image.shape[:2]
        return np.array([[(point.x, point.y) for point in face.landmark] for face in faces]) * (width, height)

    def _process(self, image: np.ndarray) -> Any:
        if self._has_seen_face:
            return self._mesh.process(image).multi_face_landmarks
        # MediaPipe prints its last warning at the first face.
        with quiet_mediapipe():
            faces = self._mesh.process(image).multi_face_landmarks
        self._has_seen_face = bool(faces)
        return faces


def second_difference_jitter(landmarks: Float[np.ndarray, "t l 2"]) -> float:
    """Return the median length in pixels of the landmarks' second difference; NaN for fewer than three frames."""
    differences = landmarks[2:] - 2 * landmarks[1:-1] + landmarks[:-2]
    lengths = np.linalg.norm(differences, axis=-1)
    return float(np.nanmedian(lengths)) if np.isfinite(lengths).any() else float("nan")
