"""What the parts of analyses measure and draw: time and memory of drawing, scores of held-out frames, views, labels."""

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from statistics import fmean, median_high
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from mien import _native
from mien.avatar.avatar import Avatar
from mien.camera import Box, Camera
from mien.errors import UserError
from mien.evaluation.experiment import Experiment, avatar_image, target_image
from mien.evaluation.metrics import crop_to, psnr
from mien.evaluation.scoring import score_pictures
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.lab.analysis.result import Picture
from mien.lab.analysis.running import Run
from mien.machine.devices import gpu_memory_mb
from mien.machine.system import peak_memory_mb
from mien.machine.terminal import counted
from mien.machine.threads import one_torch_thread
from mien.media.pictures import WHITE, side_by_side, to_uint8
from mien.perceptual.distance import PerceptualDistance, load_perceptual
from mien.render import rasterize
from mien.render.mesh import Headlight, render_mesh
from mien.training.footage.frames import Frame, spread_frames

METRICS = ("head_psnr", "head_ssim", "head_perceptual")


def measure_drawing(
    avatar: Avatar, camera: Camera, seconds: float, face: FaceParams | None = None
) -> dict[str, float | int]:
    """Draw the avatar, where it is, at a timestep (None: the person at rest) over white, for about `seconds`.

    The first picture warms up and does not count, unless it alone takes longer than `seconds`.

    Returns:
        width, height: Size of the picture in pixels.
        gaussians, threads, pictures: Their numbers; no threads on a GPU; pictures that are timed.
        draw_ms, pose_ms: Medians of drawing and of posing, in milliseconds.
        peak_mb, before_mb: The largest memory while drawing, and the memory before, in MiB: of the process, or of the
            tensors on a GPU.
    """
    like = avatar.face_model.template
    face, camera = (avatar.subject if face is None else face).to(like), camera.to(like)
    before = _restart_peak(like.device)
    white = like.new_ones(3)
    draws: list[float] = []
    poses: list[float] = []
    spent = 0.0
    with torch.no_grad(), one_torch_thread():
        began = time.perf_counter()
        while spent < seconds:
            start = time.perf_counter()
            gaussians = avatar.pose(face).gaussians.timestep(0)
            middle = _now(like)
            rasterize(gaussians, camera, white)
            end = _now(like)
            poses.append(1e3 * (middle - start))
            draws.append(1e3 * (end - middle))
            spent = end - began
    counted = slice(1 if len(draws) > 1 else 0, None)
    return {
        "width": camera.width, "height": camera.height, "gaussians": len(avatar.store),
        "threads": 0 if like.is_cuda else _native.thread_count(), "draw_ms": round(median_high(draws[counted]), 3),
        "pose_ms": round(median_high(poses[counted]), 3), "pictures": len(draws[counted]),
        "peak_mb": round(max(gpu_memory_mb(like.device) or _memory_mb("VmHWM"), before), 1),
        "before_mb": round(before, 1),
    }  # fmt: skip


def measure_in_turn(avatars: Sequence[Avatar], camera: Camera, seconds: float) -> list[float]:
    """The median time to draw each of some avatars, in milliseconds.

    They are drawn in turn, so that other work on the machine slows all of them alike.
    """
    like = avatars[0].face_model.template
    with torch.no_grad(), one_torch_thread():
        posed = [avatar.pose(avatar.subject).gaussians.timestep(0) for avatar in avatars]
        times: list[list[float]] = [[] for _ in avatars]
        end = time.perf_counter() + seconds * len(avatars)
        while len(times[0]) < 2 or time.perf_counter() < end:
            for gaussians, own in zip(posed, times, strict=True):
                start = _now(like)
                rasterize(gaussians, camera.to(like), like.new_ones(3))
                own.append(1e3 * (_now(like) - start))
    return [round(median_high(own[1:]), 3) for own in times]


def _now(like: Tensor) -> float:
    """The time in seconds, once the GPU of `like`, if it is on one, has done its work."""
    if like.is_cuda:
        torch.cuda.synchronize(like.device)
    return time.perf_counter()


def measured_on(row: Mapping[str, Any]) -> str:
    """Say what drew the pictures of a row of `measure_drawing`."""
    return f"{counted(row['threads'], 'thread')} of a CPU" if row["threads"] else "a GPU"


def _restart_peak(device: torch.device) -> float:
    """The memory of this process or of a GPU in MiB. Its peak starts again from there, if that can be done (Linux)."""
    if device.type == "cuda":
        return gpu_memory_mb(device, restart=True)
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return _memory_mb("VmHWM")
    return _memory_mb("VmRSS")


def _memory_mb(name: str) -> float:
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return peak_memory_mb()
    return int(next(line for line in lines if line.startswith(name)).split()[1]) / 1024


def perceptual_metric() -> tuple[PerceptualDistance | None, list[str]]:
    """ST-LPIPS, or None and a note that says why it is missing."""
    try:
        return load_perceptual(), []
    except UserError as error:
        return None, [f"ST-LPIPS was not computed: {error}."]


