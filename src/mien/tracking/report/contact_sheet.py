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
from mien.tracking.report.overlay import OverlayPainter, frontal_camera, write_text
from mien.tracking.tracking import Tracking

_EVEN, _MAX_FLAGGED, _MAX_ALONE = 8, 8, 4  # of evenly spread and flagged frames, and of those from landmarks alone
_TILE = 240  # side of each tile, in pixels


@dataclass(frozen=True)
class SheetFrame:
    """One frame on a contact sheet, and why it stands out; empty for an evenly spread frame."""

    timestep: int
    camera: int
    why: str = ""


def sheet_frames(tracking: Tracking, flagged: Sequence[int], alone: Sequence[int]) -> list[SheetFrame]:
    """The frames to show, in the order of time: evenly spread ones from the frontal camera, and ones that stand out.

    Of `flagged` timesteps, those with the largest residuals are shown, each from its worst camera. Of those tracked
    from landmarks `alone`, none is shown if they are half of those with a face or more.
    """
    frontal, valid = frontal_camera(tracking), tracking.valid.nonzero()[:, 0]
    even = valid[torch.linspace(0, len(valid) - 1, min(_EVEN, len(valid))).round().long()].tolist()
    chosen = {timestep: SheetFrame(timestep, frontal) for timestep in even}
    if 2 * len(alone) < len(valid):
        for timestep in alone[:: max(len(alone) // _MAX_ALONE, 1)][:_MAX_ALONE]:
            camera = int(tracking.residuals[timestep].isfinite().int().argmax())  # the first that found a face
            chosen[timestep] = SheetFrame(timestep, camera, "landmarks only")
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


def write_overlay_sheet(path: Path, capture: Capture, tracking: Tracking, face_model: FaceModel) -> None:
    """Write at most six pictures in a row, cut to the head, with the mesh over the same pictures below them.

    Timesteps and cameras are evenly spread, beginning with the frontal camera.
    """
    painter, cameras = OverlayPainter(capture, tracking, face_model), len(tracking.cameras)
    valid, frontal = tracking.valid.nonzero()[:, 0], frontal_camera(tracking)
    count = min(6, max(len(valid), cameras))
    columns = []
    for index, place in enumerate(torch.linspace(0, len(valid) - 1, count).round().long()):
        frame = SheetFrame(int(valid[place]), (frontal + index * cameras // count) % cameras)
        tiles = tiles_of(painter, capture, frame)[:2]
        write_text(tiles[0], name_of(capture, frame), (6, 16), 0.45)
        columns.append(np.concatenate(tiles, axis=0))
    write_png(path, np.concatenate(columns, axis=1))


def name_of(capture: Capture, frame: SheetFrame) -> str:
    """The caption of a frame."""
    camera = "" if len(capture.camera_ids) == 1 else f", camera {capture.camera_ids[frame.camera]}"
    return f"Frame {frame.timestep}{camera}{', ' * bool(frame.why)}{frame.why}"


def tiles_of(painter: OverlayPainter, capture: Capture, frame: SheetFrame) -> list[UInt8[np.ndarray, "h w 3"]]:
    """The panels of a frame cut to the head, square and of one size, but with the plain picture as the first."""
    image = np.asarray(capture.images[frame.timestep, frame.camera])
    rows, columns = painter.head_box(frame.timestep, frame.camera)
    panels = [image, *painter.panels(frame.timestep, frame.camera)[1:]]
    return [cv2.resize(panel[rows, columns], (_TILE, _TILE), interpolation=cv2.INTER_AREA) for panel in panels]
