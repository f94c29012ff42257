"""Time and memory of drawing an avatar at a size."""

import time
from pathlib import Path

import torch

from mien import _native
from mien.avatar.avatar import Avatar
from mien.camera import Camera
from mien.face.params import FaceParams
from mien.machine.system import peak_memory_mb
from mien.machine.threads import one_torch_thread
from mien.render import rasterize

_STATUS, _CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def measure_drawing(
    avatar: Avatar, camera: Camera, seconds: float, face: FaceParams | None = None
) -> dict[str, float | int]:
    """Draw the avatar over white, at all threads, for about `seconds`, and return the figures of one row.

    The first picture warms up and does not count, unless it alone takes longer than `seconds`.

    Args:
        avatar: The avatar.
        camera: The camera, with the size of the picture.
        seconds: Time to spend.
        face: The timestep to pose, or None for the person at rest.

    Returns:
        width, height: Size of the picture in pixels.
        gaussians, threads: Their numbers.
        draw_ms, pose_ms: Medians of drawing and of posing, in milliseconds.
        pictures: Number of timed pictures.
        peak_mb: The process's largest memory while drawing, in MiB.
        before_mb: Its memory before the first picture.
    """
    before = _restart_peak()
    white = torch.ones(3)
    draws: list[float] = []
    poses: list[float] = []
    with torch.no_grad(), one_torch_thread():
        began = time.perf_counter()
        while True:
            start = time.perf_counter()
            gaussians = avatar.pose(avatar.subject if face is None else face).gaussians.timestep(0)
            middle = time.perf_counter()
            rasterize(gaussians, camera, white)
            end = time.perf_counter()
            poses.append(1e3 * (middle - start))
            draws.append(1e3 * (end - middle))
            spent = end - began
            if len(draws) == 1 and spent < seconds:
                continue
            if spent >= seconds:
                break
    counted = slice(1, None) if len(draws) > 1 else slice(None)
    return {
        "width": camera.width,
        "height": camera.height,
        "gaussians": len(avatar.gaussian_store()),
        "threads": _native.thread_count(),
        "draw_ms": _median(draws[counted]),
        "pose_ms": _median(poses[counted]),
        "pictures": len(draws[counted]),
        "peak_mb": round(max(_peak_mb(), before), 1),
        "before_mb": round(before, 1),
    }


def measure_in_turn(avatars: dict[str, Avatar], camera: Camera, seconds: float) -> dict[str, float]:
    """The median time to draw each of some avatars, in milliseconds.

    They are drawn in turn, so that other work on the machine slows all of them alike.
    """
    white = torch.ones(3)
    with torch.no_grad(), one_torch_thread():
        posed = [avatar.pose(avatar.subject).gaussians.timestep(0) for avatar in avatars.values()]
        times: list[list[float]] = [[] for _ in avatars]
        end = time.perf_counter() + seconds * len(avatars)
        while len(times[0]) < 2 or time.perf_counter() < end:
            for gaussians, own in zip(posed, times, strict=True):
                start = time.perf_counter()
                rasterize(gaussians, camera, white)
                own.append(1e3 * (time.perf_counter() - start))
    return {name: _median(own[1:]) for name, own in zip(avatars, times, strict=True)}


def _median(values: list[float]) -> float:
    return round(sorted(values)[len(values) // 2], 3)


def _restart_peak() -> float:
    """The memory of this process in MiB. Its peak starts again from there, if the system can do that (Linux)."""
    try:
        _CLEAR.write_text("5")
    except OSError:
        return _peak_mb()
    return _status_mb("VmRSS")


def _peak_mb() -> float:
    try:
        return _status_mb("VmHWM")
    except OSError:
        return peak_memory_mb()


def _status_mb(name: str) -> float:
    line = next(line for line in _STATUS.read_text().splitlines() if line.startswith(name))
    return int(line.split()[1]) / 1024
