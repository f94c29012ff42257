"""An avatar with fewer Gaussians, for smaller files: those that add least to its pictures go first.

Training leaves Gaussians under others, where hardly any picture shows them. On footage, a fifth of them can go at 58 dB
against the picture with all of them.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from mien import _native
from mien.errors import UserError
from mien.formats.shared.packed import Motion, pack, with_rows
from mien.runtime.avatar import Avatar
from mien.runtime.baked import Camera, PortableAvatar
from mien.runtime.named import GAZE_NAMES, is_gaze, presets_for
from mien.runtime.posing import SH_C0, Gaussians
from mien.runtime.rotation import axis_angle_from_matrix, compose_rigid, matrix_from_axis_angle

_SIDE = 256
"""Sides of the pictures that contributions are summed over, in pixels."""
_YAWS = np.radians([-80.0, -40.0, 0.0, 40.0, 80.0])
"""Turns of the head for the face at rest and for preset faces."""
_STEPS = 64
"""Numbers of Gaussians that are tried: multiples of all of them, divided by this."""


def fitted(
    path: Path, avatar: PortableAvatar, motion: Motion | None, largest: int, size: Callable[[bytes], int]
) -> PortableAvatar:
    """The avatar with as many Gaussians as a file of `largest` bytes can hold, which has `size(packed)` bytes."""

    def bytes_of(some: PortableAvatar) -> int:
        return size(pack(some, motion))

    if bytes_of(avatar) <= largest:
        return avatar
    order = np.argsort(-contributions(avatar), kind="stable")

    def with_share(steps: int) -> PortableAvatar:
        rows = np.sort(order[: max(1, len(order) * steps // _STEPS)])
        return replace(avatar, baked=with_rows(avatar.baked, rows))

    least = bytes_of(with_share(1))
    if least > largest:
        raise UserError(
            f"{path}: would have {least / 1e6:.2f} MB with the fewest Gaussians, and --largest asks for "
            f"{largest / 1e6:g} MB at most; give more, or leave out what else is in it, such as a motion or a webcam"
        )
    fits, fails = 1, _STEPS
    while fails - fits > 1:
        middle = (fits + fails) // 2
        fits, fails = (middle, fails) if bytes_of(with_share(middle)) <= largest else (fits, middle)
    return with_share(fits)


def contributions(avatar: PortableAvatar) -> Float32[np.ndarray, " n"]:
    """The most that each Gaussian adds to one of many pictures: the sum of its weights in the blending, in pixels.

    The weight of a Gaussian in a pixel is its alpha times the transmittance in front of it (3D Gaussian Splatting,
    equation 3), which is the derivative of the picture by the Gaussian's colour. The pictures are of 256x256 pixels.
    They show the face at rest and all preset faces from five sides, and each expression and gaze alone from the front.
    """
    drawn, camera = Avatar(avatar), avatar.camera.square(_SIDE)
    turned = [_turned(avatar.neutral.head_rotation, yaw) for yaw in _YAWS]
    names = avatar.expression_names, avatar.joint_names
    faces = [{}, *({name: 1.0} for name in presets_for(*names))]
    poses = [drawn.pose(face, head_rotation=rotation) for face in faces for rotation in turned]
    poses += [
        drawn.pose({name: float(high)})
        for name, high in zip(avatar.expression_names, avatar.expression_bounds[:, 1], strict=True)
    ]
    poses += [drawn.pose({name: 1.0}) for name in GAZE_NAMES if is_gaze(name, avatar.joint_names)]
    return np.max([_weights(gaussians, camera) for gaussians in poses], axis=0)


def _turned(head_rotation: Float32[np.ndarray, " 3"], yaw: float) -> Float32[np.ndarray, " 3"]:
    """The rotation of a head that turns about its own +y first, by `yaw` radians."""
    about_y = matrix_from_axis_angle(np.array([0, yaw, 0], np.float32))
    return axis_angle_from_matrix(matrix_from_axis_angle(head_rotation) @ about_y).astype(np.float32)


def _weights(gaussians: Gaussians, camera: Camera) -> Float32[np.ndarray, " n"]:
    """The sum of each Gaussian's weights in one picture."""
    count, size = len(gaussians), (camera.height, camera.width)
    means, quats, scales, opacities = (
        np.ascontiguousarray(array, np.float32)
        for array in (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities)
    )
    grey = np.zeros((count, 1, 3), np.float32)
    pose = gaussians.T_world_local
    viewmat = camera.viewmat if pose is None else compose_rigid(camera.viewmat, pose)
    view = np.ascontiguousarray(viewmat, np.float32), np.ascontiguousarray(camera.K, np.float32)
    image, alpha = np.empty((*size, 3), np.float32), np.empty(size, np.float32)
    arrays = _native.GaussianArrays(means, quats, scales, opacities, grey)
    task = _native.RasterizeView(arrays, np.zeros(3, np.float32), *view, image, alpha, np.empty(count, np.int32))
    (frame,) = _native.rasterize_views([task], differentiable=True)
    if frame is None:
        raise ValueError("contributions: the Gaussians or the camera hold NaN or infinity")
    by_image = np.zeros_like(image)
    by_image[..., 0] = 1
    found = [np.empty_like(array) for array in (means, quats, scales, opacities, grey)]
    of_view = np.empty((count, 2), np.float32), np.empty((4, 4), np.float32), np.empty((3, 3), np.float32)
    gradients = _native.RasterizeGradients(
        frame, arrays, image, alpha, by_image, None, _native.GaussianArrays(*found), *of_view
    )
    _native.rasterize_views_backward([gradients])
    return found[-1][:, 0, 0] / np.float32(SH_C0)
