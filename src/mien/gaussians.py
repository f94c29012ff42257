"""Activated 3D Gaussians and pictures of them: the value objects that renderers take and return."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

__all__ = ["Gaussians", "Rendering", "sh_from_rgb", "stack_timesteps", "world_means"]


@dataclass(frozen=True, eq=False)
class Gaussians:
    """n activated Gaussians. A tensor that differs between timesteps has a leading batch axis; others are shared."""

    means: Float[Tensor, "... n 3"]
    """Centres in the local frame, in metres."""
    quats: Float[Tensor, "... n 4"]
    """Rotations as wxyz quaternions. Renderers normalise them."""
    scales: Float[Tensor, "... n 3"]
    """Standard deviations along the rotated axes, in metres, positive."""
    opacities: Float[Tensor, "... n"]
    """Opacities, 0 to 1."""
    sh: Float[Tensor, "... n k 3"]
    """Real spherical-harmonics coefficients of the colour (k = 1, 4, 9 or 16) in the local frame."""
    T_world_local: Float[Tensor, "... 4 4"] | None = None
    """Rigid pose of the local frame; None means identity. Renderers move the camera by it, not the Gaussians."""
    covariances: Float[Tensor, "... n 6"] | None = None
    """The shapes that `quats` and `scales` describe, as xx, xy, xz, yy, yz and zz in square metres. Kernels of a GPU
    pose these, and the renderer there takes them. If they are given, gradients of shapes go through them alone."""

    def __len__(self) -> int:
        """The number of Gaussians, n."""
        return self.means.shape[-2]

    @property
    def batched(self) -> bool:
        """Whether there is a leading axis of timesteps."""
        return any(t is not None and t.ndim > ndim for t, ndim in self._tensors_with_ndim())

    def timestep(self, index: int) -> "Gaussians":
        """One entry of the batch axis; tensors without that axis are shared. Unbatched Gaussians return themselves."""
        if not self.batched:
            return self
        names = ("means", "quats", "scales", "opacities", "sh", "T_world_local", "covariances")
        picked = {
            name: _entry(tensor, index) if tensor.ndim > ndim else tensor
            for name, (tensor, ndim) in zip(names, self._tensors_with_ndim(), strict=True)
            if tensor is not None
        }
        return Gaussians(**picked)

    def timesteps(self) -> list["Gaussians"]:
        """All entries of the batch axis. Unbatched Gaussians are one entry.

        The backward pass of all entries together is as fast as that of one: it fills each gradient once.
        """
        known = self._tensors_with_ndim()
        lengths = {len(tensor) for tensor, ndim in known if tensor is not None and tensor.ndim > ndim}
        if not lengths:
            return [self]
        (count,) = lengths
        columns = [
            [tensor] * count if tensor is None or tensor.ndim == ndim else tensor.unbind() for tensor, ndim in known
        ]
        return [Gaussians(*entry) for entry in zip(*columns, strict=True)]

    def select(self, mask: Tensor) -> "Gaussians":
        """The Gaussians that a bool mask [n] selects, or those at the given indices."""
        return replace(
            self,
            means=self.means[..., mask, :],
            quats=self.quats[..., mask, :],
            scales=self.scales[..., mask, :],
            opacities=self.opacities[..., mask],
            sh=self.sh[..., mask, :, :],
            covariances=None if self.covariances is None else self.covariances[..., mask, :],
        )

    def to(self, like: Tensor) -> "Gaussians":
        """These Gaussians with the dtype and device of `like`."""
        return Gaussians(*(None if one is None else one.to(like) for one, _ in self._tensors_with_ndim()))  # pyright: ignore

    def detach(self) -> "Gaussians":
        """The same values, cut from the autograd graph."""
        return Gaussians(*(None if one is None else one.detach() for one, _ in self._tensors_with_ndim()))  # pyright: ignore

    def _tensors_with_ndim(self) -> list[tuple[Tensor | None, int]]:
        """Each tensor, with its number of axes when unbatched, in the order of the fields."""
        entries = [(self.means, 2), (self.quats, 2), (self.scales, 2), (self.opacities, 1), (self.sh, 3)]
        return [*entries, (self.T_world_local, 2), (self.covariances, 2)]


@dataclass(frozen=True, eq=False)
class Rendering:
    """One picture, or a batch of them with a leading axis."""

    image: Float[Tensor, "*b h w 3"]
    """RGB over the background, not clamped from above."""
    alpha: Float[Tensor, "*b h w"]
    """Opacity of all Gaussians together, 0..1."""
    radii: Int[Tensor, "*b n"]
    """Extent on screen in pixels (3 sigma of the 2D Gaussian's longer axis, rounded up); 0 where not drawn."""
    means2d_offset: Float[Tensor, "*b n 2"]
    """Zeros added to the projected centres. After `backward()` its `.grad` is the gradient of the loss with respect to
    the centres in pixels, which density control reads."""
    depth: Float[Tensor, "*b h w"] | None = None
    """Expected depth along the camera's z axis in metres, 0 in empty pixels; None unless requested. Differentiable."""


def stack_timesteps(timesteps: Sequence[Gaussians]) -> Gaussians:
    """One batch of several timesteps, each with a batch axis of one or with none. Every tensor gets a batch axis."""
    names = ("means", "quats", "scales", "opacities", "sh")
    single = [gaussians.timestep(0) for gaussians in timesteps]
    poses = [gaussians.T_world_local for gaussians in single if gaussians.T_world_local is not None]
    shapes = [gaussians.covariances for gaussians in single if gaussians.covariances is not None]
    stacked = (torch.stack([getattr(gaussians, name) for gaussians in single]) for name in names)
    return Gaussians(*stacked, *(torch.stack(own) if own else None for own in (poses, shapes)))


def _entry(tensor: Tensor, index: int) -> Tensor:
    # A single entry is taken as a view: the backward pass of an index writes into zeros of the whole batch's size.
    return tensor.squeeze(0) if len(tensor) == 1 and index in (0, -1) else tensor[index]


def world_means(gaussians: Gaussians) -> Float[Tensor, "... n 3"]:
    """Centres in world space, in metres."""
    if gaussians.T_world_local is None:
        return gaussians.means
    rotation = gaussians.T_world_local[..., :3, :3]
    return gaussians.means @ rotation.transpose(-1, -2) + gaussians.T_world_local[..., None, :3, 3]


SH_C0 = 0.28209479177387814
"""The constant spherical harmonic, 1 / (2 sqrt(pi)): colour = 0.5 + SH_C0 * coefficient."""


def sh_from_rgb(rgb: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
    """Constant SH coefficients for the colour `rgb` (0..1)."""
    return (rgb - 0.5) / SH_C0
