"""Write and read captures on disk: `capture.json`, `landmarks.safetensors`, `frames/`, `mattes/` and a `cache/`."""

import hashlib
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mien.camera import Camera
from mien.capture import frame_files
from mien.capture.cameras.calibration import is_file_name
from mien.capture.capture import Capture
from mien.capture.person.faces import LANDMARKS
from mien.capture.quality import FrameQuality
from mien.disk.files import cannot_write, read_arrays, read_json, replace_folder, write_arrays, write_json
from mien.disk.limits import camera_fault, checked_side, checked_whole, is_moderate
from mien.disk.locks import read_beside_writers
from mien.disk.reading import check_tree, expect_whole, is_one_line, remove_tree
from mien.errors import UserError
from mien.machine.progress import progress_bar, say
from mien.machine.terminal import counted

FORMAT, VERSION = "mien.capture", 1
JSON_NAME, ARRAYS_NAME, REPORT_NAME = "capture.json", "landmarks.safetensors", "report.json"
_OWN_NAMES = frozenset({JSON_NAME, ARRAYS_NAME, REPORT_NAME, frame_files.FRAMES, frame_files.MATTES, frame_files.CACHE})
_QUALITY = ("sharpness", "brightness", "clipped")  # arrays that are there if the faces were measured
_ARRAYS = {
    "timestamps": ("t", np.float64),
    "landmarks": ("tcl2", np.float32),
    "valid": ("tc", np.bool_),
    "principal_point": ("c2", np.float64),
    "frame_digests": ("tc", np.uint64),
    "matte_digests": ("tc", np.uint64),
    **dict.fromkeys(_QUALITY, ("tc", np.float32)),
    "K": ("c33", np.float64),
    "viewmat": ("c44", np.float64),
}
"""Axes and type of every array in the safetensors file. The last two are there if the cameras are calibrated."""
_MAX_SECONDS = 1e7  # longest time from the first frame to the last, in seconds


def write_capture(path: Path, capture: Capture) -> str:
    """Write a capture to a folder, atomically, and return its hash. A capture that is there already is replaced."""
    partial = partial_folder(path)
    try:
        check_replaceable(path)
        remove_tree(partial)
        layout = frame_files.FrameLayout(partial, capture.camera_ids, capture.timesteps, capture.height, capture.width)
        with (
            frame_files.FrameWriter(layout) as writer,
            progress_bar(f"write {capture.name}", capture.timesteps) as advance,
        ):
            for timestep in range(capture.timesteps):
                images, mattes = capture.images[timestep], capture.mattes[timestep]
                writer.submit(timestep, lambda images=images, mattes=mattes: (images, mattes))
                advance()
            writer.flush()
        return finish_capture(layout, path, capture, writer.digests)
    except OSError as error:
        raise cannot_write(path, error) from None


def read_capture(path: Path) -> Capture:
    """Read a capture. Images and mattes are memory maps of the decoded cache, which is rebuilt if it is stale."""
    return read_beside_writers(lambda: _read_capture(path), [path], [path, path.parent])


def _read_capture(path: Path) -> Capture:
    if not path.is_dir():
        raise UserError(f"{path}: no capture there; run `mien capture` first, or check the path")
    check_tree(path)
    content = read_json(path / JSON_NAME, FORMAT, VERSION, frame_files.STAGE)
    arrays = read_arrays(path / ARRAYS_NAME, frame_files.STAGE)
    with expect_whole(path / JSON_NAME, frame_files.REMEDY):
        _check(content, arrays)
        camera_ids = tuple(content["camera_ids"])
        width, height = checked_side(content["width"]), checked_side(content["height"])
        layout = frame_files.FrameLayout(path, camera_ids, content["timesteps"], height, width)
        fps = float(content["fps"])
        belongs = content["capture_hash"] == _hash(layout, fps, arrays)
        calibration = _calibration(arrays, width, height)
        quality = FrameQuality(*(arrays[name] for name in _QUALITY)) if "sharpness" in arrays else None
    if not belongs:
        raise UserError(f"{path / ARRAYS_NAME}: does not belong to the {JSON_NAME} beside it; {frame_files.REMEDY}")
    digests = {frame_files.FRAMES: arrays["frame_digests"], frame_files.MATTES: arrays["matte_digests"]}
    images, mattes = frame_files.map_frames(layout, content["capture_hash"], digests)
    if read_capture_hash(path) != content["capture_hash"]:
        # The folder was replaced while it was mapped, so the maps may be of two captures.
        raise UserError(f"{path}: was replaced while it was read; run the same command again")
    return Capture(
        name=content["name"], camera_ids=camera_ids, fps=fps, timestamps=arrays["timestamps"], images=images,
        mattes=mattes, landmarks=arrays["landmarks"], valid=arrays["valid"], principal_point=arrays["principal_point"],
        source=content["source"], calibration=calibration, quality=quality,
    )  # fmt: skip


def _calibration(arrays: dict[str, np.ndarray], width: int, height: int) -> tuple[Camera, ...] | None:
    if "K" not in arrays:
        return None
    pairs = list(zip(arrays["K"].astype(np.float32), arrays["viewmat"].astype(np.float32), strict=True))
    for K, viewmat in pairs:
        if fault := camera_fault(K, viewmat, width, height):
            raise ValueError(f"a camera is not valid: {fault}")
    return tuple(Camera(torch.from_numpy(K), torch.from_numpy(viewmat), width, height) for K, viewmat in pairs)


def read_capture_hash(path: Path) -> str:
    """Return the hash over pixels, mattes, landmarks, times and cameras of a capture, without reading them."""
    return str(read_json(path / JSON_NAME, FORMAT, VERSION, frame_files.STAGE).get("capture_hash"))


