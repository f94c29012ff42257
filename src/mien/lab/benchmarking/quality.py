"""Errors of a tracking against the truth of a synthetic capture, and rows and tables of `mien bench quality`."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float

from mien.capture.capture import Capture
from mien.face.model import FaceModel
from mien.lab.benchmarking.comparing import markdown
from mien.lab.benchmarking.following import (
    Following,
    blink_following,
    jitter,
    mean_rotation,
    still_timesteps,
    turn_following,
)
from mien.lab.synthetic.truth import Truth
from mien.machine import exact
from mien.rotation import align_centered, axis_angle_from_matrix, matrix_from_axis_angle
from mien.tracking.report.residuals import residual_report
from mien.tracking.tracking import Tracking


@dataclass(frozen=True)
class TrackingErrors:
    """Means over the tracked timesteps of one sequence; None if there is nothing to measure."""

    vertex_mm: float
    """Distance of the face region's visible vertices after an alignment of each frame, in millimetres. The alignment is
    rigid if there are several (calibrated) cameras, which fix the scale, and a similarity otherwise."""
    landmark_px: float
    """Distance of the tracked model's projected landmarks from the true ones, in capture pixels, where a face was
    found."""
    rotation_deg: float
    """Error of the head's rotation, in degrees."""
    rotation_steady_deg: float
    """The same without the constant part, in which shape and pose can compensate for each other."""
    jitter_px: float | None
    """Median second difference of the tracked landmarks while the true ones stand still, in capture pixels."""
    jitter_mm: float | None = None
    """The same in world space, in millimetres."""
    blinks: Following | None = None
    """How the eyes' openings follow the true ones around blinks."""
    turns: Following | None = None
    """How head rotation follows the true one around fast turns."""
    iris_deviation_percent: float | None = None
    """Standard deviation of the irises' distance x depth / focal length over near-frontal frames, in percent of the
    mean."""


@torch.no_grad()
def tracking_errors(tracking: Tracking, capture: Capture, truth: Truth, face_model: FaceModel) -> TrackingErrors:
    """Compare a tracking with the truth. Both must have the same face model topology.

    Errors in pixels refer to the capture, which may be a crop of the drawn pictures.
    """
    timesteps = tracking.valid.nonzero()[:, 0].tolist()
    index = torch.from_numpy(truth.vertex_index)
    expected = crop_landmarks(truth.landmarks, capture)
    vertex, pixel, projected = [], [], np.full(expected.shape, np.nan, np.float32)
    placed = np.full((len(expected), expected.shape[2], 3), np.nan, np.float32)
    for timestep in timesteps:
        vertices = face_model(tracking.face[timestep])[0]
        visible = visible_vertices(truth, face_model, timestep)
        rigid = len(tracking.cameras) > 1
        vertex.append(aligned_distance(vertices[index].numpy()[visible], truth.vertices[timestep][visible], rigid))
        points = face_model.landmark_positions(vertices, "mediapipe")
        placed[timestep] = points.numpy()
        for camera, view in enumerate(tracking.cameras):
            projected[timestep, camera] = view.project(points)[0].numpy()
        seen = capture.valid[timestep]
        pixel.append(np.linalg.norm(projected[timestep, seen] - expected[timestep, seen], axis=-1).mean())
    mean, steady = _rotation_errors(tracking, truth)
    still = still_timesteps(expected)
    jitter_m = jitter(placed, still)
    return TrackingErrors(
        vertex_mm=1e3 * float(np.mean(vertex)),
        landmark_px=float(np.mean(pixel)),
        rotation_deg=mean,
        rotation_steady_deg=steady,
        jitter_px=jitter(projected, still),
        jitter_mm=None if jitter_m is None else 1e3 * jitter_m,
        blinks=blink_following(projected, expected, truth, capture.fps),
        turns=turn_following(tracking, truth, capture.fps),
        iris_deviation_percent=residual_report(capture, tracking, face_model)["iris_distance"]["deviation_percent"],
    )


def crop_landmarks(landmarks: Float[np.ndarray, "t c l 2"], capture: Capture) -> Float[np.ndarray, "t c l 2"]:
    """Convert pixels of the drawn pictures to pixels of the capture, which may be cropped and shrunk."""
    crop = capture.source.get("crop")
    if crop is None:
        return landmarks
    scale = np.array([capture.width / crop["width"], capture.height / crop["height"]], np.float32)
    return (landmarks - np.array([crop["left"], crop["top"]], np.float32)) * scale


def aligned_distance(points: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "n 3"], rigid: bool = False) -> float:
    """Return the mean distance after the best rotation, shift and, unless `rigid`, scale of `points` (Umeyama 1991)."""
    a, b = points.astype(np.float64), target.astype(np.float64)
    a, b = a - a.mean(0), b - b.mean(0)
    rotation, scale = align_centered(a, b)
    return float(np.linalg.norm((1.0 if rigid else scale) * a @ rotation.T - b, axis=-1).mean())


