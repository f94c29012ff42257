"""The scoring mask: the part of each picture that shows the head, fixed once per sequence so that runs compare."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from mien.camera import Camera
from mien.capture.capture import Capture
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.machine.progress import track_progress
from mien.media.picture_files import PictureStack
from mien.render.mesh import rasterize_mesh
from mien.tracking.neck_cut import NeckCut, NeckParts, above_neck_cut, fit_neck_cut
from mien.tracking.neck_line import project_neck_line
from mien.tracking.settings import Cut
from mien.tracking.tracking import Tracking

_SILHOUETTE_MARGIN = 0.015
"""Margin around the projected head, in its own widths, because tracking is not exact to the pixel."""
_FAINT = 32  # least opacity (of 255) of a pixel that counts for connection and for the crop


@dataclass(frozen=True, eq=False)
class Scoring:
    """The parts of the pictures of t timesteps and c cameras that are trained on and scored."""

    masks: UInt8[np.ndarray, "t c h w"]
    """Opacity of the head (255 is head): the matte, cut at the neck, or of the person if nothing is cut. It is a
    memory map if there are many."""
    crops: Int[np.ndarray, "t c 4"]
    """Left, top, width and height of the head crop in pixels: the box of the mask, of the cut `plane` if nothing is
    cut."""
    cut: Cut = "plane"
    """Lower end of the head (`ScoringSettings.cut`)."""


def make_scoring(
    capture: Capture,
    tracking: Tracking,
    face_model: FaceModel,
    scratch: Path | None = None,
    cut: Cut = "plane",
) -> Scoring:
    """Make masks and head crops of every frame. Masks too large for the memory are in an unnamed file in `scratch`.

    With the cut `plane`, a pixel keeps its matte if it is above the neck cut and not far beside the neck, or inside the
    projected head, because a lowered chin is below the cut. Parts that are then not connected to the head are removed.
    With the cut `line`, a pixel keeps its matte if it is above the projected neck line, and nothing else counts. With
    `none`, all of the matte that is connected to the head stays.
    """
    masks = PictureStack(capture.mattes.shape, scratch)
    crops = np.zeros((*capture.mattes.shape[:2], 4), np.int64)
    neck = NeckParts.of(face_model)
    for timestep in track_progress(range(capture.timesteps), "Scoring masks", capture.timesteps):
        keep = (line_cutter if cut == "line" else head_cutter)(face_model, neck, tracking.face[timestep])
        for index, camera in enumerate(tracking.cameras):
            matte = np.asarray(capture.mattes[timestep, index])
            mask = keep(matte, camera)
            crops[timestep, index] = head_crop(mask)
            masks.write(timestep, index, connected(matte, mask) if cut == "none" else mask)
    return Scoring(masks.array(), crops, cut)


def line_cutter(
    face_model: FaceModel, neck: NeckParts, face: FaceParams
) -> Callable[[UInt8[np.ndarray, "h w"], Camera], UInt8[np.ndarray, "h w"]]:
    """As `head_cutter`, but a mask is the matte above the projected neck line, with a soft border."""
    bottom, T_world_head = face_model(face)[0, neck.base], face.T_world_head[0]

    def above_line(matte: UInt8[np.ndarray, "h w"], camera: Camera) -> UInt8[np.ndarray, "h w"]:
        a, b, d = project_neck_line(bottom, T_world_head, camera).double().numpy()
        x, y = np.arange(matte.shape[1])[None] + 0.5, np.arange(matte.shape[0])[:, None] + 0.5
        return np.round(matte * np.clip(a * x + b * y + d + 0.5, 0, 1)).astype(np.uint8)

    return above_line


def head_cutter(
    face_model: FaceModel, neck: NeckParts, face: FaceParams
) -> Callable[[UInt8[np.ndarray, "h w"], Camera], UInt8[np.ndarray, "h w"]]:
    """A function that turns a camera's matte into the mask of the head, for one timestep (`make_scoring`)."""
    vertices = face_model(face)[0]
    head_faces = face_model.faces[~face_model.region_mask("neck", "bust")]
    cut = fit_neck_cut(neck, vertices, face.T_world_head[0, :3, 1])

    return lambda matte, camera: head_mask(matte, camera, vertices, head_faces, cut)


def head_mask(
    matte: UInt8[np.ndarray, "h w"],
    camera: Camera,
    vertices: Float[Tensor, "v 3"],
    head_faces: Int[Tensor, "f 3"],
    cut: NeckCut,
) -> UInt8[np.ndarray, "h w"]:
    """The mask of the head in a matte (255 is person), from the posed mesh and its triangles without the neck's."""
    head = rasterize_mesh(vertices, head_faces, camera).face_index.numpy() >= 0
    return cut_matte(matte, head, above_neck_cut(cut, camera))


def cut_matte(
    matte: UInt8[np.ndarray, "h w"], head: Bool[np.ndarray, "h w"], keep: Float[np.ndarray, "h w"]
) -> UInt8[np.ndarray, "h w"]:
    """The matte times `keep` (0..1), but whole inside the head, and without parts that do not touch the head."""
    columns = np.flatnonzero(head.any(0))
    margin = round(_SILHOUETTE_MARGIN * (columns[-1] - columns[0] + 1)) if len(columns) else 0
    if margin:
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * margin + 1, 2 * margin + 1))
        head = cv2.dilate(head.astype(np.uint8), disc).astype(bool)
    mask = np.round(matte * np.where(head, np.float32(1), keep)).astype(np.uint8)
    return connected(mask, head)


def connected(mask: UInt8[np.ndarray, "h w"], head: np.ndarray) -> UInt8[np.ndarray, "h w"]:
    """The mask without parts that do not touch the head."""
    _, labels = cv2.connectedComponents((mask >= _FAINT).astype(np.uint8))
    ours = np.unique(labels[(head > 0) & (labels > 0)])
    return np.where((labels == 0) | np.isin(labels, ours), mask, 0).astype(np.uint8)


def head_crop(mask: UInt8[np.ndarray, "h w"]) -> Int[np.ndarray, " 4"]:
    """Left, top, width and height of the box of the mask; the whole picture if the mask is empty."""
    seen = mask >= _FAINT
    rows, columns = np.flatnonzero(seen.any(1)), np.flatnonzero(seen.any(0))
    if len(rows) == 0:
        return np.array([0, 0, mask.shape[1], mask.shape[0]])
    return np.array([columns[0], rows[0], columns[-1] - columns[0] + 1, rows[-1] - rows[0] + 1])
