"""A tracking on disk: tracking.json with its description and tracking.safetensors with its numbers."""

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mien.camera import Camera
from mien.capture.capture import Capture
from mien.disk.files import expect_whole, file_digest, read_json, read_tensors, write_json, write_tensors
from mien.disk.inside import check_tree, is_one_line
from mien.disk.limits import MAX_NUMBER, camera_fault
from mien.disk.locks import read_beside_writers
from mien.errors import UserError
from mien.face.params import FaceParams
from mien.tracking.tracking import PARTS, Appearance, Tracking

_FORMAT, _VERSION = "mien.tracking", 1
_JSON, _TENSORS = "tracking.json", "tracking.safetensors"
_FACE = ("identity", "expression", "joints", "head_rotation", "head_translation", "vertex_offsets")
_APPEARANCE = ("texture", "trust", "light")
_OPTIONAL = ("vertex_offsets", "pixel_residuals", "covered", *_APPEARANCE)
_AXES = {
    "identity": "i", "expression": "te", "joints": "tj3", "head_rotation": "t3", "head_translation": "t3",
    "vertex_offsets": "v3", "valid": "t", "neck_lines": "tc3", "residuals": "tc", "camera_K": "c33",
    "camera_viewmats": "c44", "pixel_residuals": "tc", "texture": "yx3", "trust": "yx", "light": "93",
    "covered": "tcp",
}  # fmt: skip
_STAGE = "`mien track`"
_REMEDY = "delete the folder and run `mien track` again"


def write_tracking(path: Path, tracking: Tracking) -> None:
    """Write a tracking into the folder `path`. The json is written last and holds the hash of the numbers."""
    check_tree(path)
    tensors = {
        **tracking.face.tensors(),
        "valid": tracking.valid.to(torch.uint8),
        "neck_lines": tracking.neck_lines,
        "residuals": tracking.residuals,
        "camera_K": torch.stack([camera.K for camera in tracking.cameras]),
        "camera_viewmats": torch.stack([camera.viewmat for camera in tracking.cameras]),
    }
    if tracking.pixel_residuals is not None:
        tensors["pixel_residuals"] = tracking.pixel_residuals
    if tracking.covered is not None:
        tensors["covered"] = tracking.covered.to(torch.uint8)
    if tracking.appearance is not None:
        tensors |= {name: getattr(tracking.appearance, name) for name in _APPEARANCE}
    write_tensors(path / _TENSORS, tensors)
    content = {
        "face_model": tracking.face_model,
        "face_model_hash": tracking.face_model_hash,
        "timesteps": len(tracking.face),
        "valid_timesteps": int(tracking.valid.sum()),
        "cameras": [{"width": camera.width, "height": camera.height} for camera in tracking.cameras],
        "residual": _residual_summary(tracking.residuals),
        "looks": None if tracking.appearance is None else _numbers_of(tracking.appearance),
        "settings": tracking.settings,
        "tensors_sha256": file_digest(path / _TENSORS),
    }
    write_json(path / _JSON, _FORMAT, _VERSION, content)


def read_tracking(path: Path) -> Tracking:
    """Read a tracking that `write_tracking` wrote.

    Raises:
        UserError: A file is missing, damaged, of another version, being written, or a link, or it holds numbers that
            are not finite or exceed `mien.disk.limits`.
    """
    return read_beside_writers(lambda: _read_tracking(path), [path], [path.parent])


def _read_tracking(path: Path) -> Tracking:
    check_tree(path)
    content = read_json(path / _JSON, _FORMAT, _VERSION, _STAGE)
    tensors = read_tensors(path / _TENSORS, _STAGE)
    if file_digest(path / _TENSORS) != content.get("tensors_sha256"):
        raise UserError(f"{path / _TENSORS}: does not match {_JSON}; {_REMEDY}")
    _check_shapes(path, tensors)
    with expect_whole(path / _JSON, _REMEDY):
        return Tracking(
            face_model=_text(content["face_model"]),
            face_model_hash=_text(content["face_model_hash"]),
            face=FaceParams(**{name: tensors[name] for name in _FACE if name in tensors}),
            valid=tensors["valid"].bool(),
            cameras=_cameras(content["cameras"], tensors["camera_K"], tensors["camera_viewmats"]),
            neck_lines=tensors["neck_lines"],
            residuals=tensors["residuals"],
            pixel_residuals=tensors.get("pixel_residuals"),
            appearance=_read_appearance(content.get("looks"), tensors),
            covered=tensors["covered"].bool() if "covered" in tensors else None,
            settings=_read_settings(content["settings"]),
        )


