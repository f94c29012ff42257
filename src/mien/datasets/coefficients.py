"""Sequences with poses and coefficients of a head model that is not published.

They get a head that the coefficients do not move (`mien.face.loading`). The poses are in that model's own
axes and unit. One turn, one shift and one scale lead to them from mien's head frame. They are found by landmarks.
"""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float

from mien.datasets.content import REMEDY
from mien.datasets.dataset import FilmedSequence, ReadSequence, TrackedSequence
from mien.datasets.flame_poses import AXES, FRONT, axis_angles, camera_of
from mien.datasets.overlay import spread_out
from mien.datasets.sequences import tracked_sequence
from mien.errors import UserError
from mien.face.loading import coefficient_count
from mien.face.model import FaceModel

Place = tuple[Float[np.ndarray, "3 3"], float, Float[np.ndarray, " 3"]]
"""Turn R, scale s and shift d of mien's head in the axes of other poses: x -> s R x + d."""
_MARKS, _FACE_MARKS = "mediapipe", 468  # the landmarks of mien's detector, and how many of them are not on the irises
_FRAMES, _EVERY = 40, 6  # most frames, and every how many landmarks, by which the place is found
_CORNERS = (33, 263)  # MediaPipe's points at the outer corners of the eyes
_MAX_DISTANCE = 0.25
"""Largest median distance of landmarks from those of the pictures, over that of the outer corners of the eyes. The mean
head has about 0.1."""


def on_coefficients(
    path: Path, sequences: Iterable[ReadSequence], face_model: FaceModel | None
) -> Iterator[ReadSequence]:
    """Yield sequences with their authors' poses and coefficients, if the user named a model `coefficients-N`.

    They share the place of the head, which is found in the first one.
    """
    place = None
    for sequence in sequences:
        if face_model is None or coefficient_count(face_model.name) is None:
            yield sequence
        else:
            assert isinstance(sequence, FilmedSequence)
            tracked, place = with_coefficients(path, sequence, face_model, place)
            yield tracked


def with_coefficients(
    path: Path, sequence: FilmedSequence, face_model: FaceModel, place: Place | None = None
) -> tuple[TrackedSequence, Place]:
    """Return the sequence with its authors' poses and coefficients as its tracking, and the place of the head.

    It has one camera, and `expression` and `head_to_camera` among its foreign arrays. `place` is that of the head
    (`head_place`), or None to find it.
    """
    capture, coefficients = sequence.capture, sequence.foreign["expression"]
    poses = sequence.foreign["head_to_camera"].astype(np.float64)
    if coefficients.shape[1] != len(face_model.expression_names):
        raise UserError(
            f"{path}: has {coefficients.shape[1]} coefficients, and --face-model {face_model.name} has "
            f"{len(face_model.expression_names)}; give --face-model coefficients-{coefficients.shape[1]}"
        )
    assert capture.calibration is not None
    K = capture.calibration[0].K.double().numpy()
    usable = np.flatnonzero(capture.valid[:, 0])
    usable = usable[spread_out(len(usable), _FRAMES)]
    points = face_model.landmark_positions(face_model.head_vertices(face_model.neutral()), _MARKS)[0]
    marks, seen = points[:_FACE_MARKS].double().numpy(), capture.landmarks[usable, 0, :_FACE_MARKS].astype(np.float64)
    if place is None:
        try:
            place = head_place(marks[::_EVERY], seen[:, ::_EVERY], poses[usable], K)
        except (cv2.error, ValueError, np.linalg.LinAlgError):  # of numbers that are finite and no poses of a head
            raise UserError(f"{path}: no place of the head fits its poses and landmarks; {REMEDY}") from None
    turn, scale, shift = place
    rotations, translations = poses[:, :3, :3] @ turn, (poses[:, :3, :3] @ shift + poses[:, :3, 3]) / scale
    _check_places(path, marks, seen, rotations[usable], translations[usable], K)
    face = replace(
        face_model.neutral(len(poses)),
        expression=torch.from_numpy(coefficients.astype(np.float32)),
        head_rotation=torch.from_numpy(axis_angles(AXES @ rotations)).float(),
        head_translation=torch.from_numpy(translations @ AXES).float(),
    )
    camera = {capture.camera_ids[0]: camera_of(K, FRONT, (capture.images.shape[3], capture.images.shape[2]))}
    tracked = tracked_sequence(
        path, capture.name, capture.images, capture.mattes, camera, face_model, face, capture.fps
    )
    return replace(tracked, own_split=sequence.own_split, foreign=sequence.foreign), place


def head_place(
    marks: Float[np.ndarray, "l 3"], seen: Float[np.ndarray, "t l 2"], poses: Float[np.ndarray, "t 4 4"],
    K: Float[np.ndarray, "3 3"],
) -> Place:  # fmt: skip
    """Return the place of the head in the axes of the poses.

    `marks` are landmarks of the head at rest, in metres, and `seen` the same in pictures, in pixels. `poses` lead from
    the axes of the other head to those of the camera, in any unit.
    """
    from scipy.optimize import least_squares

    marks, seen = np.ascontiguousarray(marks), np.ascontiguousarray(seen)
    found = [cv2.solvePnP(marks, each, K, None, flags=cv2.SOLVEPNP_SQPNP) for each in seen]
    turns = np.stack([cv2.Rodrigues(turn)[0] for _, turn, _ in found])
    places = np.stack([place[:, 0] for _, _, place in found])
    u, _, vt = np.linalg.svd((poses[:, :3, :3].transpose(0, 2, 1) @ turns).sum(0))
    turn = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    # The first scale: that of the places in front of the camera, with the origins of both heads at one point.
    scale = float(np.linalg.norm(poses[:, :3, 3], axis=1).mean() / np.linalg.norm(places, axis=1).mean())
    shift = (poses[:, :3, :3].transpose(0, 2, 1) @ (scale * places - poses[:, :3, 3])[..., None]).mean(0)[:, 0]

    def residuals(values: np.ndarray) -> np.ndarray:
        small = cv2.Rodrigues(values[:3])[0]
        placed = np.exp(values[3]) * marks @ (turn @ small).T + scale * values[4:]
        camera = np.einsum("tij,lj->tli", poses[:, :3, :3], placed) + poses[:, None, :3, 3]
        pixels = camera @ K.T
        return (pixels[..., :2] / np.maximum(pixels[..., 2:], 1e-6 * scale) - seen).ravel()

    start = np.concatenate([np.zeros(3), [np.log(scale)], shift / scale])
    values = least_squares(residuals, start, loss="soft_l1", f_scale=0.02 * float(np.ptp(seen[0, :, 0]))).x
    return turn @ cv2.Rodrigues(values[:3])[0], float(np.exp(values[3])), scale * values[4:]


def _check_places(
    path: Path, marks: np.ndarray, seen: np.ndarray, rotations: np.ndarray, translations: np.ndarray, K: np.ndarray
) -> None:
    pixels = (np.einsum("tij,lj->tli", rotations, marks) + translations[:, None]) @ K.T
    distances = np.linalg.norm(pixels[..., :2] / pixels[..., 2:] - seen, axis=-1)
    eyes = np.linalg.norm(seen[:, _CORNERS[0]] - seen[:, _CORNERS[1]], axis=-1)
    apart = float(np.median(distances) / max(np.median(eyes), 1e-6))
    if not apart < _MAX_DISTANCE:
        raise UserError(
            f"{path}: by its poses, landmarks are {apart:.0%} of the distance of the eyes off; "
            f"{REMEDY}, or track the pictures instead (--retrack)"
        )
