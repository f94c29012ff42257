"""Capture -> Tracking, as the command line runs it: a current tracking is read back."""

import hashlib
import json
from dataclasses import asdict, replace
from pathlib import Path

from mien.capture import Capture, read_capture, read_capture_hash
from mien.face import FaceModel, load_face_model
from mien.progress import say
from mien.tracking import (
    Tracking,
    TrackingSettings,
    make_scoring,
    read_tracking,
    scoring_exists,
    track,
    write_scoring,
    write_tracking,
)
from mien.workspace import Workspace

_TRACKING_RECIPE = 2
"""Raised whenever the same capture would be tracked otherwise, so that old trackings are not taken for current."""


def tracking_stage(
    workspace: Workspace, name: str, face_model_name: str, settings: TrackingSettings, again: bool = False
) -> Tracking:
    """Track a sequence, write the overlay and, once for ever, the scoring mask; a current tracking is read back."""
    folder = workspace.sequence_dir(name)
    face_model = load_face_model(face_model_name)
    capture_hash = read_capture_hash(folder / "capture")
    fingerprint = _tracking_fingerprint(capture_hash, face_model, settings)
    tracking = None if again else _current_tracking(folder / "tracking", fingerprint)
    if tracking is None:
        capture = read_capture(folder / "capture")
        tracking = track(capture, face_model, settings)
        tracking = replace(tracking, settings={**tracking.settings, "fingerprint": fingerprint})
        write_tracking(folder / "tracking", tracking)
        say(f"{name}: tracked with a median landmark residual of {tracking.residuals.nanmedian():.2f} pixels")
    if not scoring_exists(folder / "scoring", capture_hash):
        if scoring_exists(folder / "scoring"):
            say(f"{name}: the pictures changed, so the scoring mask is made anew")
        capture = read_capture(folder / "capture")
        write_scoring(folder / "scoring", make_scoring(capture, tracking, face_model), capture_hash)
    _show_tracking(folder, tracking, face_model)
    return tracking


def _tracking_fingerprint(capture_hash: str, face_model: FaceModel, settings: TrackingSettings) -> str:
    content = [_TRACKING_RECIPE, capture_hash, face_model.name, face_model.content_hash, asdict(settings)]
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:16]


def _current_tracking(folder: Path, fingerprint: str) -> Tracking | None:
    if not (folder / "tracking.json").is_file():
        return None
    tracking = read_tracking(folder)
    return tracking if tracking.settings.get("fingerprint") == fingerprint else None


def _show_tracking(folder: Path, tracking: Tracking, face_model: FaceModel) -> None:
    """Write overlay.mp4 and the residual report, unless those there are newer than the tracking."""
    from mien.tracking import write_overlay, write_residual_report

    overlay, written = folder / "tracking" / "overlay.mp4", folder / "tracking" / "tracking.json"
    if overlay.is_file() and overlay.stat().st_mtime >= written.stat().st_mtime:
        return
    capture: Capture = read_capture(folder / "capture")
    write_residual_report(folder / "tracking", capture, tracking, face_model)
    write_overlay(overlay, capture, tracking, face_model)
