"""Errors of a tracking against the truth of a synthetic capture, and rows and tables of `mien bench quality`.

A tracking also has to keep up: errors are lag and lost amplitude of blinks and fast turns, and jitter at rest.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float

from mien.capture.capture import Capture
from mien.face.model import FaceModel
from mien.face.torso import has_torso
from mien.lab.benchmarking.comparing import known, markdown
from mien.lab.benchmarking.torso import TorsoErrors, crop_landmarks, torso_errors
from mien.lab.synthetic.truth import Truth
from mien.machine import exact
from mien.rotation import align_centered, axis_angle_from_matrix, matrix_from_axis_angle
from mien.tracking.landmarks.groups import LEFT_LID_PAIRS, RIGHT_LID_PAIRS
from mien.tracking.report.overlay import frontal_camera
from mien.tracking.report.residuals import residual_report
from mien.tracking.tracking import Tracking

LIDS = (*RIGHT_LID_PAIRS, *LEFT_LID_PAIRS)
"""MediaPipe's pairs of landmarks across the eyes' openings."""
_MIN_BLINK = 0.25
"""Smallest decrease of an eye's opening in a blink, as a part of the median. A blink begins at half of it."""


@dataclass(frozen=True)
class Following:
    """How a tracked signal follows the true one, over all events of one kind."""

    lag_frames: float
    """Delay of the true signal at which it correlates most with the tracked one."""
    loss_percent: float
    """Lost amplitude: 100 (1 - g), where the tracked signal is about g times the delayed true one."""
    events: int


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
    torso: TorsoErrors | None = None


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
        vertex_mm=1e3 * float(np.mean(vertex)), landmark_px=float(np.mean(pixel)), rotation_deg=mean,
        rotation_steady_deg=steady, jitter_px=jitter(projected, still),
        jitter_mm=None if jitter_m is None else 1e3 * jitter_m,
        blinks=blink_following(projected, expected, truth, capture.fps),
        turns=turn_following(tracking, truth, capture.fps),
        torso=torso_errors(tracking, capture, truth, face_model) if has_torso(face_model) else None,
        iris_deviation_percent=residual_report(capture, tracking, face_model)["iris_distance"]["deviation_percent"],
    )  # fmt: skip


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


def following(
    tracked: Float[np.ndarray, "t k"], true: Float[np.ndarray, "t k"], busy: Bool[np.ndarray, " t"], around: int
) -> Following | None:
    """Return lag and lost amplitude of k signals around events; None if there is no event.

    Each run of `busy` timesteps is an event, to which `around` timesteps before and after belong. Events with tracked
    values that are not finite are skipped.
    """
    wide = np.convolve(busy, np.ones(2 * around + 1), mode="same") > 0  # windows that overlap are one
    edges = np.flatnonzero(np.diff(np.concatenate([[0], wide.astype(int), [0]])))
    windows = [slice(int(first), int(last)) for first, last in edges.reshape(-1, 2)]
    parts = [part for part in windows if np.isfinite(tracked[part]).all() and part.stop - part.start > 2]
    if not parts:
        return None
    lags = np.arange(-4.0, 4.0 + 0.05 / 2, 0.05)
    sums = np.array([_products(tracked, true, parts, lag) for lag in lags])
    best = int((sums[:, 0] / np.sqrt(sums[:, 1] * sums[:, 2] + 1e-30)).argmax())
    return Following(float(lags[best]), float(100 * (1 - sums[best, 0] / max(sums[best, 2], 1e-30))), len(parts))


def _around(fps: float) -> int:
    """Timesteps before and after an event that belong to it: 0.3 s."""
    return max(round(0.3 * fps), 2)


def _products(
    tracked: Float[np.ndarray, "t k"], true: Float[np.ndarray, "t k"], parts: list[slice], lag: float
) -> tuple[float, float, float]:
    """Sums of tracked x true, tracked squared and true squared, of the delayed true signal, less each part's means."""
    time, sums = np.arange(len(true)), np.zeros(3)
    for part in parts:
        for x, y in zip(tracked.T, true.T, strict=True):
            delayed = _between(y, time[part] - lag)
            a, b = x[part] - x[part].mean(), delayed - delayed.mean()
            sums += np.array([a @ b, a @ a, b @ b])
    return float(sums[0]), float(sums[1]), float(sums[2])


