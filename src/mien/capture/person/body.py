"""Find a person's body in pictures: the 33 points of MediaPipe's pose network. Its shoulders place a torso."""

from collections.abc import Callable

import numpy as np

from mien.capture.person.backend import Networks, load_solution, quiet_mediapipe

BODY_POINTS = 33
"""Number of points of a body."""


class BodyReader(Networks):
    """Finds the body of one person in consecutive pictures. Use one for each clip.

    Only mediapipe brings the networks. Where it is not installed, no body is found.
    """

    def _open(self, by_mediapipe: bool) -> None:
        self.read = self._mediapipe() if by_mediapipe else lambda _: _none()
        """Returns x, y and z in pixels and the visibility, 0..1, of the points; NaN if there is no body."""

    def _mediapipe(self) -> Callable[[np.ndarray], np.ndarray]:
        module = load_solution("pose")
        with quiet_mediapipe():
            # Complexity 1 is the network that lies in the package; mediapipe would download the others.
            network = self._stack.enter_context(module.Pose(model_complexity=1))
            network.process(np.zeros((64, 64, 3), np.uint8))

        def read(image: np.ndarray) -> np.ndarray:
            found, (height, width) = network.process(image).pose_landmarks, image.shape[:2]
            if found is None:
                return _none()
            points = [(point.x, point.y, point.z, point.visibility) for point in found.landmark]
            return np.array(points, np.float32) * np.array([width, height, width, 1], np.float32)

        return read


def _none() -> np.ndarray:
    return np.full((BODY_POINTS, 4), np.nan, np.float32)
