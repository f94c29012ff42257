"""The overlay video: does the tracked mesh sit on the picture?"""

import math
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8

from mien.camera import Camera
from mien.capture.capture import Capture
from mien.capture.video import write_video
from mien.face import FaceModel
from mien.progress import track_progress
from mien.render.mesh import Headlight, render_mesh
from mien.tracking.tracking import Tracking

_REGION_COLORS = {
    "lips": (0.95, 0.45, 0.5), "eyelids": (0.55, 0.75, 0.95), "eyes": (1.0, 1.0, 1.0), "irises": (0.2, 0.3, 0.7),
    "teeth": (1.0, 1.0, 0.85), "mouth": (0.45, 0.1, 0.1), "brows": (0.6, 0.55, 0.4), "ears": (0.65, 0.9, 0.6),
    "nose": (0.9, 0.85, 0.6),
}  # fmt: skip
_SKIN = (0.8, 0.78, 0.75)
_MESH_OPACITY = 0.6
_GREEN, _RED, _BLUE, _WHITE, _BLACK = (60, 255, 60), (255, 60, 40), (60, 160, 255), (255, 255, 255), (0, 0, 0)
_SUBPIXEL_BITS = 4
_GRID_WIDTH = 1920
"""Pixels."""


def write_overlay(path: Path, capture: Capture, tracking: Tracking, face_model: FaceModel) -> None:
    """Write a video: on the left detected (green) and mesh (red) landmarks and the neck line, on the right the mesh.

    Several cameras come as a grid, in the order of the capture, shrunk to at most 1920 pixels across.
    """
    write_video(path, _pictures(capture, tracking, face_model), capture.fps)


def draw_overlay(
    capture: Capture, tracking: Tracking, face_model: FaceModel, timestep: int, camera_index: int = 0
) -> UInt8[np.ndarray, "h w2 3"]:
    """One picture of the overlay video, twice as wide as the capture's."""
    camera = tracking.cameras[camera_index]
    image = np.asarray(capture.images[timestep, camera_index])
    with torch.no_grad():
        vertices = face_model(tracking.face[timestep])[0]
        light = Headlight()
        mesh, alpha = render_mesh(vertices, face_model.faces, camera, region_colors(face_model), light=light)
        marks = camera.project(face_model.landmark_positions(vertices, "mediapipe"))[0].numpy()
    opacity = _MESH_OPACITY * alpha.numpy()[..., None]
    blended = image * (1 - opacity) + mesh.clamp(0, 1).numpy() * 255 * opacity
    left = image.copy()  # a capture read from disk is read-only
    detected = np.asarray(capture.landmarks[timestep, camera_index])
    if np.isfinite(detected).all():
        _draw_points(left, detected, _GREEN)
    _draw_points(left, marks, _RED)
    _draw_line(left, tracking.neck_lines[timestep, camera_index].numpy(), camera)
    residual = float(tracking.residuals[timestep, camera_index])
    missing = "no face found" if tracking.valid[timestep] else "no face, interpolated"
    text = f"{timestep}: {residual:.2f} px" if np.isfinite(residual) else f"{timestep}: {missing}"
    if tracking.pixel_residuals is not None and tracking.valid[timestep]:
        colors = float(tracking.pixel_residuals[timestep, camera_index])
        text += f", colours {100 * colors:.1f} %" if np.isfinite(colors) else ", landmarks only"
    text = text if len(tracking.cameras) == 1 else f"{capture.camera_ids[camera_index]} {text}"
    for color, thickness in ((_BLACK, 3), (_WHITE, 1)):
        cv2.putText(left, text, (8, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.5, color, thickness, cv2.LINE_AA)
    return np.concatenate([left, np.round(blended).astype(np.uint8)], axis=1)


def frontal_camera(tracking: Tracking) -> int:
    """The camera that the tracked face looks at most."""
    ahead = tracking.face.T_world_head[tracking.valid][:, :3, 2]
    origins = tracking.face.head_translation[tracking.valid]
    facing = [
        torch.nn.functional.cosine_similarity(ahead, camera.position - origins, dim=1).median()
        for camera in tracking.cameras
    ]
    return int(torch.stack(facing).argmax())


def region_colors(face_model: FaceModel) -> Float[torch.Tensor, "f 3 3"]:
    """A colour for every triangle's corners that tells lips, lids, irises, ears apart."""
    palette = torch.tensor([_REGION_COLORS.get(name, _SKIN) for name in face_model.region_names])
    return palette[face_model.face_regions.long()][:, None].expand(-1, 3, -1)


def draw_overlay_grid(
    capture: Capture, tracking: Tracking, face_model: FaceModel, timestep: int
) -> UInt8[np.ndarray, "h w 3"]:
    """A timestep of the overlay video: the pictures of all cameras side by side, in about a square."""
    cameras = len(tracking.cameras)
    if cameras == 1:
        return draw_overlay(capture, tracking, face_model, timestep)
    columns = math.ceil(math.sqrt(cameras / 2))
    rows = math.ceil(cameras / columns)
    scale = min(1.0, _GRID_WIDTH / (columns * 2 * capture.width))
    # Even sizes, as video codecs want them.
    width, height = (max(2, round(side * scale / 2) * 2) for side in (2 * capture.width, capture.height))
    grid = np.zeros((rows * height, columns * width, 3), np.uint8)
    for index in range(cameras):
        row, column = divmod(index, columns)
        picture = draw_overlay(capture, tracking, face_model, timestep, index)
        tile = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
        grid[row * height : (row + 1) * height, column * width : (column + 1) * width] = tile
    return grid


def _pictures(capture: Capture, tracking: Tracking, face_model: FaceModel) -> Iterator[UInt8[np.ndarray, "h w2 3"]]:
    for timestep in track_progress(range(capture.timesteps), "Overlay", capture.timesteps):
        yield draw_overlay_grid(capture, tracking, face_model, timestep)


def _draw_points(image: UInt8[np.ndarray, "h w 3"], points: Float[np.ndarray, "l 2"], color: tuple) -> None:
    for x, y in _fixed_point(points):
        cv2.circle(image, (int(x), int(y)), 1 << _SUBPIXEL_BITS, color, -1, cv2.LINE_AA, _SUBPIXEL_BITS)


def _draw_line(image: UInt8[np.ndarray, "h w 3"], line: Float[np.ndarray, " 3"], camera: Camera) -> None:
    a, b, d = (float(value) for value in line)
    middle = np.array([camera.width / 2, camera.height / 2])
    foot = middle - (np.array([a, b]) @ middle + d) * np.array([a, b])
    reach = (camera.width + camera.height) * np.array([b, -a])
    (x1, y1), (x2, y2) = _fixed_point(np.stack([foot - reach, foot + reach]))
    cv2.line(image, (int(x1), int(y1)), (int(x2), int(y2)), _BLUE, 1, cv2.LINE_AA, _SUBPIXEL_BITS)


def _fixed_point(points: Float[np.ndarray, "n 2"]) -> np.ndarray:
    """As OpenCV draws them: pixel centres at whole numbers, with some bits behind the point."""
    return np.round(np.clip((points - 0.5) * (1 << _SUBPIXEL_BITS), -(2**28), 2**28)).astype(np.int32)