def _between(values: Float[np.ndarray, " t"], at: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Interpolate values by cubic convolution (Keys 1981), since linear interpolation would flatten a blink."""
    at = np.clip(at, 0, len(values) - 1)
    first = np.floor(at).astype(int)
    x = at - first
    taps = [values[np.clip(first + step, 0, len(values) - 1)] for step in (-1, 0, 1, 2)]
    shares = (
        (-(x**3) + 2 * x**2 - x) / 2,
        (3 * x**3 - 5 * x**2 + 2) / 2,
        (-3 * x**3 + 4 * x**2 + x) / 2,
        (x**3 - x**2) / 2,
    )
    return sum((tap * share for tap, share in zip(taps, shares, strict=True)), np.zeros_like(at))


def eye_opening(landmarks: Float[np.ndarray, "t l 2"]) -> Float[np.ndarray, " t"]:
    """Return the mean distance of the lids over the mean width of the eyes; about 0 when closed."""
    gaps = [np.linalg.norm(landmarks[:, upper] - landmarks[:, lower], axis=-1) for upper, lower in LIDS]
    widths = [
        np.linalg.norm(landmarks[:, one] - landmarks[:, other], axis=-1) for one, other in ((33, 133), (362, 263))
    ]
    return np.mean(gaps, axis=0) / np.mean(widths, axis=0)


def blink_following(
    projected: Float[np.ndarray, "t c l 2"], true: Float[np.ndarray, "t c l 2"], truth: Truth, fps: float
) -> Following | None:
    """Measure how blinks are followed, in the frontal camera's pictures."""
    camera = frontal_camera(truth.tracking)
    tracked, opening = (eye_opening(points[:, camera].astype(np.float64)) for points in (projected, true))
    middle = float(np.median(opening))
    depth = middle - opening.min()
    if depth < _MIN_BLINK * middle:
        return None
    closing = opening < middle - max(0.5 * depth, 0.5 * _MIN_BLINK * middle)
    return following(tracked[:, None], opening[:, None], closing, _around(fps))


def turn_following(tracking: Tracking, truth: Truth, fps: float) -> Following | None:
    """Measure how fast head turns are followed. A constant difference of pose does not count."""
    tracked, true = (
        matrix_from_axis_angle(one.face.head_rotation.double()) for one in (tracking, truth.tracking)
    )  # fmt: skip
    steady = mean_rotation(tracked[tracking.valid].mT @ true[tracking.valid])
    middle = mean_rotation(true)
    signals = [axis_angle_from_matrix(middle.T @ turns).numpy() for turns in (tracked @ steady, true)]
    speed = axis_angle_from_matrix(true[:-1].mT @ true[1:]).norm(dim=-1).numpy() * fps
    return following(signals[0], signals[1], np.concatenate([speed > np.radians(15.0), [False]]), _around(fps))


def mean_rotation(rotations: Float[torch.Tensor, "n 3 3"]) -> Float[torch.Tensor, "3 3"]:
    """Return the rotation nearest to the mean of the matrices."""
    nearest, _ = align_centered(np.eye(3), rotations.double().mean(0).T.numpy())
    return torch.from_numpy(nearest)


def still_timesteps(true: Float[np.ndarray, "t c l 2"]) -> Bool[np.ndarray, " t2"]:
    """Return, for all timesteps but the first and the last, whether true landmarks stand still around them."""
    still = np.linalg.norm(np.diff(true[:, 0], axis=0), axis=-1).max(-1) < 0.02  # pixels a frame
    return still[1:] & still[:-1]


def jitter(points: Float[np.ndarray, "t *l d"], still: Bool[np.ndarray, " t2"]) -> float | None:
    """Return the median length of second differences over time where nothing moves, in the points' unit."""
    second = np.linalg.norm(points[2:] - 2 * points[1:-1] + points[:-2], axis=-1)[still]
    second = second[np.isfinite(second)]
    return float(np.median(second)) if len(second) else None


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
    outline_px: float | None = None
    """Motion of the shoulders' outline (`outline_motion`). None without a torso."""


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
    torsos = [(row, name, errors.torso) for row in rows for name, errors in row.tracking.items() if errors.torso]
    if torsos:
        heads = (
            "capture", "sequence", "torso: nod, turn, tilt", "without their mean",
            "place without its mean, of the width", "shoulders' outline while the head turns",
        )  # fmt: skip
        cells = [(row.capture, name, *torso_cells(own, row.outline_px)) for row, name, own in torsos]
        tables.append(markdown(heads, cells))
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
        cells = [f"{head['psnr']:.2f} / {head['ssim']:.3f} / {known(head['perceptual'])}" for head in crops]
        rows.append((angle, *cells))
    return markdown(heads, rows)


def tracking_cells(errors: TrackingErrors) -> list[str]:
    """Return the figures of one sequence as cells of a table."""
    pixels, world = known(errors.jitter_px, "{:.3f} px"), known(errors.jitter_mm, "{:.3f} mm")
    return [
        f"{errors.vertex_mm:.2f} mm", f"{errors.landmark_px:.2f} px",
        f"{errors.rotation_deg:.2f} ({errors.rotation_steady_deg:.2f}) deg",
        pixels if errors.jitter_mm is None else f"{pixels}, {world}",
        *(
            "-" if one is None else f"{one.lag_frames:.2f} frames, {one.loss_percent:.0f} % ({one.events})"
            for one in (errors.blinks, errors.turns)
        ),
        known(errors.iris_deviation_percent, "{:.2f} %"),
    ]  # fmt: skip


def torso_cells(errors: TorsoErrors, outline_px: float | None) -> list[str]:
    """Return the figures of one sequence's torso as cells of a table."""
    turns = (errors.turn_deg, errors.turn_steady_deg)
    cells = [", ".join(f"{angle:.1f}" for angle in each) + " deg" for each in turns]
    return [*cells, f"{errors.place_percent:.1f} %", known(outline_px, "{:.2f} px")]


def _figures(entry: dict[str, Any]) -> str:
    last = known(entry.get("perceptual"))
    return f"{entry['psnr']:.2f} / {entry['ssim']:.3f} / {entry['l1']:.4f} / {last}"
