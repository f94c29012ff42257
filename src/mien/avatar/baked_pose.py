"""Pose the baked form of an avatar from `FaceParams`, for methods whose networks are slower than what they bake."""

from collections.abc import Callable, Iterable
from typing import Generic, TypeVar

import torch
from torch import Tensor

from mien import runtime
from mien.arrays import is_native
from mien.face.params import FaceParams
from mien.face.posing import head_poses
from mien.gaussians import Gaussians
from mien.runtime.baked import BakedAvatar

T = TypeVar("T")


class Kept(Generic[T]):
    """A result that is kept until one of the tensors that it was made from changes."""

    def __init__(self) -> None:
        self._of: list[tuple[Tensor, int]] = []
        self._result: T | None = None

    def of(self, tensors: Iterable[Tensor], make: Callable[[], T]) -> T:
        """The result of `make`, called again only if there are other tensors, or torch has changed one in place."""
        # Held here, so that no other tensor can take the place of one that is gone.
        now = [(tensor, tensor._version) for tensor in tensors]
        same = len(now) == len(self._of) and all(
            a is b and version == before for (a, version), (b, before) in zip(now, self._of, strict=True)
        )
        if self._result is None or not same:
            self._of, self._result = now, make()
        return self._result


def can_pose_baked(like: Tensor, face: FaceParams) -> bool:
    """Whether the runtime can pose a face: on a CPU, in float32, without gradients."""
    wanted = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in face.tensors().values())
    return is_native(like) and not wanted


@torch.no_grad()
def pose_baked(baked: BakedAvatar, face: FaceParams) -> Gaussians:
    """The Gaussians of some timesteps, as a batch, from a baked avatar in the head frame."""
    found = []
    for timestep in range(len(face)):
        names = ("expression", "joints", "head_rotation", "head_translation")
        own = (getattr(face, name)[timestep].detach().float().cpu().contiguous().numpy() for name in names)
        found.append(runtime.pose(baked, runtime.Face(*own)))
    means, quats, scales, opacities, sh = (
        torch.stack([torch.from_numpy(getattr(one, name)) for one in found])
        for name in ("means", "quats", "scales", "opacities", "sh")
    )
    quats = torch.nn.functional.normalize(quats, dim=-1)
    return Gaussians(means, quats, scales, opacities, sh, head_poses(face).detach())
