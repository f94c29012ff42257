"""Write and read captures on disk: `capture.json`, `landmarks.safetensors`, `frames/`, `mattes/` and a `cache/`."""

import hashlib
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float

from mien.camera import Camera
from mien.capture.cache import map_frames, stamp_cache
from mien.capture.capture import Capture
from mien.capture.frame_files import CACHE, FRAMES, MATTES, REMEDY, STAGE, FrameLayout, FrameWriter
from mien.capture.person.faces import LANDMARKS
from mien.capture.quality import FrameQuality
from mien.disk.files import cannot_write, expect_whole, read_arrays, read_json, replace_folder, write_arrays, write_json
from mien.disk.inside import check_tree, is_one_line, is_plain_name, remove_tree
from mien.disk.limits import MAX_NUMBER, camera_fault, checked_side
from mien.disk.locks import read_beside_writers
from mien.errors import UserError
from mien.machine.progress import progress_bar

FORMAT, VERSION = "mien.capture", 1
JSON_NAME, ARRAYS_NAME, REPORT_NAME = "capture.json", "landmarks.safetensors", "report.json"
_OWN_NAMES = frozenset({JSON_NAME, ARRAYS_NAME, REPORT_NAME, FRAMES, MATTES, CACHE})
_ARRAYS = {
    "timestamps": ("t", np.float64),
    "landmarks": ("tcl2", np.float32),
    "valid": ("tc", np.bool_),
    "principal_point": ("c2", np.float64),
    "frame_digests": ("tc", np.uint64),
    "matte_digests": ("tc", np.uint64),
}
"""Axes and type of every array in the safetensors file."""
_CALIBRATION_ARRAYS = {"K": ("c33", np.float64), "viewmat": ("c44", np.float64)}
"""Additional arrays if the cameras are calibrated."""
_QUALITY_ARRAYS = {"sharpness": ("tc", np.float32), "brightness": ("tc", np.float32), "clipped": ("tc", np.float32)}
"""Additional arrays if the faces were measured."""
_MIN_FPS, _MAX_FPS = 1e-3, 1e5
"""Range of frame rates, in frames per second."""
_MAX_SECONDS = 1e7
"""Longest time from the first frame to the last, in seconds."""
_OPTIONAL_ARRAYS = (_CALIBRATION_ARRAYS, _QUALITY_ARRAYS)


@dataclass(frozen=True, eq=False)
class CaptureData:
    """A capture without its pictures. Its fields are those of `Capture` with the same names."""

    name: str
    camera_ids: tuple[str, ...]
    fps: float
    timestamps: Float[np.ndarray, " t"]
    landmarks: Float[np.ndarray, "t c l 2"]
    valid: Bool[np.ndarray, "t c"]
    principal_point: Float[np.ndarray, "c 2"]
    source: dict[str, Any]
    calibration: tuple[Camera, ...] | None = None
    quality: FrameQuality | None = None


def write_capture(path: Path, capture: Capture) -> str:
    """Write a capture to a folder, atomically, and return its hash. A capture that is there already is replaced.

    Raises:
        UserError: the folder holds something else, or cannot be written.
    """
    partial = partial_folder(path)
    try:
        check_replaceable(path)
        remove_tree(partial)
        layout = FrameLayout(partial, capture.camera_ids, capture.timesteps, capture.height, capture.width)
        with FrameWriter(layout) as writer, progress_bar(f"write {capture.name}", capture.timesteps) as advance:
            for timestep in range(capture.timesteps):
                images, mattes = capture.images[timestep], capture.mattes[timestep]
                writer.submit(timestep, lambda images=images, mattes=mattes: (images, mattes))
                advance()
            writer.flush()
        data = CaptureData(**{one.name: getattr(capture, one.name) for one in fields(CaptureData)})
        return finish_capture(layout, path, data, writer.digests)
    except OSError as error:
        raise cannot_write(path, error) from None


def read_capture(path: Path) -> Capture:
    """Read a capture.

    Its images and mattes are memory maps of the decoded cache. A stale cache is rebuilt first.

    Raises:
        UserError: the folder is missing, damaged, incomplete, of another version, or being written, or holds a link.
    """
    return read_beside_writers(lambda: _read_capture(path), [path], [path, path.parent])


