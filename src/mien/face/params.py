"""FaceParams: pose and expression of a face at each timestep, in a face model's own parameters."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Float
from torch import Tensor

from mien.camera import Camera
from mien.rotation import matrix_from_axis_angle, rigid_transform


@dataclass(frozen=True, eq=False)
class FaceParams:
    """Parameters of one subject at b timesteps."""

    identity: Float[Tensor, " i"]
    """Coefficients of the identity basis, unit variance over people."""
    expression: Float[Tensor, "b e"]
    """Coefficients of the expression basis, mostly 0..1."""
    joints: Float[Tensor, "b j 3"]
    """Axis-angle in radians of the model's free joints (`FaceModel.free_joint_names`), zero at rest."""
    head_rotation: Float[Tensor, "b 3"]
    """Axis-angle of the head frame (+x to the subject's left, +y up, +z ahead) in world space, in radians."""
    head_translation: Float[Tensor, "b 3"]
    """Origin of the head frame in world space, in metres."""
    vertex_offsets: Float[Tensor, "v 3"] | None = None
    """Static offsets of this subject's vertices in the head frame, in metres."""

    def __len__(self) -> int:
        return self.expression.shape[0]

    def __getitem__(self, index: int | slice | Sequence[int] | Tensor) -> "FaceParams":
        """Return some timesteps. The batch axis is kept, also for a single timestep."""
        if isinstance(index, int):
            index = slice(index, index + 1) if index != -1 else slice(-1, None)
        return replace(
            self,
            expression=self.expression[index],
            joints=self.joints[index],
            head_rotation=self.head_rotation[index],
            head_translation=self.head_translation[index],
        )

    @property
    def T_world_head(self) -> Float[Tensor, "b 4 4"]:
        """Pose of the head frame in world space."""
        return rigid_transform(matrix_from_axis_angle(self.head_rotation), self.head_translation)

    def tensors(self) -> dict[str, Tensor]:
        """Return every tensor that is not None, by the name of its field."""
        return {f.name: value for f in fields(self) if (value := getattr(self, f.name)) is not None}

    def to(self, like: Tensor) -> "FaceParams":
        """Return the same parameters with the dtype and device of `like`."""
        return FaceParams(**{name: tensor.to(like) for name, tensor in self.tensors().items()})

    def detach(self) -> "FaceParams":
        """Return the same values, detached from the autograd graph."""
        return FaceParams(**{name: tensor.detach() for name, tensor in self.tensors().items()})


def most_frontal_camera(cameras: Sequence[Camera], face: FaceParams) -> int:
    """The index of the camera that the face looks at most directly, as the median over the timesteps of `face`."""
    ahead, origins = face.T_world_head[:, :3, 2], face.head_translation
    facing = [
        torch.nn.functional.cosine_similarity(ahead, camera.position - origins, dim=1).median() for camera in cameras
    ]
    return int(torch.stack(facing).argmax())


def concatenate(parts: Sequence[FaceParams]) -> FaceParams:
    """Concatenate the timesteps of all parts. Identity and offsets are the first part's."""
    return replace(
        parts[0],
        expression=torch.cat([p.expression for p in parts]),
        joints=torch.cat([p.joints for p in parts]),
        head_rotation=torch.cat([p.head_rotation for p in parts]),
        head_translation=torch.cat([p.head_translation for p in parts]),
    )
