"""The overlay video, which shows whether the tracked mesh fits the pictures, and heat maps of colour differences."""

import math
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8

from mien.capture.capture import Capture
from mien.face.model import FaceModel
from mien.face.params import most_frontal_camera
from mien.machine.parallel import stream_in_threads
from mien.machine.progress import track_progress
from mien.media.pictures import heat_colors
from mien.media.video import write_video
from mien.render.mesh import Headlight, render_mesh
from mien.tracking.neck_cut import NeckParts, above_neck_cut, fit_neck_cut
from mien.tracking.pixels.outcome import model_pictures
from mien.tracking.pixels.pictures import window_of
from mien.tracking.report.rig import seen_from_front, visible_landmarks
from mien.tracking.tracking import Tracking

_REGION_COLORS = {
    "lips": (0.95, 0.45, 0.5), "eyelids": (0.55, 0.75, 0.95), "eyes": (1.0, 1.0, 1.0), "irises": (0.2, 0.3, 0.7),
    "teeth": (1.0, 1.0, 0.85), "mouth": (0.45, 0.1, 0.1), "brows": (0.6, 0.55, 0.4), "ears": (0.65, 0.9, 0.6),
    "nose": (0.9, 0.85, 0.6), "tongue": (0.85, 0.55, 0.5),
}  # fmt: skip
_MESH_OPACITY = 0.6
_DIMMED = 0.35  # brightness of pixels that are not compared
HOTTEST = 0.15
"""Length of the colour difference (each channel 0..1) that is drawn brightest."""
_GREEN, _RED, _BLUE = (60, 255, 60), (255, 60, 40), (60, 160, 255)


def write_overlay(path: Path, capture: Capture, tracking: Tracking, face_model: FaceModel, every: int = 1) -> None:
    """Write a video of `OverlayPainter.picture`.

    If `every` is n, it shows every n-th timestep at 1/n of the frame rate, so it lasts as long as the capture. Several
    cameras form a grid, in the order of the capture, which is scaled down to at most 1920 pixels across.
    """
    painter, timesteps = OverlayPainter(capture, tracking, face_model), range(0, capture.timesteps, every)
    pictures = stream_in_threads(partial(_grid, painter, len(tracking.cameras)), timesteps)
    # Quality that is enough for viewing takes a quarter of the time of `write_video`'s defaults.
    write_video(path, track_progress(pictures, "Overlay", len(timesteps)), capture.fps / every, 21, "veryfast")


def overlay_stride(timesteps: int) -> int:
    """Stride between the timesteps that an overlay shows, at least 1, so that there are at most 120 pictures."""
    return max(1, math.ceil(timesteps / 120))  # number of pictures that take about five seconds on two cores


