"""Contact sheets of a tracking: of its report, with frames that stand out, and of few frames, after an import."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8

from mien.capture.capture import Capture
from mien.face.model import FaceModel
from mien.media.picture_files import write_png
from mien.tracking.report.heat import draw_legend, write_text
from mien.tracking.report.overlay import OverlayPainter, frontal_camera
from mien.tracking.tracking import Tracking

_EVEN, _MAX_FLAGGED, _MAX_ALONE = 8, 8, 4
"""Largest numbers of evenly spread frames, of flagged frames, and of frames tracked from landmarks alone."""
_FEW = 6
"""Largest number of pictures of an overlay sheet."""
_TILE = 240
"""Side of each tile, in pixels."""


@dataclass(frozen=True)
class SheetFrame:
    """One frame on a contact sheet."""

    timestep: int
    camera: int
    why: str = ""
    """Why the frame stands out; empty for an evenly spread frame."""


@dataclass(frozen=True, eq=False)
class SheetRow:
    """A frame of the contact sheet with its panels, which are square and of one size."""

    name: str
    odd: bool
    """Whether the frame stands out."""
    tiles: Sequence[UInt8[np.ndarray, "h w 3"]]


def sheet_frames(tracking: Tracking, flagged: Sequence[int], alone: Sequence[int]) -> list[SheetFrame]:
    """The frames to show, in the order of time: evenly spread ones from the frontal camera, and ones that stand out.

    Args:
        tracking: The tracking. At least one of its frames has a face.
        flagged: Timesteps that stand out. Those with the largest residuals are shown, each from its worst camera.
        alone: Timesteps tracked from landmarks alone. If they are half of those with a face or more, none is shown.
    """
    frontal, valid = frontal_camera(tracking), tracking.valid.nonzero()[:, 0]
    even = valid[torch.linspace(0, len(valid) - 1, min(_EVEN, len(valid))).round().long()].tolist()
    chosen = {timestep: SheetFrame(timestep, frontal) for timestep in even}
    if 2 * len(alone) < len(valid):
        for timestep in alone[:: max(len(alone) // _MAX_ALONE, 1)][:_MAX_ALONE]:
            chosen[timestep] = SheetFrame(timestep, _camera_of_face(tracking.residuals[timestep]), "landmarks only")
    worst = tracking.residuals if tracking.pixel_residuals is None else tracking.pixel_residuals
    size = worst.nan_to_num(-1).amax(1)
    for timestep in worst_of_runs(flagged, size.numpy())[:_MAX_FLAGGED]:
        chosen[timestep] = SheetFrame(timestep, int(worst[timestep].nan_to_num(-1).argmax()), "flagged")
    return [chosen[timestep] for timestep in sorted(chosen)]


def worst_of_runs(timesteps: Sequence[int], values: Float[np.ndarray, " t"]) -> list[int]:
    """The timestep with the largest value of each run of neighbouring timesteps, the worst first."""
    known = np.nan_to_num(values, nan=-np.inf)
    runs = np.split(np.array(timesteps, dtype=np.int64), np.nonzero(np.diff(timesteps) > 1)[0] + 1)
    worst = [int(run[known[run].argmax()]) for run in runs if len(run)]
    return sorted(worst, key=lambda one: -known[one])


def sheet_rows(
    capture: Capture, tracking: Tracking, face_model: FaceModel, frames: Sequence[SheetFrame]
) -> list[SheetRow]:
    """The pictures of each frame: all panels, cut to the head."""
    painter = OverlayPainter(capture, tracking, face_model)
    return [SheetRow(_name(capture, frame), bool(frame.why), _tiles(painter, capture, frame)) for frame in frames]


def write_overlay_sheet(path: Path, capture: Capture, tracking: Tracking, face_model: FaceModel) -> None:
    """Write at most six pictures in a row, cut to the head, with the mesh over the same pictures below them.

    Timesteps are evenly spread, and so are cameras, beginning with the frontal one. They are few, so an
    import writes it for every sequence.
    """
    painter, cameras = OverlayPainter(capture, tracking, face_model), len(tracking.cameras)
    valid, frontal = tracking.valid.nonzero()[:, 0], frontal_camera(tracking)
    count = min(_FEW, max(len(valid), cameras))
    columns = []
    for index, place in enumerate(torch.linspace(0, len(valid) - 1, count).round().long()):
        frame = SheetFrame(int(valid[place]), (frontal + index * cameras // count) % cameras)
        tiles = _tiles(painter, capture, frame)[:2]
        write_text(tiles[0], _name(capture, frame), (6, 16), 0.45)
        columns.append(np.concatenate(tiles, axis=0))
    write_png(path, np.concatenate(columns, axis=1))


def _name(capture: Capture, frame: SheetFrame) -> str:
    camera = "" if len(capture.camera_ids) == 1 else f", camera {capture.camera_ids[frame.camera]}"
    return f"Frame {frame.timestep}{camera}{', ' * bool(frame.why)}{frame.why}"


def strip(painter: OverlayPainter, capture: Capture, frame: SheetFrame, name: str) -> UInt8[np.ndarray, "h w 3"]:
    """A frame's picture and the mesh over it. If pixels were compared, also the model's picture and the heat map."""
    tiles = _tiles(painter, capture, frame)
    write_text(tiles[0], name, (6, 16), 0.45)
    if len(tiles) > 2:
        draw_legend(tiles[-1], 8)
    return np.concatenate(tiles, axis=1)


def _tiles(painter: OverlayPainter, capture: Capture, frame: SheetFrame) -> list[UInt8[np.ndarray, "h w 3"]]:
    image = np.asarray(capture.images[frame.timestep, frame.camera])
    rows, columns = painter.head_box(frame.timestep, frame.camera)
    panels = [image, *painter.panels(frame.timestep, frame.camera)[1:]]
    return [cv2.resize(panel[rows, columns], (_TILE, _TILE), interpolation=cv2.INTER_AREA) for panel in panels]


def _camera_of_face(residuals: Float[torch.Tensor, " c"]) -> int:
    """The first camera that found a face; the first of all if none did."""
    return int(residuals.isfinite().int().argmax())