def _read_capture(path: Path) -> Capture:
    if not path.is_dir():
        raise UserError(f"{path}: no capture there; run `mien capture` first, or check the path")
    check_tree(path)
    content = read_json(path / JSON_NAME, FORMAT, VERSION, STAGE)
    layout, data, digests = _checked(path, content, read_arrays(path / ARRAYS_NAME, STAGE))
    if content.get("capture_hash") != _hash(data, layout, digests):
        raise UserError(f"{path / ARRAYS_NAME}: does not belong to the {JSON_NAME} beside it; {REMEDY}")
    images, mattes = map_frames(layout, content["capture_hash"], digests)
    if read_capture_hash(path) != content["capture_hash"]:
        # The folder was replaced while it was mapped, so the maps may be of two captures.
        raise UserError(f"{path}: was replaced while it was read; run the same command again")
    return Capture(images=images, mattes=mattes, **vars(data))


def read_capture_hash(path: Path) -> str:
    """Return the hash over pixels, mattes, landmarks, times and cameras of a capture, without reading them."""
    return str(read_json(path / JSON_NAME, FORMAT, VERSION, STAGE).get("capture_hash"))


def partial_folder(path: Path) -> Path:
    """Return the folder for an unfinished capture.

    It is beside the final place, so that a rename finishes the capture.
    """
    return path.parent / f".{path.name}.partial"


def check_replaceable(path: Path) -> None:
    """Refuse to overwrite anything but an empty folder or a capture."""
    if path.exists() and not path.is_dir():
        raise UserError(f"{path}: is a file; choose a folder for the capture")
    foreign = sorted(entry.name for entry in path.iterdir() if entry.name not in _OWN_NAMES) if path.is_dir() else []
    if foreign:
        raise UserError(
            f"{path}: holds something that is not part of a capture ({foreign[0]}); choose an empty or a new folder"
        )


def finish_capture(
    layout: FrameLayout,
    path: Path,
    data: CaptureData,
    digests: dict[str, np.ndarray],
    report: dict[str, Any] | None = None,
) -> str:
    """Write the files beside the frames, rename the finished folder to `path` and return the capture's hash."""
    folder = layout.folder
    capture_hash = _hash(data, layout, digests)
    write_arrays(folder / ARRAYS_NAME, _arrays(data, digests))
    if report is not None:
        write_json(folder / REPORT_NAME, "mien.capture_report", 1, report)
    stamp_cache(layout, capture_hash)
    content = {
        "name": data.name,
        "camera_ids": list(data.camera_ids),
        "fps": data.fps,
        "timesteps": layout.timesteps,
        "width": layout.width,
        "height": layout.height,
        "capture_hash": capture_hash,
        "source": data.source,
    }
    write_json(folder / JSON_NAME, FORMAT, VERSION, content)
    replace_folder(path, folder)
    return capture_hash


