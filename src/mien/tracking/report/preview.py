"""Preview of a running fit: a page, with a picture beside it, which is written again every few seconds."""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int, UInt8

from mien.capture.capture import Capture
from mien.disk.files import write_atomically
from mien.face.model import FaceModel
from mien.media.picture_files import encode_picture
from mien.media.pictures import data_uri
from mien.pages.pages import render
from mien.tracking.fitting.fit import Fit, SequenceFit
from mien.tracking.fitting.shot import Shot
from mien.tracking.landmarks.model import LandmarkModel
from mien.tracking.landmarks.outcome import as_tracking
from mien.tracking.pixels.comparison import model_pictures
from mien.tracking.pixels.outcome import appearance_of
from mien.tracking.pixels.texture import PhotometricFit
from mien.tracking.report.contact_sheet import SheetFrame, strip
from mien.tracking.report.heat import write_text
from mien.tracking.report.overlay import OverlayPainter, frontal_camera
from mien.tracking.settings import TrackingSettings
from mien.tracking.tracking import Tracking

DONE = "done"
INTERVAL_SECONDS = 3.0
"""Least time between two pictures."""
MAX_SHARE = 0.1
"""Largest share of the time that the preview may take."""
_CURVE_FRAMES, _STRIPS = 48, 3
"""Number of frames, over all sequences, with residuals in the curves, and number of frames shown as pictures."""
_MAX_BYTES = 64 << 20
"""Largest size of the pictures that the preview keeps in memory, in bytes."""
_WIDTH, _HEADER, _CURVE = 960, 48, 150
_PANELS = (("picture", False), ("mesh", False), ("model", False), ("difference", True))
"""Panels of a strip, each with whether a legend is in its upper corner."""
_INK, _PAPER, _FAINT = (40, 40, 40), 250, (190, 190, 190)
_COLORS = ((30, 90, 200), (200, 60, 30))
"""Colours of the two curves: landmarks, then colours."""


