"""From landmarks of a camera's frames to the face of an avatar: calibration, smoothing, limits, and rest.

Values are smoothed by the One Euro filter (Casiez, Roussel and Vogel, CHI 2012): a low pass whose cutoff grows with the
speed of each value, so that slow values lose their jitter, and fast ones have no lag.
"""

import math
import threading
from collections import deque
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float

from mien.avatar.baking import as_array
from mien.driving.landmark_fit import Fitted, LandmarkFit
from mien.driving.rest import REST_HEAD, kept_share, rest_of
from mien.driving.transfer import Torso, drive, keep_to_filmed, place_torso
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.runtime.baked import Filmed
from mien.runtime.posing import Face
from mien.runtime.rotation import axis_angle_from_matrix, matrix_from_axis_angle

_LEARN_SECONDS = 1.0  # time over which the face at rest is learnt, in seconds
LEARN_LEAST_FRAMES = 8  # least number of frames from which it is learnt
_AWAY_SECONDS = 0.4  # time without a face after which the avatar goes to rest
_REST_SECONDS = 0.35  # time in which the avatar goes two thirds of the way to rest, in seconds
_HEAD_CUTOFF = (1.2, 12.0)
"""Cutoff of the smoothing at rest in Hz, and its growth in Hz for a speed of 1 a second, of the head's angles in
radians. Not varied, as the next two and that of other coefficients; those of the page were measured (log, "One Euro
filter")."""
_PLACE_CUTOFF = (1.0, 40.0)  # the same of the head's place in metres
_EYE_CUTOFF = (2.5, 4.0)
"""The same of eyes and lids. Measured: without smoothing of eyes and mouth, the mean correlation with the truth is
0.912 instead of 0.913 (log, 11-23)."""
_MOUTH_CUTOFF = (2.0, 4.0)  # the same of jaw and mouth
_SPEED_CUTOFF = 3.0
"""Cutoff of the low pass of the speeds, in Hz. Chosen for the exported page with the other two numbers of its filter
(log, "One Euro filter")."""
_OTHER_CUTOFF = (1.2, 2.0)  # the same of the other coefficients

State = Literal["waiting", "learning", "following", "resting"]
"""waiting: there was no face yet. learning: the face at rest is being learnt. following. resting: the face is away."""


class OneEuro:
    """The filter of n values."""

    def __init__(self, cutoff: Float[np.ndarray, " n"], beta: Float[np.ndarray, " n"]) -> None:
        """Start with a cutoff at rest in Hz, which grows by `beta` Hz for a speed of one unit a second."""
        self._cutoff, self._beta = cutoff, beta
        self._value: Float[np.ndarray, " n"] | None = None
        self._speed = np.zeros(len(cutoff))
        self._seconds = 0.0

    def __call__(self, value: Float[np.ndarray, " n"], seconds: float) -> Float[np.ndarray, " n"]:
        """The smoothed value at a time, which increases. The first value stays as it is."""
        if self._value is None:
            self._value = value.copy()
        elif seconds > self._seconds:
            elapsed = seconds - self._seconds
            speed = (value - self._value) / elapsed
            self._speed += _share(np.full(len(value), _SPEED_CUTOFF), elapsed) * (speed - self._speed)
            cutoff = self._cutoff + self._beta * np.abs(self._speed)
            self._value = self._value + _share(cutoff, elapsed) * (value - self._value)
        self._seconds = seconds
        return self._value.copy()


def _share(cutoff: Float[np.ndarray, " n"], elapsed: float) -> Float[np.ndarray, " n"]:
    """Share of the new value in a low pass."""
    return 1 / (1 + 1 / (2 * math.pi * cutoff * elapsed))


@dataclass(frozen=True)
class FollowOptions:
    """How an avatar follows."""

    head_pose: bool = True
    unlimited: bool = False
    """Whether the avatar follows also beyond what it was filmed with."""
    torso: Torso = "still"


