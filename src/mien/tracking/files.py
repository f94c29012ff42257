"""A tracking on disk: tracking.json with its description and tracking.safetensors with its numbers."""

from pathlib import Path

import torch
from torch import Tensor

from mien.camera import Camera
from mien.capture.capture import Capture
from mien.disk.files import file_digest, read_json, read_tensors, write_json, write_tensors
from mien.disk.limits import MAX_NUMBER, camera_fault
from mien.disk.locks import read_beside_writers
from mien.disk.reading import check_tree, expect_whole, is_one_line
from mien.errors import UserError
from mien.face.params import FaceParams
from mien.tracking.tracking import PARTS, Appearance, Tracking

_FORMAT, _VERSION = "mien.tracking", 1
_JSON, _TENSORS = "tracking.json", "tracking.safetensors"
_STAGE = "`mien track`"
_REMEDY = "delete the folder and run `mien track` again"
_FACE = ("identity", "expression", "joints", "head_rotation", "head_translation", "vertex_offsets")
_APPEARANCE = ("texture", "trust", "light")
_OPTIONAL = ("vertex_offsets", "pixel_residuals", "covered", *_APPEARANCE)
_FLAGS = ("valid", "covered")
_AXES = {
    "identity": "i", "expression": "te", "joints": "tj3", "head_rotation": "t3", "head_translation": "t3",
    "vertex_offsets": "v3", "valid": "t", "neck_lines": "tc3", "residuals": "tc", "camera_K": "c33",
    "camera_viewmats": "c44", "pixel_residuals": "tc", "texture": "yx3", "trust": "yx", "light": "93",
    "covered": "tcp",
}  # fmt: skip
"""Axes of each tensor. Axes of the same letter have the same size."""


def write_tracking(path: Path, tracking: Tracking) -> None:
    """Write a tracking into the folder `path`. The json is written last and holds the hash of the numbers."""
    check_tree(path)
    appearance, known = tracking.appearance, tracking.residuals[tracking.residuals.isfinite()].double()
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
    if appearance is not None:
        tensors |= {name: getattr(appearance, name) for name in _APPEARANCE}
    write_tensors(path / _TENSORS, tensors)
    content = {
        "face_model": tracking.face_model,
        "face_model_hash": tracking.face_model_hash,
        "timesteps": len(tracking.face),
        "valid_timesteps": int(tracking.valid.sum()),
        "cameras": [{"width": camera.width, "height": camera.height} for camera in tracking.cameras],
        "residual": {
            "median_px": float(known.median()) if len(known) else None,
            "p95_px": float(known.quantile(0.95)) if len(known) else None,
        },
        "looks": appearance and {"sigma": appearance.sigma, "light_extent": appearance.light_extent},
        "settings": tracking.settings,
        "tensors_sha256": file_digest(path / _TENSORS),
    }
    write_json(path / _JSON, _FORMAT, _VERSION, content)


def read_tracking(path: Path) -> Tracking:
    """Read a tracking that `write_tracking` wrote."""
    return read_beside_writers(lambda: _read_tracking(path), [path], [path.parent])


def _read_tracking(path: Path) -> Tracking:
    check_tree(path)
    content = read_json(path / _JSON, _FORMAT, _VERSION, _STAGE)
    tensors = read_tensors(path / _TENSORS, _STAGE)
    if file_digest(path / _TENSORS) != content.get("tensors_sha256"):
        raise UserError(f"{path / _TENSORS}: does not match {_JSON}; {_REMEDY}")
    fault = _fault_of(tensors)
    if fault:
        raise UserError(f"{path / _TENSORS}: {fault}; {_REMEDY}")
    with expect_whole(path / _JSON, _REMEDY):
        cameras, appearance = [], None
        for entry, K, viewmat in zip(content["cameras"], tensors["camera_K"], tensors["camera_viewmats"], strict=True):
            fault = camera_fault(K.numpy(), viewmat.numpy(), entry["width"], entry["height"])
            if fault is not None:
                raise ValueError(f"a camera is not valid: {fault}")
            cameras.append(Camera(K, viewmat, entry["width"], entry["height"]))
        if content.get("looks") is not None:
            sigma, extent = (float(content["looks"][name]) for name in ("sigma", "light_extent"))
            if not (0 <= sigma <= MAX_NUMBER and 0 <= extent <= MAX_NUMBER):
                raise ValueError(f"sigma {sigma:g} and light_extent {extent:g} are out of range")
            named = {name: tensors[name] for name in _APPEARANCE}
            appearance = Appearance(**named, sigma=sigma, light_extent=extent)
        together = content["settings"].get("tracked_together", [])  # read before a capture is tracked again
        names = [content["face_model"], content["face_model_hash"], *together]
        if not isinstance(together, list) or not all(isinstance(name, str) and is_one_line(name) for name in names):
            raise ValueError(f"{names!r:.40} are not names")
        return Tracking(
            face_model=content["face_model"],
            face_model_hash=content["face_model_hash"],
            face=FaceParams(**{name: tensors[name] for name in _FACE if name in tensors}),
            valid=tensors["valid"].bool(),
            cameras=tuple(cameras),
            neck_lines=tensors["neck_lines"],
            residuals=tensors["residuals"],
            pixel_residuals=tensors.get("pixel_residuals"),
            appearance=appearance,
            covered=tensors["covered"].bool() if "covered" in tensors else None,
            settings=dict(content["settings"]),
        )


def check_tracking_of(capture: Capture, tracking: Tracking, where: Path) -> None:
    """Check that a tracking has the timesteps, cameras and picture sizes of a capture."""
    sizes = {(camera.width, camera.height) for camera in tracking.cameras}
    found = (len(tracking.face), len(tracking.cameras), sizes)
    if found != (capture.timesteps, len(capture.camera_ids), {(capture.width, capture.height)}):
        raise UserError(f"{where}: belongs to other pictures than the capture beside it; {_REMEDY}")


def _fault_of(tensors: dict[str, Tensor]) -> str:
    """What is wrong with the tensors: missing, of other sizes or types, or not finite; empty if nothing is."""
    sizes: dict[str, int] = {"3": 3, "4": 4, "9": 9, "p": len(PARTS)}
    for name, axes in _AXES.items():
        if name not in tensors:
            if name in _OPTIONAL:
                continue
            return f"lacks {name!r}"
        tensor, shape = tensors[name], list(tensors[name].shape)
        if len(axes) != len(shape) or [sizes.setdefault(*pair) for pair in zip(axes, shape, strict=True)] != shape:
            return f"{name!r} has the shape {shape}"
        if tensor.dtype != (torch.uint8 if name in _FLAGS else torch.float32):
            return f"{name!r} has the type {tensor.dtype}"
        absent = torch.zeros_like(tensor, dtype=torch.bool)
        if name == "pixel_residuals":
            absent = tensor.isnan()
        if name == "residuals":  # a camera that found no face, but not the only one
            absent = tensor.isnan() & ((tensors["valid"][:, None] == 0) | tensor.isfinite().any(1, keepdim=True))
        if not (absent | (tensor.abs() <= MAX_NUMBER)).all():
            return f"{name!r} holds numbers that are not finite, or beyond {MAX_NUMBER:g}"
    return ""
