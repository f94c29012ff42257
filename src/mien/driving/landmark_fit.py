"""The fit of one frame's landmarks, in a millisecond: head pose, expression and gaze together.

It is the landmark fit of tracking (`mien.tracking.landmarks`) with the same landmarks, weights, priors and response of
the detector. What differs is that landmarks are linear in expression and gaze here, that identity is given, and that
each frame starts from the one before it, so that two Gauss-Newton steps are enough.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float

from mien.capture.person.backend import choose_detector
from mien.driving.rest import kept_share
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.runtime.rotation import axis_angle_from_matrix, matrix_from_axis_angle
from mien.tracking.fitting.parameters import layout_of
from mien.tracking.fitting.sequence import FOCAL
from mien.tracking.landmarks.detector_response import LARGEST_TURN, OFFSET_SIGMA, read_response
from mien.tracking.landmarks.groups import EYE_CORNERS, NOSE, landmark_weights
from mien.tracking.landmarks.model import reduce_face_model
from mien.tracking.landmarks.stages import FIRST_OUTLIER
from mien.tracking.landmarks.term import INDEPENDENT_LANDMARKS, LANDMARK_SIGMA

_LIVE_STEP = 0.5  # of a coefficient, over which landmarks count as linear; for joints, in radians, a quarter of that
_LIVE_OUTLIER = 6.0
"""Outlier threshold in standard deviations. Measured: 20 has the same mean correlation to 0.001 (log, 11-23)."""
_LIVE_STEPS = 2
"""Gauss-Newton steps from the frame before. Measured: 4 have a mean correlation of 0.915 instead of 0.913 (log,
11-23)."""
_LIVE_FIRST_STEPS = 12  # gauss-Newton steps from a face that looks ahead
_LIVE_EXPRESSION_LIMITS = (0.4, 0.7)
"""Limits of the coefficients of jaw, brows, smiles and rounded lips of the face at rest. They are wider than those of a
tracking, because the person's shape is unknown: in clips of seven people, medians of the fit are up to 0.34. For lids
and other lips they are up to 0.9, so their part is always taken as shape."""
_LIVE_GAZE_LIMITS = (0.35, 0.5)
"""The same of the angles of eyes, in radians. In clips of seven people, medians are up to 0.24."""

_OPENCV = np.diag([1.0, -1.0, -1.0])
_LIMITED = ("jaw", "brow", "mouthSmile", "mouthPucker", "mouthFunnel")
"""Beginnings of coefficients that count as motion if they are large. All others but gazes are taken as shape."""
_NEAR, _FAR = 0.1, 10.0  # bounds of the distance of a head, in metres


@dataclass(frozen=True, eq=False)
class Fitted:
    """A face in a camera's picture. The camera is the world's origin; +y is up, +z towards the camera."""

    rotation: Float[np.ndarray, "3 3"]
    """R_world_head."""
    translation: Float[np.ndarray, " 3"]
    """Origin of the head frame in metres."""
    coefficients: Float[np.ndarray, " k"]
    """Expression coefficients and joint angles, as differences from rest, in the order of `LandmarkFit.names`."""
    error: float
    """Root mean square distance of landmarks in pixels, weighted."""


class LandmarkFit:
    """Fits one person's landmarks, frame after frame."""

    def __init__(self, model: FaceModel, person: FaceParams) -> None:
        """Prepare the fit. The identity of `person`, one timestep, stands for that of the driver."""
        layout = layout_of(model)
        reduced = reduce_face_model(model, layout, read_response(model, OFFSET_SIGMA, choose_detector()))
        self._layout = layout
        self.names = layout.names[6:]
        count = len(self.names)
        state = torch.zeros(count + 1, layout.size, dtype=torch.float64)
        steps = torch.full((count,), _LIVE_STEP, dtype=torch.float64)
        steps[len(layout.expression_index) :] = 0.25 * _LIVE_STEP
        state[1:, 6:] = torch.diag(steps)
        points = reduced.head_points(
            layout.face_params(state, person.identity.double().reshape(-1)), reduced.response.mean
        )[0]
        self._rest = points[0].numpy()
        moved = (points[1:] - points[:1]) / steps[:, None, None]
        self._basis = np.ascontiguousarray(moved.permute(1, 2, 0).numpy())
        self._by_turn = reduced.response.by_turn.numpy()
        self._bias = np.zeros_like(self._rest)
        self._lower, self._upper = (bound[6:].numpy() for bound in (layout.lower, layout.upper))
        self._prior = layout.precision[6:, 6:].numpy()
        weights = landmark_weights().numpy()
        self._weights = weights / weights.sum() * INDEPENDENT_LANDMARKS
        self._rigid = np.zeros(len(weights))
        self._rigid[list(NOSE + EYE_CORNERS)] = 1.0
        self._rigid *= INDEPENDENT_LANDMARKS / self._rigid.sum()
        self._sigma = LANDMARK_SIGMA
        self._held = np.zeros(count)
        self._last: Fitted | None = None

    def forget(self) -> None:
        """Start anew at the next frame, because the face was away."""
        self._last = None

    def __call__(self, landmarks: Float[np.ndarray, "l 2"], width: int, height: int) -> Fitted:
        """Fit MediaPipe's landmarks of the next frame, in pixels of a picture of that size."""
        centered, focal = landmarks - (0.5 * width, 0.5 * height), FOCAL * max(width, height)
        if self._last is None:
            start, outlier = self._facing(centered, focal), FIRST_OUTLIER
            start, steps = self._find_pose(start, centered, focal), _LIVE_FIRST_STEPS
        else:
            start, outlier, steps = self._last, _LIVE_OUTLIER, _LIVE_STEPS
        self._last = self._descend(start, centered, focal, self._weights, outlier, steps)
        return self._last

    def learn_rest(self, seen: list[Float[np.ndarray, "l 2"]], width: int, height: int, as_it_is: bool = False) -> None:
        """Take what landmarks of a person at rest leave over as the shape of this person's face.

        Each landmark moves across the line of sight by the median of its distances, so that a blink does not count. An
        expression that is far from rest, such as an open mouth, is no shape, unless the face is taken `as_it_is`.
        """
        self._bias, self._held = np.zeros_like(self._rest), np.zeros_like(self._held)
        if not as_it_is:
            self._held = self._expression_in(seen, width, height)
        focal = FOCAL * max(width, height)
        self._bias = np.zeros_like(self._rest)
        for _ in range(2):
            offsets = []
            for landmarks in seen:
                centered, pose = landmarks - (0.5 * width, 0.5 * height), self.rest_pose(landmarks, width, height)
                points = self._points(pose)
                turned = points @ pose.rotation.T + pose.translation
                depth = -turned[:, 2]
                across = (centered - self._project(turned, focal)) * depth[:, None] / focal
                offsets.append((np.pad(across, ((0, 0), (0, 1))) @ _OPENCV) @ pose.rotation)
            self._bias = self._bias + np.median(offsets, axis=0)
        self.forget()

    def _expression_in(self, seen: list[Float[np.ndarray, "l 2"]], width: int, height: int) -> Float[np.ndarray, " k"]:
        """The part of the median expression that is no shape of the person, as far as an unknown person shows it."""
        fits = []
        for landmarks in seen:
            self.forget()
            fits.append(self(landmarks, width, height).coefficients)
        middle = torch.from_numpy(np.median(fits, axis=0))
        moved = torch.zeros_like(middle)
        eyes = ("left_eye", "right_eye")
        for limits, starts in ((_LIVE_EXPRESSION_LIMITS, _LIMITED), (_LIVE_GAZE_LIMITS, eyes)):
            ours = torch.tensor([name.startswith(starts) for name in self.names])
            moved = torch.where(ours, middle * (1 - kept_share(middle.abs(), limits)), moved)
        return moved.numpy()

    def rest_pose(self, landmarks: Float[np.ndarray, "l 2"], width: int, height: int) -> Fitted:
        """The head pose alone in a frame in which the person is at rest."""
        centered, focal = landmarks - (0.5 * width, 0.5 * height), FOCAL * max(width, height)
        start = replace(self._facing(centered, focal), coefficients=self._held)
        return self._find_pose(start, centered, focal)

    def pixels(
        self,
        rotation: Float[np.ndarray, "3 3"],
        translation: Float[np.ndarray, " 3"],
        coefficients: Float[np.ndarray, " k"],
        width: int,
        height: int,
    ) -> Float[np.ndarray, "l 2"]:
        """Where the landmarks of a face are in a picture: what `__call__` fits."""
        points = self._points(Fitted(rotation, translation, coefficients, 0.0))
        projected = self._project(points @ rotation.T + translation, FOCAL * max(width, height))
        return projected + (0.5 * width, 0.5 * height)

    def face_of(self, state: Float[np.ndarray, " s"]) -> FaceParams:
        """The face parameters of rotation, translation and coefficients, as one timestep, with identity zero."""
        given = self._layout.face_params(torch.from_numpy(state[None]), torch.zeros(1, dtype=torch.float64))
        return replace(given, **{name: tensor.float() for name, tensor in given.tensors().items()})

    def _points(self, fitted: Fitted) -> Float[np.ndarray, "l 3"]:
        turn = axis_angle_from_matrix(fitted.rotation[None])[0][:2].clip(-LARGEST_TURN, LARGEST_TURN)
        shape = self._rest + self._bias + np.tensordot(turn, self._by_turn, 1)
        return shape + self._basis @ fitted.coefficients

    @staticmethod
    def _project(turned: Float[np.ndarray, "l 3"], focal: float) -> Float[np.ndarray, "l 2"]:
        return focal * turned[:, :2] * (1.0, -1.0) / -turned[:, 2:]

    def _facing(self, centered: Float[np.ndarray, "l 2"], focal: float) -> Fitted:
        """A head that faces the camera, with the size and the place of the landmarks."""
        points = self._rest + self._bias
        middle, spread = centered.mean(0), np.linalg.norm(centered - centered.mean(0), axis=1).mean()
        size = np.linalg.norm((points - points.mean(0))[:, :2], axis=1).mean()
        depth = float(np.clip(focal * size / max(spread, 1e-6), _NEAR, _FAR))
        place = np.array([middle[0] * depth / focal, -middle[1] * depth / focal, -depth])
        return Fitted(np.eye(3), place - points.mean(0), np.zeros(len(self.names)), np.inf)

    def _find_pose(self, start: Fitted, centered: Float[np.ndarray, "l 2"], focal: float) -> Fitted:
        """The head pose from landmarks that expressions hardly move."""
        return self._descend(start, centered, focal, self._rigid, FIRST_OUTLIER, _LIVE_FIRST_STEPS, pose_only=True)

    def _descend(
        self,
        start: Fitted,
        centered: Float[np.ndarray, "l 2"],
        focal: float,
        weights: Float[np.ndarray, " l"],
        outlier: float,
        steps: int,
        pose_only: bool = False,
    ) -> Fitted:
        """Gauss-Newton steps from a start. Coefficients at a bound that a step would push beyond it take no part."""
        at, rows = start, slice(None) if weights.all() else np.flatnonzero(weights)
        pixels, share = centered[rows], weights[rows]
        for _ in range(steps):
            points = self._points(at)[rows]
            turned = points @ at.rotation.T
            world = turned + at.translation
            depth = -world[:, 2]
            offset = pixels - self._project(world, focal)
            sigma = self._sigma * focal / max(float(np.median(depth)), _NEAR)
            squared = (offset**2).sum(1) / sigma**2
            pull = share * (outlier**2 / (outlier**2 + squared)) ** 2 / sigma**2
            by_world = np.zeros((len(pixels), 2, 3))
            by_world[:, 0, 0], by_world[:, 1, 1] = focal / depth, -focal / depth
            by_world[:, 0, 2] = focal * world[:, 0] / depth**2
            by_world[:, 1, 2] = -focal * world[:, 1] / depth**2
            by_turn = by_world @ _crosses(-turned)
            parts = [by_turn, by_world]
            if not pose_only:
                parts.append((by_world @ at.rotation) @ self._basis[rows])
            jacobian = np.concatenate(parts, axis=2).reshape(2 * len(pixels), -1)
            weighted = jacobian * np.repeat(pull, 2)[:, None]
            hessian = weighted.T @ jacobian
            descent = weighted.T @ offset.reshape(-1)
            held = np.zeros(len(hessian), bool)
            if not pose_only:
                hessian[6:, 6:] += self._prior
                descent[6:] -= self._prior @ at.coefficients
                held[6:] = ((at.coefficients <= self._lower) & (descent[6:] < 0)) | (
                    (at.coefficients >= self._upper) & (descent[6:] > 0)
                )
            free = ~held
            normal = hessian[np.ix_(free, free)]
            normal[np.diag_indices_from(normal)] *= 1 + 1e-6
            step = np.zeros(len(hessian))
            step[free] = np.linalg.solve(normal, descent[free])
            rotation = matrix_from_axis_angle(step[None, :3])[0] @ at.rotation
            translation = at.translation + step[3:6]
            translation[2] = np.clip(translation[2], -_FAR, -_NEAR)
            coefficients = at.coefficients
            if not pose_only:
                coefficients = np.clip(coefficients + step[6:], self._lower, self._upper)
            error = float(np.sqrt((share * (offset**2).sum(1)).sum() / share.sum()))
            at = Fitted(rotation, translation, coefficients, error)
        return at


def _crosses(vectors: Float[np.ndarray, "l 3"]) -> Float[np.ndarray, "l 3 3"]:
    """The matrices that multiply a vector by these from the left, as a cross product."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)