class Preview:
    """A `Watch` that draws some frames and the residuals of a fit every few seconds. Mutable."""

    def __init__(
        self,
        path: Path,
        face_model: FaceModel,
        model: LandmarkModel,
        shots: Sequence[Shot],
        settings: TrackingSettings,
    ) -> None:
        self._path, self._face_model, self._model, self._settings = path, face_model, model, settings
        size = sum(shot.capture.images[0].nbytes for shot in shots) // len(shots)
        count = max(min(_CURVE_FRAMES, _MAX_BYTES // size) // len(shots), 1)
        self._samples = [_Sample(shot, count) for shot in shots]
        self._began, self._due = time.monotonic(), 0.0
        self._current: Callable[[], object] | None = None
        self._body: UInt8[np.ndarray, "h w 3"] | None = None
        self._before: list[Float[np.ndarray, " n"]] = []

    def __call__(self, stage: str, progress: float, current: Callable[[], object] | None = None) -> None:
        """Write the page, unless it was written a moment ago. The end is always shown."""
        self._current = current or self._current
        start = time.monotonic()
        if start < self._due and stage != DONE:
            return
        if self._current is not None:
            with torch.no_grad():
                self._body, self._current = self.draw(self._current()), None
        self.write(self.with_header(stage, progress), last=stage == DONE)
        now = time.monotonic()
        self._due = now + max(INTERVAL_SECONDS, (now - start) / MAX_SHARE)

    def draw(self, fit: object) -> UInt8[np.ndarray, "h w 3"]:
        """Draw a fit of any stage: its mesh over frames, and curves."""
        assert isinstance(fit, Fit | PhotometricFit)
        refined = fit if isinstance(fit, PhotometricFit) else None
        own_fit = fit if isinstance(fit, Fit) else fit.fit
        strips, landmarks, colors, labels = [], [], [], []
        per_sequence = max(_STRIPS // len(self._samples), 1)
        for index, (sample, own) in enumerate(zip(self._samples, own_fit.sequences, strict=True)):
            part = SequenceFit(own.cameras, own.state[sample.rows])
            tracking = as_tracking(
                sample.shot, self._face_model, self._model, own_fit.subject, part, self._settings
            )  # fmt: skip
            if refined is not None and (refined.texture.trust > 0).any():
                tracking = replace(tracking, appearance=appearance_of(refined, index, sample.shot, self._settings))
            capture = sample.shot.capture
            landmarks.append(tracking.residuals.nanmedian(1).values.numpy())
            colors.append(_color_residuals(capture, tracking, self._face_model))
            labels += [str(timestep) for timestep in sample.timesteps]
            if len(strips) < _STRIPS:
                strips += _strips(capture, tracking, self._face_model, sample, per_sequence)
        curves = [np.concatenate(landmarks), 100 * np.concatenate(colors)]
        _head(strips[0])
        parts = [*strips, _plot(curves, self._before, labels)]
        self._before = curves
        return np.concatenate([_widen(part) for part in parts])

    def with_header(self, stage: str, progress: float) -> UInt8[np.ndarray, "h w 3"]:
        """The drawn fit below a line with stage, progress and time."""
        header = np.full((_HEADER, _WIDTH, 3), 40, np.uint8)
        names = ", ".join(sample.shot.capture.name for sample in self._samples)
        seconds = time.monotonic() - self._began
        text = f"{names}: {stage}, {100 * progress:.0f} %, {seconds:.0f} s, at {time.strftime('%H:%M:%S')}"
        _text(header, text, (10, 20), (255, 255, 255))
        header[32:38, 10:950] = 90
        header[32:38, 10 : 10 + round(940 * min(max(progress, 0.0), 1.0))] = (90, 200, 120)
        return header if self._body is None else np.concatenate([header, self._body])

    def write(self, picture: UInt8[np.ndarray, "h w 3"], last: bool) -> None:
        """Write picture and page. The last page is not renewed."""
        png = encode_picture(picture)
        page = render(
            "tracking/report/templates/preview.html",
            refresh=None if last else f"{INTERVAL_SECONDS:.0f}",
            picture=data_uri("image/png", png),
        )
        write_atomically(self._path.with_suffix(".png"), lambda path: path.write_bytes(png))
        write_atomically(self._path, lambda path: path.write_text(page, encoding="utf-8"))


class _Sample:
    """Some timesteps of a sequence as a sequence of their own. Immutable."""

    def __init__(self, shot: Shot, count: int) -> None:
        valid = shot.valid.nonzero()[:, 0]
        self.rows: Int[torch.Tensor, " k"] = torch.linspace(0, len(valid) - 1, min(count, len(valid))).round().long()
        self.timesteps: list[int] = valid[self.rows].tolist()
        whole, chosen = shot.capture, self.timesteps
        capture = replace(
            whole, timestamps=whole.timestamps[chosen], images=np.asarray(whole.images[chosen]),
            mattes=np.asarray(whole.mattes[chosen]), landmarks=whole.landmarks[chosen], valid=whole.valid[chosen],
            quality=None,
        )  # fmt: skip
        all_valid = torch.ones(len(chosen), dtype=torch.bool)
        self.shot = replace(shot, views=shot.views.at(self.rows), valid=all_valid, capture=capture)


def _strips(
    capture: Capture, tracking: Tracking, face_model: FaceModel, sample: _Sample, count: int
) -> list[UInt8[np.ndarray, "h w 3"]]:
    painter, camera = OverlayPainter(capture, tracking, face_model), frontal_camera(tracking)
    chosen = torch.linspace(0, len(sample.timesteps) - 1, count + 2)[1:-1].round().long().unique().tolist()
    return [strip(painter, capture, SheetFrame(one, camera), str(sample.timesteps[one])) for one in chosen]


def _head(first: UInt8[np.ndarray, "h w 3"]) -> None:
    """Write the names of the panels on the first strip."""
    tile = len(first)
    for index in range(1, first.shape[1] // tile):
        name, legend = _PANELS[index]
        write_text(first, name, (index * tile + 6, tile - 8 if legend else 16), 0.45)


def _color_residuals(capture: Capture, tracking: Tracking, face_model: FaceModel) -> Float[np.ndarray, " k"]:
    """Colour residuals in the frontal camera; NaN if the fit has no texture yet."""
    found, pictures = np.full(capture.timesteps, np.nan), model_pictures(capture, tracking, face_model)
    if pictures is not None:
        camera = frontal_camera(tracking)
        for timestep in range(capture.timesteps):
            found[timestep] = pictures.compare(timestep, camera, face_model(tracking.face[timestep])[0]).rms
    return found


def _plot(
    curves: Sequence[Float[np.ndarray, " n"]], before: Sequence[Float[np.ndarray, " n"]], labels: Sequence[str]
) -> UInt8[np.ndarray, "h w 3"]:
    """Plots of the residuals over the frames, one below the other. The previous residuals are grey."""
    names = ("landmarks, median distance in px", "colours, root mean square over the three channels, in %")
    shown = [index for index, values in enumerate(curves) if np.isfinite(values).any()]
    plots = [np.full((1, _WIDTH, 3), _PAPER, np.uint8)]
    for index in shown:
        plot = np.full((_CURVE, _WIDTH, 3), _PAPER, np.uint8)
        old = before[index] if before else np.full_like(curves[index], np.nan)
        top = max(float(np.nanmax(np.concatenate([curves[index], old]))), 1e-6)
        for values, color in ((old, _FAINT), (curves[index], _COLORS[index])):
            x, y = np.linspace(50, _WIDTH - 15, len(values)), _CURVE - 25 - (_CURVE - 50) * values / top
            points = np.stack([x, y], axis=1)[np.isfinite(values)]
            cv2.polylines(plot, [np.round(points).astype(np.int32)], False, color, 1, cv2.LINE_AA)
        title = f"{names[index]}: {np.nanmedian(curves[index]):.2f} over all frames (grey: when last drawn)"
        _text(plot, title, (50, 16), _COLORS[index])
        _text(plot, f"{top:.2f}", (5, 30), _INK)
        _text(plot, "0", (5, _CURVE - 22), _INK)
        for at in np.linspace(0, len(labels) - 1, 6).round().astype(int):
            _text(plot, labels[int(at)], (round(50 + (_WIDTH - 80) * at / max(len(labels) - 1, 1)), _CURVE - 6), _INK)
        plots.append(plot)
    return np.concatenate(plots)


def _text(picture: UInt8[np.ndarray, "h w 3"], text: str, at: tuple[int, int], color: tuple[int, int, int]) -> None:
    cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.45, color, 1, cv2.LINE_AA)


def _widen(picture: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w2 3"]:
    return np.pad(picture, ((0, 0), (0, _WIDTH - picture.shape[1]), (0, 0)), constant_values=_PAPER)
