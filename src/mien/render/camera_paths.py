"""Cameras around a head, and camera paths in files. `mien.runtime.camera_paths` has the angles of paths."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mien.camera import Camera
from mien.disk.files import read_json
from mien.disk.limits import camera_fault
from mien.disk.reading import parse_json, read_bytes
from mien.errors import UserError
from mien.rotation import invert_rigid, matrix_from_axis_angle, rigid_transform

FORMAT, VERSION = "mien.cameras", 1
_MAX_CAMERAS = 50_000
"""Most cameras of a file: half an hour at 30 frames a second."""
_MAX_FOREIGN_BYTES = 32 << 20
_DISTORTION = re.compile(
    r"dist(?!ance)|fisheye|radial|tangential|coef|^([kp][1-6]|s[1-4]|tau[xy12]|d|kc|xi|rd)$", re.IGNORECASE
)
"""Names under which programs write the distortion of a lens."""
_MODEL = re.compile(r"model|projection|type|lens", re.IGNORECASE)
_OTHER_MODELS = re.compile(
    r"fish|equidist|kannala|omni|^mei$|ucm|double.?sphere|^fov$|division|f.?theta|radial|scheimpflug|equirect|spherical",
    re.IGNORECASE,
)
"""Models of lenses that are neither an ideal lens nor OpenCV's usual model."""


def turned_camera(camera: Camera, center: Float[Tensor, " 3"], yaw: float, pitch: float) -> Camera:
    """`camera` moved around `center`: first up by `pitch`, then to the subject's left by `yaw`, both in radians."""
    sideways = invert_rigid(camera.viewmat)[:3, 0]
    raised = orbit(camera, center, -pitch, tuple(sideways.tolist())) if pitch else camera
    return orbit(raised, center, yaw) if yaw else raised


def read_cameras(path: Path) -> list[Camera]:
    """Read a camera path from json, with one camera per frame.

    {"format": "mien.cameras", "version": 1, "cameras": [{"K": 3x3, "viewmat": 4x4, "width": .., "height": ..}, ...]}
    Intrinsics are in pixels. World-to-camera matrices have OpenCV axes and metres (docs/conventions.md).
    """
    entries = read_camera_entries(path, "give one camera for every frame")
    for index, entry in enumerate(entries):
        names = names_of_distortion(entry)
        if names:
            raise UserError(
                f"{path}: camera {index}: has {names[0]}, but pictures are drawn as by an ideal lens; leave it out"
            )
    return [camera_of_entry(entry, f"{path}: camera {index}") for index, entry in enumerate(entries)]


def read_camera_entries(path: Path, remedy: str) -> list[Any]:
    """Read the entries of a json file of cameras, of which `camera_of_entry` makes cameras."""
    if not path.is_file():
        raise UserError(f"{path}: no such file; give a json file of cameras (docs/using.md)")
    try:
        content = read_json(path, FORMAT, VERSION)
    except UserError as error:
        # The user wrote this file, so there is no stage to run again.
        remedy = "write it as described in docs/using.md"
        told = str(error).split("; ")[0]
        if _is_nerfstudio(path):
            told = f"{path}: is nerfstudio's transforms.json, of another format"
            remedy = "write each frame's camera as described in docs/using.md (its matrices are camera-to-world)"
        raise UserError(f"{told}; {remedy}") from None
    names, listed = names_of_distortion(content), content.get("cameras")
    if names:
        raise UserError(f"{path}: has {names[0]} for all cameras together; write it into the entry of each camera")
    if not isinstance(listed, list) or not listed:
        raise UserError(f"{path}: has no list `cameras`; {remedy}")
    if len(listed) > _MAX_CAMERAS:
        raise UserError(f"{path}: has {len(listed):,} cameras, and at most {_MAX_CAMERAS:,} are read; split the file")
    return listed


def _is_nerfstudio(path: Path) -> bool:
    """Whether a json file lists frames with camera-to-world matrices, as nerfstudio and NeRF's datasets do."""
    try:
        content = parse_json(read_bytes(path, _MAX_FOREIGN_BYTES).decode("utf-8-sig"), any_size=True)
    except (OSError, ValueError):
        return False
    frames = content.get("frames") if isinstance(content, dict) else None
    return isinstance(frames, list) and any(isinstance(each, dict) and "transform_matrix" in each for each in frames)


def names_of_distortion(entry: Any) -> list[str]:
    """Return the names in a camera's entry under which the distortion of a lens is described, unless it has none."""
    if not isinstance(entry, dict):
        return []
    return [
        name
        for name, value in entry.items()
        if (_DISTORTION.search(re.sub(r"[^A-Za-z0-9]", "", name)) and not _is_nothing(value))
        or (_MODEL.search(name) and isinstance(value, str) and _OTHER_MODELS.search(value))
    ]


def _is_nothing(value: Any) -> bool:
    """Whether a value says that a lens does not distort: zeros, nothing, or the name of the usual model."""
    if isinstance(value, str):
        return not _OTHER_MODELS.search(value)
    if isinstance(value, (list, tuple)):
        return all(map(_is_nothing, value))
    return all(map(_is_nothing, value.values())) if isinstance(value, dict) else not value


def camera_of_entry(entry: Any, where: str) -> Camera:
    """Make a camera from its entry in a json file; `where` begins the messages."""
    missing = [name for name in ("K", "viewmat", "width", "height") if not isinstance(entry, dict) or name not in entry]
    if missing:
        raise UserError(f"{where}: has no {', '.join(missing)}; give K [3][3], viewmat [4][4], width and height")
    try:
        K, viewmat = torch.tensor(entry["K"], dtype=torch.float32), torch.tensor(entry["viewmat"], dtype=torch.float32)
        width, height = _whole(entry["width"]), _whole(entry["height"])
    except (KeyError, TypeError, ValueError, OverflowError, RuntimeError) as error:
        raise UserError(f"{where}: needs K [3][3], viewmat [4][4], width and height ({error!r})") from None
    fault = camera_fault(K.numpy(), viewmat.numpy(), width, height)
    if fault is not None:
        raise UserError(f"{where}: {fault}")
    return Camera(K, viewmat, width, height)


def _whole(size: Any) -> Any:
    """A whole number that another program wrote as a float, such as 512.0, as an int; other values as they are."""
    return int(size) if isinstance(size, float) and size.is_integer() else size


def orbit(camera: Camera, center: Float[Tensor, " 3"], angle: float, up: tuple[float, ...] = (0.0, 1.0, 0.0)) -> Camera:
    """`camera` moved around `center` by `angle` radians, counter-clockwise seen from above."""
    axis = torch.nn.functional.normalize(camera.viewmat.new_tensor(up), dim=0)
    turn = matrix_from_axis_angle(axis * angle)
    center = center.to(camera.viewmat)
    # p -> turn (p - centre) + centre moves the camera; the world moves the other way.
    carry = rigid_transform(turn, center - turn @ center)
    return replace(camera, viewmat=camera.viewmat @ invert_rigid(carry))
