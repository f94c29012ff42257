"""Preview of a running fit: a page that is written again every few seconds."""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int

from mien.capture.capture import Capture
from mien.disk.files import write_atomically
from mien.face.model import FaceModel
from mien.pages.pages import Axes, Series, line_chart, render
from mien.tracking.fitting.fit import Fit, SequenceFit
from mien.tracking.fitting.sequence import SequenceData
from mien.tracking.landmarks.outcome import as_tracking
from mien.tracking.landmarks.problem import Problem
from mien.tracking.pixels.outcome import appearance_in_world, model_pictures
from mien.tracking.pixels.texture import PhotometricFit
from mien.tracking.report.contact_sheet import SheetFrame
from mien.tracking.report.overlay import OverlayPainter, frontal_camera
from mien.tracking.report.page import panels_of
from mien.tracking.tracking import Tracking

DONE = "done"
INTERVAL_SECONDS = 3.0
"""Least time between two pages."""
MAX_SHARE = 0.1
"""Largest share of the time that the preview may take."""
_CURVE_FRAMES, _SHOWN = 48, 4
"""Number of frames, over all sequences, with residuals in the curves, and number of frames shown as pictures."""
_MAX_BYTES = 64 << 20  # largest size of the pictures that the preview keeps in memory
_CURVES = (
    ("landmarks", "Distance of landmarks, pixels", "pixels", "main"),
    ("colours", "Root mean square difference of colours over the three channels, %", "%", "second"),
)


class Preview:
    """A `Callback` that shows some frames and the residuals of a fit every few seconds. Mutable."""

    def __init__(self, path: Path, face_model: FaceModel, problem: Problem) -> None:
        self._path, self._face_model, self._problem = path, face_model, problem
        size = sum(data.capture.images[0].nbytes for data in problem.data) // len(problem.data)
        count = max(min(_CURVE_FRAMES, _MAX_BYTES // size) // len(problem.data), 1)
        self._samples = [_Sample(data, count) for data in problem.data]
        self._began, self._due = time.monotonic(), 0.0
        self._current: Callable[[], object] | None = None
        self._rows: list[dict[str, Any]] = []
        self._charts: list[dict[str, Any]] = []
        self._before: list[Float[np.ndarray, " n"]] = []

    def __call__(self, stage: str, progress: float, current: Callable[[], object] | None = None) -> None:
        """Write the page, unless it was written a moment ago. The end is always shown."""
        self._current = current or self._current
        start = time.monotonic()
        if start < self._due and stage != DONE:
            return
        if self._current is not None:
            with torch.no_grad():
                self.draw(self._current())
            self._current = None
        self.write(stage, progress)
        now = time.monotonic()
        self._due = now + max(INTERVAL_SECONDS, (now - start) / MAX_SHARE)

    def draw(self, fit: object) -> None:
        """Draw a fit of any stage: its mesh over frames, and curves."""
        assert isinstance(fit, Fit | PhotometricFit)
        refined, own_fit = (fit, fit.fit) if isinstance(fit, PhotometricFit) else (None, fit)
        rows, landmarks, colors = [], [], []
        per_sequence = max(_SHOWN // len(self._samples), 1)
        for index, (sample, own) in enumerate(zip(self._samples, own_fit.sequences, strict=True)):
            part = SequenceFit(own.cameras, own.state[sample.rows])
            tracking = as_tracking(self._problem, self._face_model, sample.data, own_fit.subject, part)
            if refined is not None and (refined.texture.trust > 0).any():
                T_world_fit = sample.data.T_world_fit
                seen = appearance_in_world(refined.texture, refined.lights[index], T_world_fit)
                tracking = replace(tracking, appearance=seen)
            capture = sample.data.capture
            landmarks.append(tracking.residuals.nanmedian(1).values.numpy())
            colors.append(_color_residuals(capture, tracking, self._face_model))
            if len(rows) < _SHOWN:
                rows += _rows(capture, tracking, self._face_model, sample, per_sequence)
        self._rows = rows
        curves = [np.concatenate(landmarks), 100 * np.concatenate(colors)]
        self._charts = [
            self._chart(values, before, *about)
            for values, before, about in zip(curves, self._before or curves, _CURVES, strict=True)
            if np.isfinite(values).any()
        ]
        self._before = curves

    def _chart(self, values: Float[np.ndarray, " n"], before: Float[np.ndarray, " n"], *about: str) -> dict[str, Any]:
        name, title, unit, style = about
        lengths = [len(sample.data.capture.timestamps) for sample in self._samples]
        starts = np.cumsum([0, *(sample.frames for sample in self._samples[:-1])])
        x = np.concatenate([sample.timesteps for sample in self._samples]) + np.repeat(starts, lengths)
        series = [Series("when last drawn", x, before, "quiet"), Series(name, x, values, style)]
        chart = line_chart(series, Axes("frame, all sequences in a row", unit, 520, 200, from_zero=True))
        return {"title": f"{title}: {np.nanmedian(values):.2f} over all frames", "chart": chart}

    def write(self, stage: str, progress: float) -> None:
        """Write the page. The last one is not renewed."""
        page = render(
            "tracking/report/templates/preview.html",
            name=", ".join(sample.data.capture.name for sample in self._samples),
            stage=stage,
            done=f"{100 * progress:.0f} %",
            seconds=f"{time.monotonic() - self._began:.0f} s",
            clock=time.strftime("%H:%M:%S"),
            refresh=None if stage == DONE else f"{INTERVAL_SECONDS:.0f}",
            rows=self._rows,
            charts=self._charts,
        )
        write_atomically(self._path, lambda path: path.write_text(page, encoding="utf-8"))


class _Sample:
    """Some timesteps of a sequence as a sequence of their own. Immutable."""

    def __init__(self, data: SequenceData, count: int) -> None:
        self.frames, faces = len(data.valid), len(data.timesteps)
        self.rows: Int[torch.Tensor, " k"] = torch.linspace(0, faces - 1, min(count, faces)).round().long()
        self.timesteps: list[int] = data.timesteps[self.rows].tolist()
        whole, chosen = data.capture, self.timesteps
        capture = replace(
            whole, timestamps=whole.timestamps[chosen], images=np.asarray(whole.images[chosen]),
            mattes=np.asarray(whole.mattes[chosen]), landmarks=whole.landmarks[chosen], valid=whole.valid[chosen],
            quality=None,
        )  # fmt: skip
        all_valid = torch.ones(len(chosen), dtype=torch.bool)
        self.data = replace(data, views=data.views.at(self.rows), valid=all_valid, capture=capture)


def _rows(
    capture: Capture, tracking: Tracking, face_model: FaceModel, sample: _Sample, count: int
) -> list[dict[str, Any]]:
    painter, camera = OverlayPainter(capture, tracking, face_model), frontal_camera(tracking)
    chosen = torch.linspace(0, len(sample.timesteps) - 1, count + 2)[1:-1].round().long().unique().tolist()
    return [panels_of(painter, capture, SheetFrame(one, camera), f"Frame {sample.timesteps[one]}") for one in chosen]


def _color_residuals(capture: Capture, tracking: Tracking, face_model: FaceModel) -> Float[np.ndarray, " k"]:
    """Colour residuals in the frontal camera; NaN if the fit has no texture yet."""
    residuals, pictures = np.full(capture.timesteps, np.nan), model_pictures(capture, tracking, face_model)
    if pictures is not None:
        camera = frontal_camera(tracking)
        for timestep in range(capture.timesteps):
            residuals[timestep] = pictures.compare(timestep, camera, face_model(tracking.face[timestep])[0]).rms
    return residuals
