"""The page report.html of a tracking: findings, figures, and pictures of typical frames and of those that stand out."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mien.capture.capture import Capture
from mien.disk.files import write_atomically, write_json
from mien.face.model import FaceModel
from mien.media.pictures import picture_uri, shrink
from mien.pages.pages import Axes, Series, line_chart, render
from mien.tracking.report.contact_sheet import SheetFrame, name_of, sheet_frames, tiles_of
from mien.tracking.report.overlay import HOTTEST, OverlayPainter, frontal_camera
from mien.tracking.report.residuals import (
    depths,
    iris_distances,
    landmarks_of,
    residual_report,
    seen_rotation,
    timestep_residuals,
)
from mien.tracking.tracking import Tracking

_JPEG_QUALITY = 85
_POSTER = 960  # longer side of the poster of the video, in pixels
_PANELS = ("Picture", "Tracked mesh", "Model", "Difference")
_SOME = 40  # largest number of frames, or runs of frames, that a finding names
_FOCAL_FROM = {
    "calibrated": "as calibrated",
    "given": "as given",
    "assumed": "assumed, because faces hardly determine it (head turns are more exact if --tracking.focal gives it)",
}
_CHECK_ALL = (
    "check that K is in pixels of the whole picture, that viewmat goes from world to camera with OpenCV axes and "
    "metres, the distortion of the lenses, and the offsets"
)
_ALIGNED = (
    "Then every frame was aligned to a quick avatar (`mien align`). Its residuals below are those before the alignment."
)
_BY_PIXELS = "The face was fitted to landmarks, then to pixels (schedule `{}`), which correct the detector's errors."
_WAYS = {
    "landmarks": "The face was fitted to landmarks alone (schedule `landmarks`). Pixels were not used.",
    "fast": _BY_PIXELS.format("fast"),
    "paper": _BY_PIXELS.format("paper"),
}


def write_residual_report(folder: Path, capture: Capture, tracking: Tracking, face_model: FaceModel) -> str:
    """Write residuals.json and report.html (complete but for the video) into `folder`. Return the findings as text."""
    report = residual_report(capture, tracking, face_model)
    write_json(folder / "residuals.json", "mien.residual_report", 1, report)
    painter = OverlayPainter(capture, tracking, face_model)
    frames = sheet_frames(tracking, report["flagged_frames"], report["landmarks_only_frames"])
    rows = [panels_of(painter, capture, frame, name_of(capture, frame)) for frame in frames]
    middle = next((frame for frame in frames if not frame.why), frames[0])
    poster = picture_uri(shrink(painter.picture(middle.timestep, middle.camera), _POSTER), _JPEG_QUALITY)
    text = render(
        "tracking/report/templates/report.html",
        name=capture.name,
        poster=poster,
        findings=findings(tracking, report),
        report=report,
        number=_number,
        focal_from=_FOCAL_FROM[report["focal_from"]],
        rows=rows,
        hottest=f"{100 * HOTTEST:.0f} %",
        charts=_charts(capture, tracking, face_model, report),
    )
    write_atomically(folder / "report.html", lambda path: path.write_text(text, encoding="utf-8"))
    return " ".join(text for _, text in findings(tracking, report))


def panels_of(painter: OverlayPainter, capture: Capture, frame: SheetFrame, name: str) -> dict[str, Any]:
    """A frame's panels for the pages, which templates/frames.html shows."""
    pictures = [
        {"what": f"{name}: {panel.lower()}", "source": picture_uri(tile, _JPEG_QUALITY)}
        for panel, tile in zip(_PANELS, tiles_of(painter, capture, frame), strict=False)
    ]
    panels = ", ".join(_PANELS[: len(pictures)]).lower()
    return {"name": name, "odd": bool(frame.why), "pictures": pictures, "panels": panels}


