"""Pick the landmarks of the followed person among all faces in a frame."""

import numpy as np
from jaxtyping import Float, UInt8

from mien.capture.crop import Crop
from mien.capture.faces import LandmarkDetector
from mien.capture.people import Person
from mien.capture.survey import Survey

_MAX_DISTANCE = 0.6
"""Largest distance between the centres of landmarks and of the followed face, as a part of the face's longer side."""
_MAX_AGE = 12
"""Frames for which the last landmarks predict the face's position if the survey did not find it."""


class LandmarkFollower:
    """Picks the landmarks of the person that the survey follows, frame by frame."""

    def __init__(self, detector: LandmarkDetector, survey: Survey, person: Person, crop: Crop) -> None:
        self._detector = detector
        size = np.tile(survey.picture_size, 2)
        self._boxes = _to_crop(person.boxes * size, crop)
        self._others = _to_crop(person.others * size, crop)
        self._is_alone = not person.crowded.any()
        self._last: tuple[int, np.ndarray] | None = None

    def find(self, timestep: int, image: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "l 2"] | None:
        """Return the person's landmarks in the next picture, in pixels, or None if the face is not found."""
        faces = self._detector.detect(image)
        expected = self._expected(timestep)
        if expected is None:
            # The two detectors differ. If the clip never shows anybody else, any face that is detected here is the
            # person.
            chosen = faces[0] if self._is_alone and len(faces) else None
        else:
            chosen = self._nearest(faces, expected, self._others[timestep])
        if chosen is not None:
            self._last = timestep, chosen
        return chosen

    def _expected(self, timestep: int) -> Float[np.ndarray, " 4"] | None:
        """Return the box where the face should be: the survey's, or else that of the last landmarks if recent."""
        if np.isfinite(self._boxes[timestep, 0]):
            return self._boxes[timestep]
        if self._last is None or abs(timestep - self._last[0]) > _MAX_AGE:
            return None
        return _box(self._last[1])

    @staticmethod
    def _nearest(faces: np.ndarray, expected: np.ndarray, others: np.ndarray) -> Float[np.ndarray, "l 2"] | None:
        if not len(faces):
            return None
        centres = np.array([_centre(_box(face)) for face in faces])
        distances = np.linalg.norm(centres - _centre(expected), axis=1)
        best = int(np.argmin(distances))
        if distances[best] > _MAX_DISTANCE * (expected[2:] - expected[:2]).max():
            return None
        to_others = np.linalg.norm(centres[best] - (others[:, :2] + others[:, 2:]) / 2, axis=1)
        # Missing faces are NaN, which never compares as smaller.
        return None if (to_others < distances[best]).any() else faces[best]


def _to_crop(boxes: Float[np.ndarray, "*b 4"], crop: Crop) -> Float[np.ndarray, "*b 4"]:
    return crop.to_output(boxes.reshape(-1, 2, 2)).reshape(boxes.shape)


def _box(landmarks: Float[np.ndarray, "l 2"]) -> Float[np.ndarray, " 4"]:
    return np.concatenate([landmarks.min(axis=0), landmarks.max(axis=0)])


def _centre(box: Float[np.ndarray, " 4"]) -> Float[np.ndarray, " 2"]:
    return (box[:2] + box[2:]) / 2