class Follower:
    """Makes an avatar follow landmarks, frame after frame. `recalibrate` may be called from any thread."""

    def __init__(
        self,
        model: FaceModel,
        person: FaceParams,
        filmed: Filmed | None,
        eye: Float[np.ndarray, " 3"],
        options: FollowOptions | None = None,
    ) -> None:
        """Prepare to follow with the avatar's person at rest (one timestep). `filmed` is None for no limits.

        `eye` is the position of the camera that sees the avatar, in world space, in metres.
        """
        self._options = options or FollowOptions()
        self._model, self._person = model, person
        # The avatar's head stays where it was filmed: which camera it faced is not known here.
        ahead = replace(person, head_rotation=torch.zeros_like(person.head_rotation))
        self._at_rest = replace(rest_of(ahead, model).face, head_rotation=person.head_rotation)
        self._filmed = None if self._options.unlimited else filmed
        self._eye = torch.from_numpy(np.asarray(eye, np.float32))
        self._fit = LandmarkFit(model, person)
        self._lock = threading.Lock()
        self._learning: deque[tuple[float, np.ndarray]] = deque(maxlen=120)
        self._rest: tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, " 3"]] | None = None
        """Rotation and translation of the head at rest."""
        self._seen_at: float | None = None
        self._values = np.zeros(6 + len(self._fit.names))
        self._driven_at = 0.0
        self._smoothing = self._new_smoothing()
        self._must_learn = self._asked = False
        self.state: State = "waiting"
        self.error = float("nan")
        """Weighted root mean square distance in pixels between landmarks and their fit in the last frame."""

    def recalibrate(self) -> None:
        """Learn the face at rest anew from the next second, whatever it shows: the person asks for it."""
        with self._lock:
            self._must_learn = True

    def __call__(self, landmarks: Float[np.ndarray, "l 2"] | None, width: int, height: int, seconds: float) -> Face:
        """The avatar's face after the next frame, of that size in pixels and at that time. None if there is no face."""
        with self._lock:
            if self._must_learn:
                self._must_learn, self._asked, self._rest = False, True, None
                self._learning.clear()
        if landmarks is None:
            self._without_face(seconds)
        elif self._rest is None:
            self._seen_at = seconds
            self._learn(landmarks, width, height, seconds)
            self._towards_rest(seconds)
        else:
            self._seen_at = seconds
            self._follow(self._fit(landmarks, width, height), seconds)
        self._driven_at = seconds
        return self._face()

    def _learn(self, landmarks: Float[np.ndarray, "l 2"], width: int, height: int, seconds: float) -> None:
        self.state = "learning"
        if self._learning and seconds - self._learning[-1][0] > _AWAY_SECONDS:
            self._learning.clear()
        self._learning.append((seconds, landmarks))
        if seconds - self._learning[0][0] < _LEARN_SECONDS or len(self._learning) < LEARN_LEAST_FRAMES:
            return
        seen = [one for _, one in self._learning]
        # A handful of frames says as much as all of them, and a picture must not wait.
        seen = seen[:: max(1, len(seen) // LEARN_LEAST_FRAMES)]
        self._fit.learn_rest(seen, width, height, self._asked)
        poses = [self._fit.rest_pose(one, width, height) for one in seen]
        middle = poses[len(poses) // 2].rotation
        turns = axis_angle_from_matrix(np.stack([middle.T @ pose.rotation for pose in poses]))
        rotation = middle @ matrix_from_axis_angle(np.median(turns, axis=0)[None])[0]
        # A head far aside from the camera is turned, not at rest, unless the person says that it is.
        away = axis_angle_from_matrix(rotation[None])
        share = float(kept_share(torch.tensor(np.linalg.norm(away)), REST_HEAD))
        rotation = rotation if share == 1 or self._asked else matrix_from_axis_angle(share * away)[0]
        self._rest = rotation, np.median([pose.translation for pose in poses], axis=0)
        self._learning.clear()
        self._smoothing = self._new_smoothing()
        self._smoothing(self._values, self._driven_at)

    def _follow(self, fitted: Fitted, seconds: float) -> None:
        self.state, self.error = "following", fitted.error
        assert self._rest is not None
        rotation, translation = self._rest
        turn = axis_angle_from_matrix((rotation.T @ fitted.rotation)[None])[0]
        moved = rotation.T @ (fitted.translation - translation)
        self._values = self._smoothing(np.concatenate([turn, moved, fitted.coefficients]), seconds)

    def _without_face(self, seconds: float) -> None:
        if self._seen_at is None or seconds - self._seen_at > _AWAY_SECONDS:
            self.state = "waiting" if self._rest is None else "resting"
            self._fit.forget()
            self._towards_rest(seconds)

    def _towards_rest(self, seconds: float) -> None:
        """Go to rest gently. When the face is back, the smoothing starts from here."""
        self._values = self._values * np.exp(-max(0.0, seconds - self._driven_at) / _REST_SECONDS)
        self._smoothing = self._new_smoothing()
        self._smoothing(self._values, seconds)

    def _face(self) -> Face:
        driver, at_rest = self._fit.face_of(self._values), self._fit.face_of(np.zeros_like(self._values))
        bounds = self._model.expression_bounds
        face = drive(driver, at_rest, self._at_rest, bounds, self._options.head_pose)
        if self._filmed is not None:
            face = keep_to_filmed(face, self._filmed, self._person, self._model, self._eye)[0]
        face = place_torso(self._model, face, self._person, self._options.torso)
        return Face(
            *(as_array(field)[0] for field in (face.expression, face.joints, face.head_rotation, face.head_translation))
        )

    def _new_smoothing(self) -> OneEuro:
        pose = [_HEAD_CUTOFF] * 3 + [_PLACE_CUTOFF] * 3
        return OneEuro(*np.array([*pose, *map(_cutoff, self._fit.names)]).T)


def _cutoff(name: str) -> tuple[float, float]:
    lowered = name.lower()
    if "eye" in lowered:
        return _EYE_CUTOFF
    return _MOUTH_CUTOFF if lowered.startswith(("mouth", "jaw", "tongue")) else _OTHER_CUTOFF