def _arrays(data: CaptureData, digests: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    arrays = {
        "timestamps": data.timestamps,
        "landmarks": data.landmarks,
        "valid": data.valid,
        "principal_point": data.principal_point,
        "frame_digests": digests[FRAMES],
        "matte_digests": digests[MATTES],
    }
    if data.calibration is not None:
        arrays["K"] = np.stack([camera.K.numpy() for camera in data.calibration])
        arrays["viewmat"] = np.stack([camera.viewmat.numpy() for camera in data.calibration])
    if data.quality is not None:
        arrays |= {name: getattr(data.quality, name) for name in _QUALITY_ARRAYS}
    dtypes = _ARRAYS | _CALIBRATION_ARRAYS | _QUALITY_ARRAYS
    return {name: array.astype(dtypes[name][1]) for name, array in arrays.items()}


def _hash(data: CaptureData, layout: FrameLayout, digests: dict[str, np.ndarray]) -> str:
    digest = hashlib.sha256(repr((data.camera_ids, data.fps, layout.height, layout.width)).encode())
    for name, array in sorted(_arrays(data, digests).items()):
        digest.update(f"{name} {array.shape};".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _checked(
    path: Path, content: dict[str, Any], arrays: dict[str, np.ndarray]
) -> tuple[FrameLayout, CaptureData, dict[str, np.ndarray]]:
    """Return everything but the pictures, after checks of every field's type, range and size."""
    camera_ids: Any = content.get("camera_ids")
    name, fps, source = content.get("name"), content.get("fps"), content.get("source")
    with expect_whole(path / JSON_NAME, REMEDY):
        timesteps, (height, width) = content["timesteps"], (checked_side(content[key]) for key in ("height", "width"))
    if not (
        (isinstance(camera_ids, list) and camera_ids and all(map(is_file_name, camera_ids)))
        and (len(set(camera_ids)) == len(camera_ids) and _is_count(timesteps))
        and (isinstance(fps, int | float) and _MIN_FPS <= fps <= _MAX_FPS)
        and (isinstance(name, str) and is_one_line(name) and isinstance(source, dict))
    ):
        raise UserError(f"{path / JSON_NAME}: has missing or wrong entries; {REMEDY}")
    _check_arrays(path / ARRAYS_NAME, arrays, timesteps, len(camera_ids))
    _check_numbers(path / ARRAYS_NAME, arrays)
    data = CaptureData(
        name=name,
        camera_ids=tuple(camera_ids),
        fps=float(fps),
        timestamps=arrays["timestamps"],
        landmarks=arrays["landmarks"],
        valid=arrays["valid"],
        principal_point=arrays["principal_point"],
        source=source,
        calibration=_calibration(path / ARRAYS_NAME, arrays, width, height),
        quality=FrameQuality(*(arrays[name] for name in _QUALITY_ARRAYS)) if "sharpness" in arrays else None,
    )
    layout = FrameLayout(path, data.camera_ids, timesteps, height, width)
    return layout, data, {FRAMES: arrays["frame_digests"], MATTES: arrays["matte_digests"]}


def _calibration(path: Path, arrays: dict[str, np.ndarray], width: int, height: int) -> tuple[Camera, ...] | None:
    if "K" not in arrays:
        return None
    for K, viewmat in zip(arrays["K"], arrays["viewmat"], strict=True):
        fault = camera_fault(K, viewmat, width, height)
        if fault is not None:
            raise UserError(f"{path}: a camera is not valid ({fault}); {REMEDY}")
    pairs = zip(arrays["K"].astype(np.float32), arrays["viewmat"].astype(np.float32), strict=True)
    return tuple(Camera(torch.from_numpy(K), torch.from_numpy(viewmat), width, height) for K, viewmat in pairs)


def _is_count(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value > 0


def is_file_name(name: object) -> bool:
    """Whether a camera's name can be the name of a folder on any system."""
    return is_plain_name(name) and not set(str(name)) & set(':*?"<>|')


def _check_numbers(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Check that times do not decrease, and that no number is infinite or far outside of any picture.

    Landmarks may be NaN only where there is no face.
    """
    times, valid = arrays["timestamps"], arrays["valid"]
    with np.errstate(invalid="ignore"):
        near = {
            "timestamps": np.isfinite(times).all()
            and bool((np.diff(times) >= 0).all())
            and np.ptp(times) < _MAX_SECONDS,
            "landmarks": not np.isnan(arrays["landmarks"][valid]).any(),
            "principal_point": np.isfinite(arrays["principal_point"]).all(),
        }
        for name in ("landmarks", "principal_point"):
            near[name] = near[name] and not (np.abs(arrays[name]) > MAX_NUMBER).any()
        for name in arrays.keys() & _QUALITY_ARRAYS.keys():
            near[name] = not np.isinf(arrays[name]).any()
    for name, sound in near.items():
        if not sound:
            raise UserError(f"{path}: {name} holds impossible numbers; {REMEDY}")


def _check_arrays(path: Path, arrays: dict[str, np.ndarray], timesteps: int, cameras: int) -> None:
    sizes = {"t": timesteps, "c": cameras, "l": LANDMARKS, "2": 2, "3": 3, "4": 4}
    wanted = dict(_ARRAYS)
    for optional in _OPTIONAL_ARRAYS:
        wanted |= optional if arrays.keys() & optional.keys() else {}
    for name, (axes, dtype) in wanted.items():
        expected = tuple(sizes[axis] for axis in axes)
        if name not in arrays or arrays[name].shape != expected or arrays[name].dtype != dtype:
            found = f"{arrays[name].dtype} {arrays[name].shape}" if name in arrays else "missing"
            raise UserError(f"{path}: {name} is {found}, expected {np.dtype(dtype)} {expected}; {REMEDY}")
