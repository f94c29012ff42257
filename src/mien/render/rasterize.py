"""The function `rasterize` turns Gaussians and cameras into pictures. It chooses the back end and unrolls batches."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from mien.camera import Camera
from mien.gaussians import Gaussians, Rendering, sh_from_rgb
from mien.render.gsplat_backend import render_gsplat
from mien.render.native import View, render_native
from mien.render.reference import render_reference
from mien.render.validation import check_shapes
from mien.rotation import compose_rigid

Backend = Literal["auto", "native", "gsplat", "reference"]


def _render(
    backend: Backend, views: Sequence[View], backgrounds: Sequence[Tensor], offsets: Sequence[Tensor]
) -> list[Rendering]:
    """Render views of unbatched Gaussians, given in the camera's world, with offsets of their 2D centres."""
    backend = choose_backend(views[0][0].means) if backend == "auto" else backend
    if backend == "native":
        return render_native(views, backgrounds, offsets)
    render_view = {"gsplat": render_gsplat, "reference": render_reference}[backend]
    return [render_view(*view, *more) for view, *more in zip(views, backgrounds, offsets, strict=True)]


def rasterize(
    gaussians: Gaussians,
    camera: Camera | Sequence[Camera],
    background: Float[Tensor, " 3"] | None = None,
    backend: Backend = "auto",
    depth: bool = False,
) -> Rendering:
    """Render `gaussians` seen by `camera` over `background` (RGB; black by default).

    A sequence of cameras, batched Gaussians, or both with equal lengths give a batch. Inputs without a batch axis are
    shared. All cameras of a batch have one size. `T_world_local` of the Gaussians moves the camera, not the Gaussians,
    so spherical harmonics are evaluated in the local frame. The constants are those of docs/conventions.md.

    The picture is differentiable in the Gaussians (with `T_world_local`), the background and `camera.viewmat`. The
    rendering's `means2d_offset` is a leaf, and its `.grad` is the gradient with respect to the projected centres, in
    pixels. With `depth` the rendering also has a depth picture, which takes a second pass.

    `auto` is `native` for float32 on a CPU, `gsplat` on a GPU, and otherwise (float64) the slow `reference`.

    Raises:
        ValueError: An input holds NaN or infinity (the message names it; a GPU is not asked while gradients are
            recorded), shapes or lengths do not fit, or a dtype or device is wrong.
    """
    if background is None:
        background = gaussians.means.new_zeros(3)
    check_shapes(gaussians, background)
    batch = _views(gaussians, camera)
    shape = (len(gaussians), 2) if batch is None else (len(batch), len(gaussians), 2)
    offset = _offset(shape, gaussians.means)
    if batch is None:
        assert isinstance(camera, Camera)
        view = _in_local_frame(gaussians, camera)
        picture = _render(backend, [view], [background], [offset])[0]
        return replace(picture, depth=_depths([view], [picture], backend)[0]) if depth else picture
    views = [_in_local_frame(*view) for view in batch]
    pictures = _render(backend, views, [background] * len(views), offset.unbind())
    return Rendering(
        torch.stack([picture.image for picture in pictures]),
        torch.stack([picture.alpha for picture in pictures]),
        torch.stack([picture.radii for picture in pictures]),
        offset,
        torch.stack(_depths(views, pictures, backend)) if depth else None,
    )


def rasterize_each(views: Sequence[View], backgrounds: Sequence[Float[Tensor, " 3"]]) -> list[Rendering]:
    """Render views of unbatched Gaussians, each over its own background, as `rasterize` does. Sizes may differ.

    As the native back end draws each of several views with one thread, there should be at least as many views as
    threads.

    Raises:
        ValueError: as `rasterize`.
    """
    for (gaussians, _), background in zip(views, backgrounds, strict=True):
        check_shapes(gaussians, background)
    like = views[0][0].means
    # One leaf for each view, so that each has its own gradient.
    offsets = [_offset((len(gaussians), 2), like) for gaussians, _ in views]
    return _render("auto", [_in_local_frame(*view) for view in views], backgrounds, offsets)


def _offset(shape: tuple[int, ...], like: Tensor) -> Tensor:
    # An expanded zero needs no cleared memory, and its gradient is still a full tensor.
    return _zero(like.dtype, like.device).expand(shape).requires_grad_(torch.is_grad_enabled())


