"""The residual report: figures and curves that show whether a tracking can be trusted."""

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mien.capture.capture import Capture
from mien.face.model import FaceModel
from mien.rotation import axis_angle_from_matrix, matrix_from_axis_angle
from mien.tracking.landmarks.groups import BROWS, LEFT_EYELIDS, LEFT_IRIS, LIPS, NOSE, OVAL, RIGHT_EYELIDS, RIGHT_IRIS
from mien.tracking.report.overlay import frontal_camera
from mien.tracking.report.rig import (
    cameras_that_do_not_fit,
    front_residuals,
    misplacements,
    seen_from_front,
    shared_misfit,
)
from mien.tracking.tracking import PARTS, Tracking

_GROUPS = {
    "oval": OVAL, "brows": BROWS, "nose": NOSE, "lips": LIPS, "eyelids": LEFT_EYELIDS + RIGHT_EYELIDS,
    "irises": LEFT_IRIS + RIGHT_IRIS,
}  # fmt: skip
_NEAR_FRONTAL = 0.26  # largest yaw of a frame that counts as frontal: 15 degrees, in radians
_MOVED = 0.03  # standard deviation above which a coefficient counts as used
_MIN_COLOR_STEP = 0.005  # least amount (0..1) by which a frame's colour residual must stand out to be flagged


def residual_report(capture: Capture, tracking: Tracking, face_model: FaceModel) -> dict:
    """Figures about a tracking: residuals, jitter, constancy of the iris distance, leaks of pose into expression.

    `mesh_distance_px` is the distance from landmarks to the mesh itself; `residual_px` allows every landmark its static
    offset. `iris_distance` is the distance of the detected irises in metres at the tracked depth, which should be
    constant. With several cameras, jitter, irises, depth, pitch and yaw are those of the most frontal camera. Residuals
    and distances are those of pictures from the front, since landmarks of a face from the side are partly guessed.
    `cameras` has the residuals of each camera in all its pictures, how many of them are `from_front`, and
    `misplaced_px` (`misplacements`). `shared_misfit` says how badly all cameras together fit, or is None.
    """
    valid, frontal, assumed = tracking.valid, frontal_camera(tracking), tracking.settings.get("focal") is None
    marks = landmarks_of(face_model, tracking)
    detected = torch.from_numpy(np.asarray(capture.landmarks, dtype=np.float32))
    distance = torch.stack(
        [(camera.project(marks)[0] - detected[:, c]).norm(dim=-1) for c, camera in enumerate(tracking.cameras)], dim=1
    )[front_residuals(tracking).isfinite()]
    pixels, depth = tracking.cameras[frontal].project(marks)
    seen = tracking.residuals[:, frontal].isfinite()
    pitch, yaw, _ = seen_rotation(tracking, frontal).unbind(1)
    iris = iris_distances(tracking, detected[:, frontal], depth, frontal)
    flagged, alone, colors, covered = flagged_frames(timestep_residuals(tracking)), valid, tracking.pixel_residuals, {}
    if colors is not None:
        flagged |= flagged_frames(colors.nanmedian(1).values, _MIN_COLOR_STEP)
        alone = valid & colors.isnan().all(1)
    if tracking.covered is not None:
        by_part = {name: tracking.covered[:, :, part].any(1) for part, name in enumerate(PARTS)}
        covered = {name: frames.nonzero()[:, 0].tolist() for name, frames in by_part.items() if frames.any()}
    return {
        "frames": len(valid),
        "frames_without_face": (~valid).nonzero()[:, 0].tolist(),
        "flagged_frames": flagged.nonzero()[:, 0].tolist(),
        "covered_frames": covered,
        "landmarks_only_frames": alone.nonzero()[:, 0].tolist(),
        "residual_px": _summary(front_residuals(tracking)),
        "residual_colors": None if colors is None else _summary(colors),
        "cameras": _of_cameras(capture, tracking, face_model),
        "shared_misfit": shared_misfit(capture, tracking),
        "frontal_camera": capture.camera_ids[frontal],
        "mesh_distance_px": {name: float(distance[:, list(group)].median()) for name, group in _GROUPS.items()},
        "jitter": {
            "detected_px": _jitter(detected[:, frontal], seen),
            "fitted_px": _jitter(pixels, seen),
            "fitted_m": _jitter(marks, valid),
        },
        "iris_distance": _constancy(iris[seen & (yaw.abs() < _NEAR_FRONTAL)]),
        "focal_px": float(tracking.cameras[frontal].K[0, 0]),
        "focal_from": "calibrated" if capture.calibration is not None else "assumed" if assumed else "given",
        "depth_m": _summary(depths(tracking, frontal)[valid]),
        "correlation_with_pitch": _correlations(tracking, face_model, pitch),
        "correlation_with_yaw": _correlations(tracking, face_model, yaw),
    }