def partial_folder(path: Path) -> Path:
    """Return the folder for an unfinished capture, beside the final place, so that a rename finishes it."""
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
    layout: frame_files.FrameLayout, path: Path, capture: Capture, digests: dict[str, np.ndarray],
    report: dict[str, Any] | None = None,
) -> str:  # fmt: skip
    """Write the files beside the frames, which are in the layout's folder, rename it to `path` and return the hash."""
    folder = layout.folder
    arrays = _arrays(capture, digests)
    capture_hash = _hash(layout, capture.fps, arrays)
    write_arrays(folder / ARRAYS_NAME, arrays)
    if report is not None:
        write_json(folder / REPORT_NAME, "mien.capture_report", 1, report)
    frame_files.stamp_cache(layout, capture_hash)
    content = {
        "name": capture.name, "camera_ids": list(capture.camera_ids), "fps": capture.fps, "timesteps": layout.timesteps,
        "width": layout.width, "height": layout.height, "capture_hash": capture_hash, "source": capture.source,
    }  # fmt: skip
    write_json(folder / JSON_NAME, FORMAT, VERSION, content)
    replace_folder(path, folder)
    return capture_hash


def _arrays(capture: Capture, digests: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    arrays = {
        "timestamps": capture.timestamps, "landmarks": capture.landmarks, "valid": capture.valid,
        "principal_point": capture.principal_point, "frame_digests": digests[frame_files.FRAMES],
        "matte_digests": digests[frame_files.MATTES],
    }  # fmt: skip
    if capture.calibration is not None:
        arrays["K"] = np.stack([camera.K.numpy() for camera in capture.calibration])
        arrays["viewmat"] = np.stack([camera.viewmat.numpy() for camera in capture.calibration])
    if capture.quality is not None:
        arrays |= vars(capture.quality)
    return {name: array.astype(_ARRAYS[name][1]) for name, array in arrays.items()}


def _hash(layout: frame_files.FrameLayout, fps: float, arrays: dict[str, np.ndarray]) -> str:
    digest = hashlib.sha256(repr((layout.camera_ids, fps, layout.height, layout.width)).encode())
    for name, array in sorted(arrays.items()):
        digest.update(f"{name} {array.shape};".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _check(content: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
    """Check what may come from a stranger: names of folders, sizes, and numbers that would overflow later."""
    ids, times, valid = content["camera_ids"], arrays["timestamps"], arrays["valid"]
    if not (ids and all(map(is_file_name, ids)) and len(set(ids)) == len(ids)):
        raise ValueError("names of cameras that no folders can have")
    if not (1e-3 <= content["fps"] <= 1e5 and is_one_line(content["name"]) and isinstance(content["source"], dict)):
        raise ValueError("frame rate, name or source that no capture has")
    timesteps = checked_whole(content["timesteps"], 1, 1 << 40)
    sizes = {"t": timesteps, "c": len(ids), "l": LANDMARKS, "2": 2, "3": 3, "4": 4}
    for name, array in arrays.items():
        axes, dtype = _ARRAYS[name]
        expected = tuple(sizes[axis] for axis in axes)
        if array.shape != expected or array.dtype != dtype:
            raise ValueError(f"{name} is {array.dtype} {array.shape}, expected {np.dtype(dtype)} {expected}")
    # Landmarks may be NaN only where there is no face, and so may the quality.
    landmarks = arrays["landmarks"]
    numbers = (times, arrays["principal_point"], landmarks[valid], landmarks[~np.isnan(landmarks)])
    if not all(map(is_moderate, numbers)) or (np.diff(times) < 0).any() or np.ptp(times) > _MAX_SECONDS:
        raise ValueError("impossible times, landmarks or principal points")
    if any(np.isinf(arrays[name]).any() for name in _QUALITY if name in arrays):
        raise ValueError("impossible figures of quality")


_PNG_SHARE = 0.5
"""Size of lossless PNGs relative to their pixels. Footage takes 0.2 to 0.5 of them, mattes almost nothing."""


def capture_bytes(layout: frame_files.FrameLayout) -> int:
    """Estimate the room that a capture takes on disk, in bytes: the decoded pixels and the PNGs."""
    frames, mattes = layout.raw_size(frame_files.FRAMES), layout.raw_size(frame_files.MATTES)
    return frames + mattes + round(_PNG_SHARE * frames)


def check_room(layout: frame_files.FrameLayout, name: str, out: Path) -> None:
    """Say how much room a capture takes, before its pictures are written. Files of an interrupted run count as room."""
    cameras, size = len(layout.camera_ids), f"{layout.width}x{layout.height}"
    what = f"{counted(layout.timesteps, 'frame')} of {size}" + (f" by {cameras} cameras" if cameras > 1 else "")
    needed = capture_bytes(layout)
    # Files that are there already count by their blocks: raw files may have holes.
    used = (path.stat().st_blocks for path in layout.folder.rglob("*") if path.is_file() and not path.is_symlink())
    free = shutil.disk_usage(layout.folder).free + 512 * sum(used)
    if free < needed:
        if not any(entry.is_dir() for entry in layout.folder.iterdir()):
            remove_tree(layout.folder)  # no picture is in it
        raise UserError(
            f"{out}: {what} take about {_text(needed)} on disk, and there are {_text(free)} left; free disk space, "
            "choose another --out, or take less (--capture.max-frames, --capture.stride, --capture.size)"
        )
    say(f"{name}: {what} take about {_text(needed)} on disk")


def _text(count: int) -> str:
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{max(1, round(count / 1e6))} MB"
