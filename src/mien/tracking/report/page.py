"""The page report.html of a tracking: findings, figures, and pictures of typical frames and of those that stand out."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mien.capture.capture import Capture
from mien.disk.files import write_atomically
from mien.face.model import FaceModel
from mien.media.pictures import picture_uri, shrink
from mien.pages.pages import render
from mien.tracking.report.contact_sheet import SheetRow, sheet_frames, sheet_rows
from mien.tracking.report.curves import Curves, charts
from mien.tracking.report.heat import HOTTEST
from mien.tracking.report.overlay import OverlayPainter
from mien.tracking.tracking import Tracking

_JPEG_QUALITY = 85
_POSTER = 960
"""Longer side of the poster of the video, in pixels."""
_PANELS = ("Picture", "Tracked mesh", "Model", "Difference")
_SOME = 40
"""Largest number of frames, or runs of frames, that a finding names."""
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


def write_report_page(
    folder: Path, capture: Capture, tracking: Tracking, face_model: FaceModel, report: dict[str, Any], curves: Curves
) -> None:
    """Write report.html into `folder`. Except for the overlay video, the page is complete in one file.

    Args:
        folder: Folder of the tracking.
        capture: The capture.
        tracking: The tracking of the capture.
        face_model: The face model of the tracking.
        report: The result of `residual_report`.
        curves: What is drawn over time.
    """
    frames = sheet_frames(tracking, report["flagged_frames"], report["landmarks_only_frames"])
    rows = [_shown(row) for row in sheet_rows(capture, tracking, face_model, frames)]
    middle = next((frame for frame in frames if not frame.why), frames[0])
    painter = OverlayPainter(capture, tracking, face_model)
    poster = picture_uri(shrink(painter.picture(middle.timestep, middle.camera), _POSTER), _JPEG_QUALITY)
    text = render(
        "tracking/report/templates/report.html",
        name=capture.name,
        poster=poster,
        findings=findings(tracking, report),
        tiles=_tiles(report),
        figures=_figures(report),
        panels=_PANELS[: len(rows[0]["pictures"])],
        rows=rows,
        hottest=f"{100 * HOTTEST:.0f} %",
        charts=charts(curves),
    )
    write_atomically(folder / "report.html", lambda path: path.write_text(text, encoding="utf-8"))


def _shown(row: SheetRow) -> dict[str, Any]:
    pictures = [
        {"what": f"{row.name}: {panel.lower()}", "source": picture_uri(tile, _JPEG_QUALITY)}
        for panel, tile in zip(_PANELS, row.tiles, strict=False)
    ]
    return {"name": row.name, "odd": row.odd, "pictures": pictures}


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


def _tiles(report: dict[str, Any]) -> list[tuple[str, str]]:
    """The few figures to read first, each with its name."""
    colors, flagged = report["residual_colors"], len(report["flagged_frames"])
    tiles = [
        (str(report["frames"]), "frames"),
        (_number(report["residual_px"]["median"], 1, "px"), "landmarks, median"),
    ]
    if colors is not None:
        tiles.append((_number(colors["median"], 100, "%"), "difference of colours, median"))
    return [*tiles, (str(flagged), "frame stands out" if flagged == 1 else "frames stand out")]


def _figures(report: dict[str, Any]) -> list[tuple[str, str]]:
    colors, iris = report["residual_colors"], report["iris_distance"]
    rows = [
        ("Distance of landmarks from the detected ones: median, 95 %, largest", _three(report["residual_px"], 1, "px")),
    ]
    if colors is not None:
        rows.append(("Difference of colours: median, 95 %, largest", _three(colors, 100, "%")))
    rows += [
        ("Focal length", f"{report['focal_px']:.0f} px, {_FOCAL_FROM[report['focal_from']]}"),
        ("Distance from the camera: median", _number(report["depth_m"]["median"], 1, "m")),
        ("Jitter of landmarks: detected, fitted", f"{_number(report['jitter']['detected_px'], 1, 'px')}, "
                                                  f"{_number(report['jitter']['fitted_px'], 1, 'px')}"),
        ("Distance of the irises: mean, deviation", f"{_number(iris['mean_m'], 1000, 'mm')}, "
                                                    f"{_number(iris['deviation_percent'], 1, '%')}"),
    ]  # fmt: skip
    return rows


def _three(summary: dict[str, float | None], factor: int, unit: str) -> str:
    return ", ".join(_number(summary[name], factor, unit) for name in ("median", "p95", "max"))


def _number(value: float | None, factor: int, unit: str) -> str:
    return "-" if value is None else f"{factor * value:.2f} {unit}"