@torch.no_grad()
def held_out_scores(run: Run, metric: PerceptualDistance | None) -> dict[str, float | None]:
    """Means of `METRICS` over 16 held-out frames. None where nothing was held out, or pictures are too small."""
    rows = []
    if (experiment := run.experiment) is not None:
        for frame in spread_frames(experiment.held_out_frames, 16):
            pictures, target = {"avatar": avatar_image(experiment, frame)}, target_image(experiment, frame)
            rows.append(score_pictures(pictures, target, experiment.crop(frame), metric)["avatar"])
    known = {name: [row[name] for row in rows if name in row] for name in METRICS}
    return {name: round(fmean(values), 4) if values else None for name, values in known.items()}


def score_cells(row: dict[str, Any]) -> list[float | None]:
    """The scores of a row for a table."""
    return [row[name] if row[name] is None else round(row[name], 2 + (name != "head_psnr")) for name in METRICS]


def mean_psnr(experiment: Experiment, frames: Sequence[Frame]) -> float:
    """The mean PSNR of the head crop over some frames, in dB."""
    return fmean(
        psnr(avatar_image(experiment, frame), target_image(experiment, frame), experiment.crop(frame))
        for frame in frames
    )


def head_picture(experiment: Experiment, frame: Frame, image: Tensor) -> UInt8[np.ndarray, "_ _ 3"]:
    """The head crop of a picture of a frame."""
    return to_uint8(crop_to(image, experiment.crop(frame)))


def picture_of_runs(name: str, runs: Mapping[str, Run], chosen: Callable[[Experiment], Frame]) -> list[Picture]:
    """A held-out frame, which is chosen in the first run: the truth, then each run. None if nothing was held out."""
    tiles, caption, frame = [], "", None
    for label, run in runs.items():
        if (experiment := run.experiment) is None:
            return []
        if frame is None:
            frame = chosen(experiment)
            tiles.append(labeled(head_picture(experiment, frame, target_image(experiment, frame)), "truth"))
            place = f"{experiment.sequences[frame.sequence].name}, timestep {frame.timestep}"
            caption = f"{place}, held out: the truth, then each training."
        tiles.append(labeled(head_picture(experiment, frame, avatar_image(experiment, frame)), label))
    return [Picture(name, side_by_side(tiles), caption)]


def zoomed(camera: Camera, box: Box, side: int) -> Camera:
    """A square part of the camera's view as a picture of `side` pixels."""
    left, top, width, height = box
    return camera.cropped(left, top, width, height).resized(side, side)


def mouth_box(model: FaceModel, face: FaceParams, camera: Camera) -> Box:
    """A square box around the mouth in the picture, at least 8 pixels wide. Without a mouth, it is around the head."""
    mask = next((mask for mask in map(model.region_mask, ("lips", "teeth")) if bool(mask.any())), None)
    points = model(face)[0]
    return _square(points if mask is None else points[model.faces[mask].unique()], camera, 1.3)


def mouth_camera(model: FaceModel, face: FaceParams, camera: Camera, side: int) -> Camera:
    """The camera, enlarged to the mouth, with a square picture."""
    return zoomed(camera, mouth_box(model, face, camera), side)


def head_camera(model: FaceModel, face: FaceParams, camera: Camera, side: int) -> Camera:
    """The camera, enlarged to the head, with a square picture."""
    return zoomed(camera, _square(model(face)[0], camera, 1.15), side)


def _square(points: Float[Tensor, "p 3"], camera: Camera, margin: float) -> Box:
    pixels, _ = camera.project(points)
    low, high = pixels.amin(0), pixels.amax(0)
    side = max(8.0, margin * float((high - low).max()))
    x, y = ((low + high) / 2).tolist()
    return round(x - side / 2), round(y - side / 2), round(side), round(side)


@torch.no_grad()
def draw_avatar(
    avatar: Avatar, face: FaceParams, camera: Camera, kept: Tensor | None = None
) -> UInt8[np.ndarray, "h w 3"]:
    """The avatar over white, with all Gaussians or those that a mask or indices select."""
    gaussians = avatar.pose(face).gaussians.timestep(0)
    return to_uint8(rasterize(gaussians if kept is None else gaussians.select(kept), camera, torch.ones(3)).image)


@torch.no_grad()
def draw_mesh(model: FaceModel, face: FaceParams, camera: Camera) -> UInt8[np.ndarray, "h w 3"]:
    """The mesh of the face model, grey and lit, over white."""
    return to_uint8(render_mesh(model(face)[0], model.faces, camera, light=Headlight(), supersample=2)[0])


def labeled(image: UInt8[np.ndarray, "h w 3"], text: str) -> UInt8[np.ndarray, "_ w 3"]:
    """The picture below a white strip with a text, which is cut where it is too long."""
    strip = np.full((20, image.shape[1], 3), WHITE, np.uint8)
    cv2.putText(strip, text, (3, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (60, 60, 60), 1, cv2.LINE_AA)
    return np.concatenate([strip, image], axis=0)
