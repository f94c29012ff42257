"""The data of a fit: pictures in which a face was found, and the cameras that took them."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mien.camera import Camera


@dataclass(frozen=True, eq=False)
class CameraBatch:
    """A batch of c pinhole cameras as tensors (docs/conventions.md)."""

    K: Float[Tensor, "c 3 3"]
    viewmat: Float[Tensor, "c 4 4"]

    def __getitem__(self, index: Int[Tensor, " n"]) -> "CameraBatch":
        """The cameras of n pictures."""
        return CameraBatch(self.K[index], self.viewmat[index])

    def __len__(self) -> int:
        """The number of cameras, c."""
        return len(self.K)

    @property
    def centers(self) -> Float[Tensor, "c 3"]:
        """The cameras' positions in world space."""
        return -(self.viewmat[:, :3, :3].mT @ self.viewmat[:, :3, 3:])[..., 0]

    def project(self, points: Float[Tensor, "c l 3"]) -> Float[Tensor, "c l 2"]:
        """Project each camera's own world-space points into its picture, in pixels."""
        in_camera = points @ self.viewmat[:, :3, :3].mT + self.viewmat[:, None, :3, 3]
        return (in_camera @ self.K.mT)[..., :2] / in_camera[..., 2:]

    def with_focal(self, factor: float) -> "CameraBatch":
        """The same cameras with their focal lengths multiplied by a factor."""
        K = self.K.clone()
        K[:, 0, 0] *= factor
        K[:, 1, 1] *= factor
        return replace(self, K=K)


def batch_of(cameras: tuple[Camera, ...]) -> CameraBatch:
    """The cameras as a batch, in float64."""
    return CameraBatch(
        torch.stack([camera.K.double() for camera in cameras]),
        torch.stack([camera.viewmat.double() for camera in cameras]),
    )


@dataclass(frozen=True, eq=False)
class Views:
    """The n pictures of v timesteps of one sequence in which a camera found the landmarks of the face."""

    detected: Float[Tensor, "n l 2"]
    """Detected landmarks, in pixels."""
    row: Int[Tensor, " n"]
    """Index of each picture's timestep among the v. Every timestep has at least one picture."""
    camera: Int[Tensor, " n"]
    """Index of each picture's camera in the sequence."""
    trust: Float[Tensor, " n"]
    """Weight of each picture's landmarks, 0..1 (`trust_of`)."""

    @property
    def rows(self) -> int:
        """The number of timesteps, v."""
        return int(self.row.max()) + 1

    def at(self, rows: Int[Tensor, " k"]) -> "Views":
        """The pictures of some of the timesteps, with rows numbered in the order given."""
        new_row = torch.full((self.rows,), -1)
        new_row[rows] = torch.arange(len(rows))
        kept = new_row[self.row] >= 0
        return Views(self.detected[kept], new_row[self.row[kept]], self.camera[kept], self.trust[kept])

    def seen_by(self, row: int) -> list[int]:
        """The cameras that have a picture of a timestep."""
        return self.camera[self.row == row].tolist()

    def some(self, pictures: slice) -> "Views":
        """Some of the pictures. Timesteps keep their numbers."""
        return Views(self.detected[pictures], self.row[pictures], self.camera[pictures], self.trust[pictures])

    def of_landmarks(self, landmarks: Int[Tensor, " k"]) -> "Views":
        """The same pictures with only some of the landmarks."""
        return replace(self, detected=self.detected[:, landmarks])

    def apart(self) -> "Views":
        """The same pictures, each as a timestep of its own."""
        return replace(self, row=torch.arange(len(self.row)))
