"""Systematic offsets of a landmark detector from the landmarks of a face model, measured once for the tracker.

The embedding gives the point of the surface for each landmark. But a detector has habits. It puts the chin where its
annotators did, closes eyelids too late, turns heads too little, and gets the shape of every person slightly wrong.
`benchmarks/detector_calibration.py` measures these habits on synthetic people.
"""

from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from mien.capture.person.backend import Detector, FoundBy
from mien.face.model import FaceModel

LARGEST_TURN = 0.6
"""Largest turn of the head from which the detector's response was measured, in radians. Farther turns count as this
one. It belongs to the drawn people of the measurement (log, "The landmark detector")."""
_ARRAYS = ("mean", "by_turn", "by_expression", "by_person")
_OF_MEDIAPIPE = ("by_expression", "by_person")
"""Arrays that every detector has from mediapipe's file, because they were measured on more people there."""


@dataclass(frozen=True, eq=False)
class DetectorResponse:
    """Linear model of the offsets of l detected landmarks, in metres, in the head frame at rest, float64."""

    mean: Float[Tensor, "l 3"]
    by_turn: Float[Tensor, "2 l 3"]
    """Offset per radian of the x and y components (roughly pitch and yaw) of the head rotation seen by the camera."""
    by_expression: Float[Tensor, "e l 3"]
    """Offset per unit of each expression coefficient."""
    by_person: Float[Tensor, "k l 3"]
    """Offset per standard deviation of each principal component of the differences between people."""
    rest_sigma: float
    """Standard deviation, along each axis, of the part of a person's offsets that these components do not explain."""

    def of_turns(self, head_rotation: Float[Tensor, "b 3"]) -> Float[Tensor, "b l 3"]:
        """The part of the offsets that depends on how far the head turns away from the camera."""
        turns = head_rotation[:, :2].clamp(-LARGEST_TURN, LARGEST_TURN)
        return (turns @ self.by_turn.flatten(1)).reshape(len(turns), *self.mean.shape)

    def of_person(self, person: Float[Tensor, " k"]) -> Float[Tensor, "l 3"]:
        """The part of the offsets that one person adds to the mean."""
        return (person @ self.by_person.flatten(1)).reshape(self.mean.shape)

    def at(self, landmarks: Int[Tensor, " n"]) -> "DetectorResponse":
        """The response for some of the landmarks."""
        return DetectorResponse(
            self.mean[landmarks], self.by_turn[:, landmarks], self.by_expression[:, landmarks],
            self.by_person[:, landmarks], self.rest_sigma,
        )  # fmt: skip

    def without_turns(self) -> "DetectorResponse":
        """The response for several cameras. They see the head from several sides, so no one turn applies."""
        return replace(self, by_turn=torch.zeros_like(self.by_turn))


OFFSET_SIGMA = 0.003
"""Standard deviation of a landmark's offset on the subject from the model's, in metres, for face models without a
measured response."""


def unknown_response(landmarks: int, expressions: int, sigma: float = OFFSET_SIGMA) -> DetectorResponse:
    """A response of zeros: only the standard deviation `sigma` of the offsets is known."""
    zeros = torch.zeros(landmarks, 3, dtype=torch.float64)
    return DetectorResponse(
        zeros, zeros.expand(2, -1, -1), zeros.expand(expressions, -1, -1), zeros.expand(0, -1, -1), sigma
    )


def response_path(face_model_name: str, detector: FoundBy = "mediapipe") -> Path:
    """Path of the response file that ships with mien for a face model and a detector. The file may not exist."""
    ending = "detector" if detector == "mediapipe" else detector
    return Path(str(resources.files("mien.tracking") / "data" / f"{face_model_name}_{ending}.npz"))


def read_response(face_model: FaceModel, sigma: float, detector: FoundBy = "mediapipe") -> DetectorResponse:
    """Read the response measured for a face model and detector. Without one for the mesh, only `sigma` is known."""
    path, of_mediapipe = response_path(face_model.name, detector), response_path(face_model.name)
    landmarks, expressions = len(face_model.landmarks["mediapipe"].faces), len(face_model.expression_names)
    if not (path.is_file() and of_mediapipe.is_file()):
        return unknown_response(landmarks, expressions, sigma)
    with np.load(path, allow_pickle=False) as file, np.load(of_mediapipe, allow_pickle=False) as base:
        if not str(file["topology_hash"]) == str(base["topology_hash"]) == face_model.topology_hash:
            return unknown_response(landmarks, expressions, sigma)
        scale = 1e-3  # Files hold millimetres, for which half precision is enough.
        mean, by_turn, by_expression, by_person = (
            scale * torch.from_numpy((base if name in _OF_MEDIAPIPE else file)[name].astype(np.float64))
            for name in _ARRAYS
        )
        return DetectorResponse(mean, by_turn, by_expression, by_person, scale * float(file["rest_sigma"]))


def write_response(
    path: Path, face_model: FaceModel, response: DetectorResponse, people: int, detector: Detector = "mediapipe"
) -> None:
    """Write a response for `read_response`. Of another detector than mediapipe, it leaves out what is mediapipe's."""
    arrays = {
        name: (1e3 * getattr(response, name)).numpy().astype(np.float16)
        for name in _ARRAYS
        if detector == "mediapipe" or name not in _OF_MEDIAPIPE
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    ending = "" if detector == "mediapipe" else f" --detector {detector}"
    np.savez_compressed(
        path, rest_sigma=1e3 * response.rest_sigma, people=people, topology_hash=face_model.topology_hash,
        content_hash=face_model.content_hash,
        command=f"python benchmarks/detector_calibration.py {face_model.name}{ending}", **arrays,
    )  # fmt: skip
