"""The scoring mask: what of each picture belongs to the head, frozen once a sequence so that runs compare."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from mien.camera import Camera
from mien.capture.capture import Capture
from mien.face import FaceModel
from mien.picture_files import PictureStack
from mien.progress import track_progress
from mien.render.mesh import rasterize_mesh
from mien.tracking.neck_line import neck_vertices
from mien.tracking.tracking import Tracking

_SILHOUETTE_MARGIN = 0.015
"""By how much the projected head is widened, in its own widths: tracking is not exact to the pixel."""
_NECK_MARGIN = 1.15
"""Beside the neck's middle this many of its half widths are kept..."""
_SLOPE = 1.0
"""...and this much more with every pixel above the line: hair stays, collars and shoulders go."""
_FAINT = 32
"""Opacity (of 255) from which a pixel counts for connection and for the crop."""


@dataclass(frozen=True, eq=False)
class Scoring:
    """What is trained on and scored, frames of t timesteps and c cameras."""

    masks: UInt8[np.ndarray, "t c h w"]
    """Opacity of the head, 255 = head: the matte, cut below the neck line. A memory map where they are many."""
    crops: Int[np.ndarray, "t c 4"]
    """Left, top, width, height of the head crop, pixels: the box of the mask."""


def make_scoring(capture: Capture, tracking: Tracking, face_model: FaceModel, scratch: Path | None = None) -> Scoring:
    """Masks and head crops of every frame; masks too many for the memory lie in a nameless file in `scratch`.

    A pixel keeps its matte if it is above the neck line and not far beside the neck, or inside the projected head (a
    bowed chin hangs below the line); what is then not connected to the head goes as well.
    """
    masks = PictureStack(capture.mattes.shape, scratch)
    crops = np.zeros((*capture.mattes.shape[:2], 4), np.int64)
    head_faces = face_model.faces[~face_model.region_mask("neck")]
    ring = neck_vertices(face_model)
    for timestep in track_progress(range(capture.timesteps), "Scoring masks", capture.timesteps):
        vertices = face_model(tracking.face[timestep])[0]
        for index, camera in enumerate(tracking.cameras):
            head = rasterize_mesh(vertices, head_faces, camera).face_index.numpy() >= 0
            neck = camera.project(vertices[ring])[0].numpy()
            keep = above_neck_line(tracking.neck_lines[timestep, index].numpy(), neck, camera)
            mask = cut_matte(np.asarray(capture.mattes[timestep, index]), head, keep)
            masks.write(timestep, index, mask)
            crops[timestep, index] = head_crop(mask)
    return Scoring(masks.array(), crops)


def above_neck_line(
    line: Float[np.ndarray, " 3"], neck: Float[np.ndarray, "n 2"], camera: Camera
) -> Float[np.ndarray, "h w"]:
    """1 above the neck line and near the neck, 0 elsewhere, with borders one pixel soft.

    Args:
        line: as `Tracking.neck_lines`.
        neck: pixels of the middle of the neck, which tell where it is and how wide.
        camera: whose picture it is.
    """
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    a, b, d = (float(value) for value in line)
    above = a * x + b * y + d
    along = b * x - a * y
    neck_along = neck @ np.array([b, -a])
    middle, half_width = (neck_along.max() + neck_along.min()) / 2, np.ptp(neck_along) / 2
    beside = half_width * _NECK_MARGIN + _SLOPE * above - np.abs(along - middle)
    return (np.clip(above + 0.5, 0, 1) * np.clip(beside + 0.5, 0, 1)).astype(np.float32)


def cut_matte(
    matte: UInt8[np.ndarray, "h w"], head: Bool[np.ndarray, "h w"], keep: Float[np.ndarray, "h w"]
) -> UInt8[np.ndarray, "h w"]:
    """The matte where `keep` is or the head; parts that do not touch the head go.

    Args:
        matte: 255 = person.
        head: the projected head without its neck.
        keep: 0..1.
    """
    columns = np.flatnonzero(head.any(0))
    margin = round(_SILHOUETTE_MARGIN * (columns[-1] - columns[0] + 1)) if len(columns) else 0
    if margin:
        head = cv2.dilate(head.astype(np.uint8), _disc(margin)).astype(bool)
    mask = np.round(matte * np.where(head, np.float32(1), keep)).astype(np.uint8)
    _, labels = cv2.connectedComponents((mask >= _FAINT).astype(np.uint8))
    ours = np.unique(labels[head & (labels > 0)])
    faint_or_ours = (labels == 0) | np.isin(labels, ours)
    return np.where(faint_or_ours, mask, 0).astype(np.uint8)


def head_crop(mask: UInt8[np.ndarray, "h w"]) -> Int[np.ndarray, " 4"]:
    """Left, top, width, height of the box of the mask; the whole picture where nothing is in it."""
    rows, columns = np.flatnonzero((mask >= _FAINT).any(1)), np.flatnonzero((mask >= _FAINT).any(0))
    if len(rows) == 0:
        return np.array([0, 0, mask.shape[1], mask.shape[0]])
    return np.array([columns[0], rows[0], columns[-1] - columns[0] + 1, rows[-1] - rows[0] + 1])


def _disc(radius: int) -> UInt8[np.ndarray, "k k"]:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)).astype(np.uint8)