def visible_vertices(truth: Truth, face_model: FaceModel, timestep: int) -> Bool[np.ndarray, " n"]:
    """Mark the region's vertices that face any camera: the cosine between normal and direction is above 0.2."""
    index, faces = truth.vertex_index, face_model.faces.numpy()
    place = np.full(len(face_model.template), -1)
    place[index] = np.arange(len(index))
    local = place[faces]
    local = local[(local >= 0).all(1)]
    points = truth.vertices[timestep]
    normals = exact.vertex_normals(points, local)
    pose = truth.tracking.face.T_world_head[timestep].numpy()
    facing = np.zeros(len(index), bool)
    for camera in truth.tracking.cameras:
        towards = pose[:3, :3].T @ (camera.position.numpy() - pose[:3, 3]) - points
        towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
        facing |= (normals * towards).sum(-1) > 0.2
    return facing


def _rotation_errors(tracking: Tracking, truth: Truth) -> tuple[float, float]:
    """Return mean rotation errors in degrees: of the whole difference, and without the mean difference."""
    kept = tracking.valid
    tracked, true = (matrix_from_axis_angle(t.face.head_rotation)[kept].double() for t in (tracking, truth.tracking))
    difference = tracked.transpose(-1, -2) @ true
    mean = mean_rotation(difference)
    angles = [
        torch.rad2deg(axis_angle_from_matrix(part.float()).norm(dim=-1)).mean()
        for part in (difference, mean.T @ difference)
    ]
    return float(angles[0]), float(angles[1])


@dataclass(frozen=True)
class QualityRow:
    """All figures of one reference capture."""

    capture: str
    key: str
    """Key of the reference capture: `ReferenceCapture.key`."""
    method: str
    steps: int
    gaussians: int
    protocols: dict[str, Any]
    """Protocols as in metrics.json, without the figures of single frames."""
    tracking: dict[str, TrackingErrors]
    """Tracking errors by sequence."""
    seconds: dict[str, float]
    """Seconds of each stage when it last ran."""
    unseen_views: dict[str, Any] = field(default_factory=dict)
    """Figures by angle (`mien.lab.benchmarking.unseen_views`). Empty if the capture has no pictures from the side."""
    unseen_views_by_truth: dict[str, Any] = field(default_factory=dict)
    """The same for a run that was trained and posed by the true tracking, which leaves what the avatar itself costs."""


def markdown_table(rows: list[QualityRow]) -> str:
    """Return tables of pictures and trackings, in the form of docs/results.md."""
    pictures = []
    for row in rows:
        for protocol, entry in row.protocols.items():
            for what, figures in {"avatar": entry, **entry["baselines"]}.items():
                label = (f"{row.capture} (`{row.key}`)", protocol) if what == "avatar" else ("", "")
                pictures.append((*label, what.replace("_", " "), _figures(figures), _figures(figures["head"])))
    tables = [
        markdown(
            ("capture (key)", "protocol", "what", "whole frame: PSNR / SSIM / L1 / ST-LPIPS", "head crop"), pictures
        ),
        markdown(
            ("capture", "sequence", "face vertices", "landmarks", "head rotation (steady part left out)",
             "jitter, still", "blinks: lag, loss", "fast turns: lag, loss", "iris distance"),
            [(row.capture, name, *tracking_cells(errors)) for row in rows for name, errors in row.tracking.items()],
        ),
    ]  # fmt: skip
    for row in rows:
        views = {row.capture: row.unseen_views, f"{row.capture}, true tracking": row.unseen_views_by_truth}
        tables += [unseen_table(name, figures) for name, figures in views.items() if figures]
    seconds = [", ".join(f"{name} {value:.0f}" for name, value in row.seconds.items()) for row in rows]
    spent = [
        (row.capture, f"{row.steps:,}", f"{row.gaussians:,}", told) for row, told in zip(rows, seconds, strict=True)
    ]
    tables.append(markdown(("capture", "steps", "Gaussians", "seconds by stage"), spent))
    return "\n".join(tables)


def unseen_table(name: str, views: dict[str, Any]) -> str:
    """A table of the head crop by angle."""
    heads = [
        f"{name}: degrees to the side", "avatar: PSNR / SSIM / ST-LPIPS of the head crop", "mesh in completed colours"
    ]  # fmt: skip
    rows = []
    for angle, row in views.items():
        crops = [row[what]["head"] for what in ("avatar", "mesh")]
        cells = [f"{head['psnr']:.2f} / {head['ssim']:.3f} / {_known(head['perceptual'], '{:.3f}')}" for head in crops]
        rows.append((angle, *cells))
    return markdown(heads, rows)


def tracking_cells(errors: TrackingErrors) -> list[str]:
    """Return the figures of one sequence as cells of a table."""
    pixels, world = _known(errors.jitter_px, "{:.3f} px"), _known(errors.jitter_mm, "{:.3f} mm")
    return [
        f"{errors.vertex_mm:.2f} mm", f"{errors.landmark_px:.2f} px",
        f"{errors.rotation_deg:.2f} ({errors.rotation_steady_deg:.2f}) deg",
        pixels if errors.jitter_mm is None else f"{pixels}, {world}",
        *(
            "-" if one is None else f"{one.lag_frames:.2f} frames, {one.loss_percent:.0f} % ({one.events})"
            for one in (errors.blinks, errors.turns)
        ),
        _known(errors.iris_deviation_percent, "{:.2f} %"),
    ]  # fmt: skip


def _known(value: float | None, form: str) -> str:
    return "-" if value is None else form.format(value)


def _figures(entry: dict[str, Any]) -> str:
    last = _known(entry.get("perceptual"), "{:.3f}")
    return f"{entry['psnr']:.2f} / {entry['ssim']:.3f} / {entry['l1']:.4f} / {last}"