def _charts(
    capture: Capture, tracking: Tracking, face_model: FaceModel, report: dict[str, Any]
) -> list[dict[str, Any]]:
    """What changes over time. Flagged timesteps are dots; those without a face are shaded."""
    t, odd, frontal = np.asarray(capture.timestamps, np.float64), report["flagged_frames"], frontal_camera(tracking)
    detected = torch.from_numpy(np.asarray(capture.landmarks[:, frontal], dtype=np.float32))
    depth = tracking.cameras[frontal].project(landmarks_of(face_model, tracking))[1]
    drawn: list[tuple[str, str, list[Series]]] = []

    def add(title: str, unit: str, curves: dict[str, torch.Tensor], flagged: bool = False) -> None:
        values = {name: curve.double().numpy() for name, curve in curves.items()}
        styles = ("main", "second", "third")
        series = [Series(name, t, curve, style) for (name, curve), style in zip(values.items(), styles, strict=False)]
        series += [Series("flagged", t[odd], curve[odd], "second", points=True) for curve in values.values() if flagged]
        drawn.append((title, unit, series))

    residuals = timestep_residuals(tracking)
    add("Distance of landmarks from the detected ones, pixels", "pixels", {"landmarks": residuals}, flagged=True)
    if tracking.pixel_residuals is not None:
        colors = 100 * tracking.pixel_residuals.nanmedian(1).values.double()
        add("Difference of colours, %", "%", {"colours": colors}, flagged=True)
    turns = seen_rotation(tracking, frontal).rad2deg().unbind(1)
    add("Rotation of the head, degrees", "degrees", dict(zip(("pitch", "yaw", "roll"), turns, strict=True)))
    add("Distance from the camera, m", "m", {"distance": depths(tracking, frontal)})
    iris = 1e3 * iris_distances(tracking, detected, depth, frontal).double()
    add("Distance of the irises, mm", "mm", {"irises": iris})
    spans = tuple((float(t[one]), float(t[min(one + 1, len(t) - 1)])) for one in report["frames_without_face"])
    return [
        {"title": title, "chart": line_chart(series, Axes("time, s", unit, 520, 200, shaded=spans))}
        for title, unit, series in drawn
    ]


def findings(tracking: Tracking, report: dict[str, Any]) -> list[tuple[str, str]]:
    """The main findings as pairs of class and text. The class is `odd` if the finding is a reason to look closer."""
    schedule = str(tracking.settings.get("schedule", "landmarks"))
    with_face = report["frames"] - len(report["frames_without_face"])
    found = [("", _WAYS.get(schedule, f"The schedule was `{schedule}`."))]
    if schedule != "landmarks":
        alone = report["landmarks_only_frames"]
        if tracking.appearance is None:
            found = [("odd", f"The pictures show no part of the texture of {tracking.face_model} (schedule "
                             f"`{schedule}`), so landmarks alone determined all frames.")]  # fmt: skip
        elif alone:
            found.append(("odd", f"Pixels did not improve {len(alone)} of {with_face} frames with a face, so landmarks "
                                 f"alone determined them: {name_runs(alone)}."))  # fmt: skip
        else:
            found.append(("", f"Pixels were used in all {with_face} frames with a face."))
    if tracking.aligned:
        found.append(("", _ALIGNED))
    for part, covered in report["covered_frames"].items():
        are = "are" if part == "eyes" else "is"
        found.append(("odd", f"Something (a hand?) covers the {part} in {len(covered)} of {with_face} frames with a "
                             f"face, and training leaves them out: {name_runs(covered)}. There the expression of the "
                             f"{part} is a guess; if the {part} {are} covered for long, film again."))  # fmt: skip
    for name, row in report["cameras"].items():
        if "others_misplaced_px" in row:
            found.append(("odd", f"Warning: camera {name} shows the face {row['misplaced_px']:.0f} px from where the "
                                 f"tracked head is (the other cameras: {row['others_misplaced_px']:.1f} px); check its "
                                 "K, viewmat, id and offset in the calibration."))  # fmt: skip
    misfit = report["shared_misfit"]
    if misfit is not None:
        found.append(("odd", f"Warning: all cameras together see landmarks {misfit['residual_px']:.1f} px "
                             f"({100 * misfit['residual_share']:.1f} % of the face) from the tracked head, so the "
                             "calibration as a whole does not fit; "
                             f"{misfit['advice'] or _CHECK_ALL}; then capture and track again."))  # fmt: skip
    if report["flagged_frames"]:
        flagged = report["flagged_frames"]
        stand_out = "1 frame stands" if len(flagged) == 1 else f"{len(flagged)} frames stand"
        found.append(("odd", f"{stand_out} out and should be checked: {name_runs(flagged)}."))
    elif misfit is not None:
        found.append(("odd", "No frame stands out from the others, because all of them fit badly."))
    else:
        found.append(("", "No frame stands out."))
    if report["frames_without_face"]:
        found.append(("odd", f"No face was found in frames {name_runs(report['frames_without_face'])}. Their motion is "
                             "interpolated."))  # fmt: skip
    return found


def name_runs(timesteps: Sequence[int]) -> str:
    """Numbers of frames as text, with runs abbreviated: 3, 7-9, 12."""
    runs: list[list[int]] = []
    for timestep in timesteps:
        if runs and timestep == runs[-1][1] + 1:
            runs[-1][1] = timestep
        else:
            runs.append([timestep, timestep])
    parts = [str(first) if first == last else f"{first}-{last}" for first, last in runs]
    return ", ".join(parts[:_SOME]) + (", ..." if len(parts) > _SOME else "")


def _number(value: float | None, factor: int, unit: str) -> str:
    return "-" if value is None else f"{factor * value:.2f} {unit}"