class OverlayPainter:
    """Draws a tracking over its capture. It is immutable, so several threads may use it at once."""

    def __init__(self, capture: Capture, tracking: Tracking, face_model: FaceModel) -> None:
        self._capture, self._tracking, self._face_model = capture, tracking, face_model
        palette = torch.tensor([_REGION_COLORS.get(name, (0.8, 0.78, 0.75)) for name in face_model.region_names])
        self._colors = palette[face_model.face_regions.long()][:, None].expand(-1, 3, -1)
        self._neck = NeckParts.of(face_model)
        self._models = model_pictures(capture, tracking, face_model)
        self._from_front = seen_from_front(tracking)

    def picture(self, timestep: int, camera_index: int = 0) -> UInt8[np.ndarray, "h2 w2 3"]:
        """The panels joined into one picture: two side by side, or four in a square."""
        panels = self.panels(timestep, camera_index)
        write_text(panels[0], self.caption(timestep, camera_index), (8, 20))
        for panel, name in zip(panels[2:], ("model", "difference"), strict=False):
            write_text(panel, name, (8, 20))
        if len(panels) > 2:
            draw_legend(panels[-1], 32)
        rows = [np.concatenate(panels[row : row + 2], axis=1) for row in range(0, len(panels), 2)]
        return np.concatenate(rows, axis=0)

    @torch.no_grad()
    def panels(self, timestep: int, camera_index: int = 0) -> list[UInt8[np.ndarray, "h w 3"]]:
        """The two or four panels of a picture, each of the capture's size.

        The first shows detected (green) and mesh (red) landmarks and the neck cut, the second the mesh. With several
        cameras, the first shows the landmarks of the side of the head that faces the camera. If the tracking was fitted
        to pixels, the third shows the model's own picture and the fourth the difference of its colours from the
        capture's.
        """
        image = np.asarray(self._capture.images[timestep, camera_index])
        vertices = self._face_model(self._tracking.face[timestep])[0]
        panels = [self._landmarks(image, vertices, timestep, camera_index), self._mesh(image, vertices, camera_index)]
        if self._models is not None:
            panels += self._model(image, vertices, timestep, camera_index)
        return panels

    @torch.no_grad()
    def head_box(self, timestep: int, camera_index: int = 0) -> tuple[slice, slice]:
        """Rows and columns of a square around the head, kept inside the picture."""
        camera = self._tracking.cameras[camera_index]
        window = window_of(camera, self._face_model(self._tracking.face[timestep])[0])
        side = min(round(1.15 * max(window.camera.width, window.camera.height)), camera.width, camera.height)
        middle = ((part.start + part.stop) // 2 for part in (window.rows, window.columns))
        sizes = (camera.height, camera.width)
        first = [min(max(at - side // 2, 0), size - side) for at, size in zip(middle, sizes, strict=True)]
        return slice(first[0], first[0] + side), slice(first[1], first[1] + side)

    def _landmarks(
        self, image: UInt8[np.ndarray, "h w 3"], vertices: Float[torch.Tensor, "v 3"], timestep: int, camera_index: int
    ) -> UInt8[np.ndarray, "h w 3"]:
        tracking, camera = self._tracking, self._tracking.cameras[camera_index]
        marks = np.empty((0, 2))
        if "mediapipe" in self._face_model.landmarks:
            marks = camera.project(self._face_model.landmark_positions(vertices, "mediapipe"))[0].numpy()
        picture = image.copy()  # A capture read from disk is read-only.
        detected = np.asarray(self._capture.landmarks[timestep, camera_index])
        if len(tracking.cameras) > 1 and len(marks):
            # Landmarks on the far side of the head are guesses, which look like failures.
            seen = visible_landmarks(self._face_model, vertices, camera).numpy()
            detected, marks = detected[seen], marks[seen]
        if np.isfinite(detected).all():
            draw_points(picture, detected, _GREEN)
        draw_points(picture, marks, _RED)
        cut = fit_neck_cut(self._neck, vertices, tracking.face.T_world_head[timestep, :3, 1])
        kept = (above_neck_cut(cut, camera) > 0.5).astype(np.uint8)
        picture[cv2.morphologyEx(kept, cv2.MORPH_GRADIENT, np.ones((2, 2), np.uint8)) > 0] = _BLUE
        return picture

    def caption(self, timestep: int, camera_index: int) -> str:
        """Return the caption of a picture: camera, timestep and residual."""
        tracking = self._tracking
        residual = float(tracking.residuals[timestep, camera_index])
        missing = "no face found" if tracking.valid[timestep] else "no face, interpolated"
        text = f"{timestep}: {residual:.2f} px" if np.isfinite(residual) else f"{timestep}: {missing}"
        if np.isfinite(residual) and not self._from_front[timestep, camera_index]:
            text = f"{timestep}: from the side"
        if tracking.pixel_residuals is not None and tracking.valid[timestep]:
            colors = float(tracking.pixel_residuals[timestep, camera_index])
            text += f", colours {100 * colors:.1f} %" if np.isfinite(colors) else ", landmarks only"
        return text if len(tracking.cameras) == 1 else f"{self._capture.camera_ids[camera_index]} {text}"

    def _mesh(
        self, image: UInt8[np.ndarray, "h w 3"], vertices: Float[torch.Tensor, "v 3"], camera_index: int
    ) -> UInt8[np.ndarray, "h w 3"]:
        window, faces = window_of(self._tracking.cameras[camera_index], vertices), self._face_model.faces
        mesh, alpha = render_mesh(vertices, faces, window.camera, self._colors, light=Headlight())
        drawn, picture = (255 * mesh.clamp_(0, 1)).to(torch.uint8).numpy(), image.copy()
        part = picture[window.rows, window.columns]
        blended = cv2.addWeighted(part, 1 - _MESH_OPACITY, drawn, _MESH_OPACITY, 0)
        np.copyto(part, blended, where=alpha.numpy()[..., None] > 0)
        return picture

    def _model(
        self, image: UInt8[np.ndarray, "h w 3"], vertices: Float[torch.Tensor, "v 3"], timestep: int, camera_index: int
    ) -> list[UInt8[np.ndarray, "h w 3"]]:
        assert self._models is not None
        compared = self._models.compare(timestep, camera_index, vertices)
        part = compared.window.rows, compared.window.columns
        difference = compared.difference.numpy()
        gray = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY)
        behind = cv2.cvtColor(cv2.convertScaleAbs(gray, alpha=_DIMMED), cv2.COLOR_GRAY2RGB)
        known = np.isfinite(difference)[..., None]
        own = (255 * compared.image.nan_to_num(0).clamp_(0, 1)).to(torch.uint8).numpy()
        panels = [behind, behind.copy()]
        for panel, drawn in zip(panels, (own, heat_colors(difference, HOTTEST)), strict=True):
            np.copyto(panel[part], drawn, where=known)
        return panels


def frontal_camera(tracking: Tracking) -> int:
    """The index of the camera that the tracked face looks at most directly."""
    return most_frontal_camera(tracking.cameras, tracking.face[tracking.valid])


def _grid(painter: OverlayPainter, cameras: int, timestep: int) -> UInt8[np.ndarray, "h w 3"]:
    if cameras == 1:
        return painter.picture(timestep)
    pictures = [painter.picture(timestep, index) for index in range(cameras)]
    tall, wide = pictures[0].shape[:2]
    columns = math.ceil(math.sqrt(cameras * tall / wide))
    rows = math.ceil(cameras / columns)
    scale = min(1.0, 1920 / (columns * wide))  # largest width of a grid of pictures, in pixels
    # Video codecs need even sizes.
    width, height = (max(2, round(side * scale / 2) * 2) for side in (wide, tall))
    grid = np.zeros((rows * height, columns * width, 3), np.uint8)
    for index, picture in enumerate(pictures):
        row, column = divmod(index, columns)
        tile = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
        grid[row * height : (row + 1) * height, column * width : (column + 1) * width] = tile
    return grid


def draw_points(image: UInt8[np.ndarray, "h w 3"], points: Float[np.ndarray, "l 2"], color: tuple) -> None:
    """Draw landmarks as discs."""
    bits = 4  # of OpenCV's fixed-point format, with pixel centres at whole numbers
    for x, y in np.round(np.clip((points - 0.5) * (1 << bits), -(2**28), 2**28)).astype(np.int32).tolist():
        cv2.circle(image, (x, y), 1 << bits, color, -1, cv2.LINE_AA, bits)


def draw_legend(picture: UInt8[np.ndarray, "h w 3"], top: int) -> None:
    """Draw a colour bar at the left, from no difference to the largest that is shown. Small pictures get none."""
    height, width = picture.shape[:2]
    margin, thick, white = 8, 8, (255, 255, 255)
    length = min(120, width // 2 - 2 * margin)
    if length < 32 or height < top + 64:
        return
    left = 3 * margin
    bar = np.broadcast_to(np.linspace(0, 255, length), (thick, length))
    picture[top : top + thick, left : left + length] = heat_colors(bar, 255.0)
    cv2.rectangle(picture, (left - 1, top - 1), (left + length, top + thick), white, 1)
    write_text(picture, "0", (margin, top + thick), 0.4)
    write_text(picture, f"{100 * HOTTEST:.0f} %", (left + length + margin, top + thick), 0.4)


def write_text(picture: UInt8[np.ndarray, "h w 3"], text: str, at: tuple[int, int], size: float = 0.5) -> None:
    """Draw white letters with a black rim. `at` is the left end of their baseline."""
    left, foot = at
    # The rim is the same letters shifted, because thicker letters would also be wider.
    rim = [(left + x, foot + y, (0, 0, 0)) for x in (-1, 0, 1) for y in (-1, 0, 1)]
    for x, y, color in (*rim, (left, foot, (255, 255, 255))):
        cv2.putText(picture, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, size, color, 1, cv2.LINE_AA)
