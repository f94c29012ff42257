"""CUDA graphs of a method's pose, between rounds of density: one launch forward and one backward in place of all.

With `MIEN_GPU_GRAPHS=1`. A graph repeats launches on the same memory with the same numbers from the host. So it holds
while all tensors of the avatar stay where they are and the method says that these numbers stay (`Extras.graph_key`).
Where there is no graph, the pose is the avatar's own: on a processor, for methods without a key, in the first step
after a change, and for good once PyTorch could not make one. What reads from the GPU, as gsplat does, is never in it.
"""

import os
from collections.abc import Callable, Hashable
from dataclasses import fields, replace
from typing import Any

import torch
from torch import Tensor, nn

from mien.avatar.avatar import Avatar, Posed
from mien.avatar.settings import Progress
from mien.face.params import FaceParams
from mien.gaussians import Gaussians
from mien.machine.terminal import tell

VARIABLE = "MIEN_GPU_GRAPHS"
_MOVING = ("expression", "joints", "head_rotation", "head_translation")
_TENSORS = [field.name for field in fields(Gaussians)]


class PoseGraph:
    """Poses an avatar, by a graph where that is wanted and possible."""

    def __init__(self) -> None:
        self._key: Hashable = None
        self._call: Callable[..., tuple[Tensor, ...]] | None = None
        self._wanted = os.environ.get(VARIABLE) == "1"

    def pose(self, avatar: Avatar, face: FaceParams, progress: Progress) -> Posed:
        """The same as `Avatar.pose`. The tensors of a result hold until the next one."""
        key_of = avatar.extras.graph_key
        own = key_of(progress) if key_of is not None and self._wanted and is_on_gpu(face) else None
        if own is None:
            return avatar.pose(face, progress)
        moving = [getattr(face, name) for name in _MOVING]
        known = [*avatar.parameters(), *avatar.buffers(), face.identity, face.vertex_offsets]
        key = (own, [_place(one) for one in known], [(one.shape, one.requires_grad) for one in moving])
        if key != self._key:
            self._key, self._call = key, None
            return avatar.pose(face, progress)
        call = self._call
        if call is None:
            try:
                self._call = call = _captured(avatar, face, progress, moving)
            except RuntimeError as error:
                self._wanted = False
                tell(f"{VARIABLE}=1: PyTorch made no graph of the pose ({error}); training goes on without")
                return avatar.pose(face, progress)
        return Posed(_joined(call(*moving)), {})


class _Pose(nn.Module):
    """A pose as PyTorch's graphs take it: tensors in, tensors out."""

    def __init__(self, avatar: Avatar, face: FaceParams, progress: Progress):
        super().__init__()
        self.avatar, self.face, self.progress = avatar, face, progress

    def forward(self, *moving: Tensor) -> tuple[Tensor, ...]:
        face = replace(self.face, **dict(zip(_MOVING, moving, strict=True)))
        gaussians = self.avatar.pose(face, self.progress).gaussians
        found = [getattr(gaussians, name) for name in _TENSORS]
        assert found[-1] is None, "methods with a key have no covariances"
        return tuple(found[:-1])


def _captured(avatar: Avatar, face: FaceParams, progress: Progress, moving: list[Tensor]) -> Any:
    samples = tuple(one.detach().clone().requires_grad_(one.requires_grad) for one in moving)
    pose = _Pose(avatar, face.detach(), progress)
    return torch.cuda.make_graphed_callables(pose, samples, allow_unused_input=True)


def _joined(tensors: tuple[Tensor, ...]) -> Gaussians:
    return Gaussians(**dict(zip(_TENSORS, tensors, strict=False)))


def _place(tensor: Tensor | None) -> Hashable:
    return None if tensor is None else (tensor.data_ptr(), tuple(tensor.shape))


def is_on_gpu(face: FaceParams) -> bool:
    """Whether a face is where graphs are."""
    return face.expression.is_cuda