def seen_rotation(tracking: Tracking, camera: int) -> Float[Tensor, "t 3"]:
    """Head rotations relative to a camera, axis-angle in radians. A head that looks straight into it has zero."""
    facing = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    R_seen_world = facing @ tracking.cameras[camera].viewmat[:3, :3]
    return axis_angle_from_matrix(R_seen_world @ matrix_from_axis_angle(tracking.face.head_rotation))


def depths(tracking: Tracking, camera: int) -> Float[Tensor, " t"]:
    """Depths of the head in a camera, in metres."""
    return tracking.cameras[camera].project(tracking.face.head_translation)[1]


def _of_cameras(capture: Capture, tracking: Tracking, face_model: FaceModel) -> dict[str, dict]:
    rows, front = {}, seen_from_front(tracking)
    misplaced = misplacements(capture, tracking, face_model)
    odd = dict(cameras_that_do_not_fit(misplaced, max(capture.width, capture.height)))
    for index, name in enumerate(capture.camera_ids):
        found = tracking.residuals[:, index]
        rows[name] = {"frames": int(found.isfinite().sum())}
        rows[name]["from_front"] = int((found.isfinite() & front[:, index]).sum())
        if rows[name]["frames"]:
            rows[name]["residual_px"] = _summary(found)
            rows[name]["misplaced_px"] = float(misplaced[index])
        if index in odd:
            rows[name]["others_misplaced_px"] = odd[index]
    return rows


def timestep_residuals(tracking: Tracking) -> Float[Tensor, " t"]:
    """Median residual over the cameras that found the face from the front, in pixels; NaN if none found it."""
    return front_residuals(tracking).nanmedian(1).values


def iris_distances(
    tracking: Tracking, detected: Float[Tensor, "t l 2"], depth: Float[Tensor, "t l"], camera: int = 0
) -> Float[Tensor, " t"]:
    """Distance of the detected iris centres in metres, at the tracked depth, corrected for foreshortening by turns."""
    right, left = RIGHT_IRIS[0], LEFT_IRIS[0]
    apart = (detected[:, left] - detected[:, right]).norm(dim=-1)
    focal = tracking.cameras[camera].K[0, 0]
    across = matrix_from_axis_angle(seen_rotation(tracking, camera))[:, :2, 0].norm(dim=-1)
    return apart * (depth[:, left] + depth[:, right]) / 2 / focal / across


def flagged_frames(residuals: Float[Tensor, " t"], least: float = 0.1) -> Bool[Tensor, " t"]:
    """Frames with a residual above median + 4 robust standard deviations + `least`. NaN is never flagged."""
    known = residuals[residuals.isfinite()]
    if len(known) == 0:
        return torch.zeros_like(residuals, dtype=torch.bool)
    median = known.median()
    spread = 1.4826 * (known - median).abs().median()
    return residuals > median + 4 * spread + least


def landmarks_of(face_model: FaceModel, tracking: Tracking) -> Float[Tensor, "t l 3"]:
    """The tracked landmarks in world space, in metres."""
    with torch.no_grad():
        parts = [tracking.face[start : start + 32] for start in range(0, len(tracking.face), 32)]
        return torch.cat([face_model.landmark_positions(face_model(part), "mediapipe") for part in parts])


def _jitter(points: Float[Tensor, "t l d"], valid: Bool[Tensor, " t"]) -> float | None:
    """Median size of second differences over time, without the points of the face's outline, which slide."""
    inner = [index for index in range(points.shape[1]) if index not in OVAL]
    second = (points[2:] - 2 * points[1:-1] + points[:-2])[:, inner].norm(dim=-1)
    known = second[valid[2:] & valid[1:-1] & valid[:-2]]
    return float(known.median()) if known.numel() else None


def _constancy(distances: Float[Tensor, " n"]) -> dict[str, float | None]:
    if len(distances) < 2:
        return {"mean_m": None, "deviation_percent": None}
    return {"mean_m": float(distances.mean()), "deviation_percent": float(100 * distances.std() / distances.mean())}


def _correlations(tracking: Tracking, face_model: FaceModel, angle: Float[Tensor, " t"]) -> dict[str, float]:
    """Pearson's correlation of every expression coefficient in use with an angle."""
    expression, angle = tracking.face.expression[tracking.valid], angle[tracking.valid]
    moved = (expression.std(0) > _MOVED).nonzero()[:, 0].tolist()
    return {face_model.expression_names[i]: float(torch.corrcoef(torch.stack([expression[:, i], angle]))[0, 1])
            for i in moved}  # fmt: skip


def _summary(values: Float[Tensor, "*n"]) -> dict[str, float | None]:
    values = values[values.isfinite()].double()
    if len(values) == 0:
        return {"median": None, "p95": None, "max": None}
    return {"median": float(values.median()), "p95": float(values.quantile(0.95)), "max": float(values.max())}
