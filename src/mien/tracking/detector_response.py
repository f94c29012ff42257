"""Where a landmark detector sees the points of a face model on people: measured once, and what trackers expect.

The embedding names the point of the surface that each landmark means. But a detector has habits: it puts a chin where
its annotators did, closes lids later than they close, turns heads less than they turn, and takes every person a little
for somebody else. `mien.synthetic.detector_calibration` measures these habits over synthetic people.
"""

from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from mien.face import FaceModel

_COMMAND = "python -m mien.synthetic.detector_calibration"
_LARGEST_TURN = 0.6
"""Radians beyond which turns were not measured."""


@dataclass(frozen=True, eq=False)
class DetectorResponse:
    """Offsets of l detected points from a face model's, metres in the head frame at rest, float64: a linear model."""

    mean: Float[Tensor, "l 3"]
    by_turn: Float[Tensor, "2 l 3"]
    """A radian of the head rotation's x and y components (about pitch and yaw), seen from the camera."""
    by_expression: Float[Tensor, "e l 3"]
    """A unit of each coefficient."""
    by_person: Float[Tensor, "k l 3"]
    """A standard deviation of each principal component of what differs between people."""
    rest_sigma: float
    """Standard deviation along each axis of what these components leave of a person."""

    def of_turns(self, head_rotation: Float[Tensor, "b 3"]) -> Float[Tensor, "b l 3"]:
        """The part that follows the head's turning away from the camera."""
        turns = head_rotation[:, :2].clamp(-_LARGEST_TURN, _LARGEST_TURN)
        return (turns @ self.by_turn.flatten(1)).reshape(len(turns), *self.mean.shape)

    def of_person(self, person: Float[Tensor, " k"]) -> Float[Tensor, "l 3"]:
        """The part that is a person's own, beside the mean."""
        return (person @ self.by_person.flatten(1)).reshape(self.mean.shape)

    def at(self, landmarks: Int[Tensor, " n"]) -> "DetectorResponse":
        """Of some of the landmarks."""
        return DetectorResponse(
            self.mean[landmarks], self.by_turn[:, landmarks], self.by_expression[:, landmarks],
            self.by_person[:, landmarks], self.rest_sigma,
        )  # fmt: skip

    def without_turns(self) -> "DetectorResponse":
        """For several cameras, which see a head from as many sides."""
        return replace(self, by_turn=torch.zeros_like(self.by_turn))


def unknown_response(landmarks: int, expressions: int, sigma: float) -> DetectorResponse:
    """Nothing known but how far points may be off."""
    zeros = torch.zeros(landmarks, 3, dtype=torch.float64)
    return DetectorResponse(
        zeros, zeros.expand(2, -1, -1), zeros.expand(expressions, -1, -1), zeros.expand(0, -1, -1), sigma
    )


def response_path(face_model_name: str) -> Path:
    """The file of a face model that comes with mien; it need not exist."""
    return Path(str(resources.files("mien.tracking") / "data" / f"{face_model_name}_detector.npz"))


def read_response(face_model: FaceModel, sigma: float) -> DetectorResponse:
    """What was measured for this face model; for another mesh than the measured one nothing but `sigma` is known."""
    path, expressions = response_path(face_model.name), len(face_model.expression_names)
    landmarks = len(face_model.landmarks["mediapipe"].faces)
    if not path.is_file():
        return unknown_response(landmarks, expressions, sigma)
    with np.load(path, allow_pickle=False) as file:
        if str(file["topology_hash"]) != face_model.topology_hash:
            return unknown_response(landmarks, expressions, sigma)
        scale = 1e-3  # kept in millimetres: half precision is fine for them
        mean, by_turn, by_expression, by_person = (
            scale * torch.from_numpy(file[name].astype(np.float64))
            for name in ("mean", "by_turn", "by_expression", "by_person")
        )
        return DetectorResponse(mean, by_turn, by_expression, by_person, scale * float(file["rest_sigma"]))


def write_response(path: Path, face_model: FaceModel, response: DetectorResponse, people: int) -> None:
    """Write what `read_response` reads."""
    arrays = {
        name: (1e3 * getattr(response, name)).numpy().astype(np.float16)
        for name in ("mean", "by_turn", "by_expression", "by_person")
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(
        path, rest_sigma=1e3 * response.rest_sigma, people=people, topology_hash=face_model.topology_hash,
        content_hash=face_model.content_hash, command=f"{_COMMAND} {face_model.name}",
        **arrays,
    )  # fmt: skip