def check_tracking_of(capture: Capture, tracking: Tracking, where: Path) -> None:
    """Check that a tracking has the timesteps, cameras and picture sizes of a capture."""
    sizes = {(camera.width, camera.height) for camera in tracking.cameras}
    found = (len(tracking.face), len(tracking.cameras), sizes)
    if found != (capture.timesteps, len(capture.camera_ids), {(capture.width, capture.height)}):
        raise UserError(f"{where}: belongs to other pictures than the capture beside it; {_REMEDY}")


def _cameras(entries: Any, Ks: Tensor, viewmats: Tensor) -> tuple[Camera, ...]:
    cameras = []
    for entry, K, viewmat in zip(entries, Ks, viewmats, strict=True):
        fault = camera_fault(K.numpy(), viewmat.numpy(), entry["width"], entry["height"])
        if fault is not None:
            raise ValueError(f"a camera is not valid: {fault}")
        cameras.append(Camera(K, viewmat, entry["width"], entry["height"]))
    return tuple(cameras)


def _text(value: object) -> str:
    if not (isinstance(value, str) and is_one_line(value)):
        raise ValueError(f"{value!r:.40} is not a name")
    return value


def _read_settings(settings: Any) -> dict[str, Any]:
    """The settings unchanged. Only `tracked_together` is checked: it is read before a capture is tracked again."""
    together = settings.get("tracked_together", [])
    if not (isinstance(together, list) and all(isinstance(name, str) for name in together)):
        raise ValueError("tracked_together is not a list of names")
    return dict(settings)


def _check_shapes(path: Path, tensors: dict[str, Tensor]) -> None:
    """Check that no tensor is missing, that axes of the same name agree, and that all numbers are finite."""
    sizes: dict[str, int] = {"3": 3, "4": 4, "9": 9, "p": len(PARTS)}
    for name, axes in _AXES.items():
        if name not in tensors:
            if name in _OPTIONAL:
                continue
            raise UserError(f"{path / _TENSORS}: lacks {name!r}; {_REMEDY}")
        shape = tuple(tensors[name].shape)
        agrees = len(shape) == len(axes) and all(
            sizes.setdefault(axis, size) == size for axis, size in zip(axes, shape, strict=True)
        )
        if not agrees:
            raise UserError(f"{path / _TENSORS}: {name!r} has the shape {list(shape)}; {_REMEDY}")
        floats = name not in ("valid", "covered")
        if tensors[name].dtype != (torch.float32 if floats else torch.uint8):
            raise UserError(f"{path / _TENSORS}: {name!r} has the type {tensors[name].dtype}; {_REMEDY}")
        if floats and (tensors[name].abs() > MAX_NUMBER).any():
            raise UserError(f"{path / _TENSORS}: {name!r} holds numbers beyond {MAX_NUMBER:g}; {_REMEDY}")
        finite = tensors[name].isfinite()
        if name == "pixel_residuals":
            finite |= tensors[name].isnan()
        if name == "residuals":
            finite |= tensors[name].isnan() & ((tensors["valid"][:, None] == 0) | finite.any(1, keepdim=True))
        if not finite.all():
            raise UserError(f"{path / _TENSORS}: {name!r} holds numbers that are not finite; {_REMEDY}")


def _numbers_of(appearance: Appearance) -> dict[str, float]:
    return {"sigma": appearance.sigma, "light_extent": appearance.light_extent}


def _read_appearance(numbers: dict[str, float] | None, tensors: dict[str, Tensor]) -> Appearance | None:
    if numbers is None:
        return None
    sigma, light_extent = float(numbers["sigma"]), float(numbers["light_extent"])
    if not (0 <= sigma <= MAX_NUMBER and 0 <= light_extent <= MAX_NUMBER):
        raise ValueError(f"sigma {sigma:g} and light_extent {light_extent:g} are out of range")
    return Appearance(tensors["texture"], tensors["trust"], tensors["light"], sigma, light_extent)


def _residual_summary(residuals: Tensor) -> dict[str, float | None]:
    known = residuals[residuals.isfinite()].double()
    if len(known) == 0:
        return {"median_px": None, "p95_px": None}
    return {"median_px": float(known.median()), "p95_px": float(known.quantile(0.95))}