@cache
def _zero(dtype: torch.dtype, device: torch.device) -> Float[Tensor, ""]:
    return torch.zeros((), dtype=dtype, device=device)


def _depths(views: Sequence[View], pictures: Sequence[Rendering], backend: Backend) -> list[Tensor]:
    """The expected depth of each view: depths blended like colours, divided by the sum of their weights."""
    colored = []
    for gaussians, camera in views:
        depths = gaussians.means @ camera.viewmat[2, :3] + camera.viewmat[2, 3]
        colored.append((replace(gaussians, sh=sh_from_rgb(depths[:, None, None].expand(-1, 1, 3))), camera))
    black, offsets = views[0][0].means.new_zeros(3), [torch.zeros_like(picture.means2d_offset) for picture in pictures]
    blended = [picture.image[..., 0] for picture in _render(backend, colored, [black] * len(views), offsets)]
    return [
        torch.where(picture.alpha > 0, sums / picture.alpha.clamp_min(1e-6), 0)
        for sums, picture in zip(blended, pictures, strict=True)
    ]


def choose_backend(like: Tensor) -> Literal["native", "gsplat", "reference"]:
    """The back end for tensors with the dtype and device of `like`."""
    if like.is_cuda:
        return "gsplat"
    return "native" if like.dtype == torch.float32 else "reference"


def _views(gaussians: Gaussians, camera: Camera | Sequence[Camera]) -> list[tuple[Gaussians, Camera]] | None:
    """The Gaussians and camera of each picture of a batch; None if there is no batch."""
    count = _timesteps(gaussians)
    if isinstance(camera, Camera):
        if count is None:
            return None
        cameras = [camera] * count
    else:
        cameras = list(camera)
    if not cameras:
        raise ValueError("rasterize: the sequence of cameras is empty")
    if count is not None and count != len(cameras):
        raise ValueError(f"rasterize: {count} timesteps of Gaussians but {len(cameras)} cameras")
    sizes = {(one.width, one.height) for one in cameras}
    if len(sizes) > 1:
        raise ValueError(f"rasterize: the cameras of a batch must have one size, got {sorted(sizes)}")
    return [(gaussians.timestep(index), one) for index, one in enumerate(cameras)]


def _timesteps(gaussians: Gaussians) -> int | None:
    """The length of the batch axis; None if there is none."""
    pose = gaussians.T_world_local
    entries = [(gaussians.means, 2), (gaussians.quats, 2), (gaussians.scales, 2), (gaussians.opacities, 1)]
    entries += [(gaussians.sh, 3)] + ([] if pose is None else [(pose, 2)])
    lengths = {tensor.shape[0] for tensor, unbatched in entries if tensor.ndim > unbatched}
    if len(lengths) > 1:
        raise ValueError(f"rasterize: the Gaussians' tensors have different numbers of timesteps, {sorted(lengths)}")
    return lengths.pop() if lengths else None


def _in_local_frame(gaussians: Gaussians, camera: Camera) -> tuple[Gaussians, Camera]:
    """The same view with the Gaussians' local frame as the world."""
    pose = gaussians.T_world_local
    camera = camera.to(gaussians.means)
    if pose is None:
        return gaussians, camera
    return replace(gaussians, T_world_local=None), replace(camera, viewmat=compose_rigid(camera.viewmat, pose))


def close_holes(image: Float[Tensor, "h w c"], reach: int) -> Float[Tensor, "h w c"]:
    """The picture after erosion and dilation, each channel alone.

    Erosion gives each pixel the darkest value around it, dilation the brightest. Bright specks that are at most twice
    `reach` wide go, such as a white background that shows through holes; the rest keeps its size. Transparent pictures
    have no background that could show through. PointAvatar closes holes between its points so.
    """
    if reach == 0:
        return image
    planes, side = image.movedim(-1, 0)[None], 2 * reach + 1
    eroded = -torch.nn.functional.max_pool2d(-planes, side, stride=1, padding=reach)
    dilated = torch.nn.functional.max_pool2d(eroded, side, stride=1, padding=reach)
    return dilated[0].movedim(0, -1).contiguous()
