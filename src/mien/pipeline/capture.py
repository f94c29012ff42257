"""From videos to captures, as the command line runs it."""

from collections.abc import Sequence
from pathlib import Path

from mien.capture.cameras.calibration import read_calibration
from mien.capture.capture import Capture
from mien.capture.from_cameras import capture_cameras
from mien.capture.from_video import capture_video_parts
from mien.capture.settings import CaptureSettings
from mien.disk.files import check_writable
from mien.disk.workspace import Workspace
from mien.errors import UserError
from mien.machine.progress import say
from mien.machine.terminal import counted
from mien.pipeline.names import rig_name, sequence_name


def run_capture_stage(
    workspace: Workspace, video: Path, name: str | None, settings: CaptureSettings, replace: bool = False
) -> list[str]:
    """Capture a video into the workspace; return the names of its sequences, one for each part."""
    name = sequence_name(video, name)
    check_writable(workspace.root, folder=True)
    captures = capture_video_parts(video, workspace.root / "sequences", settings, name, replace)
    for capture in captures:
        _report(capture)
    return [capture.name for capture in captures]


def run_calibrated_capture_stage(
    workspace: Workspace,
    sources: Sequence[Path],
    calibration: Path,
    names: Sequence[str],
    settings: CaptureSettings,
    replace: bool = False,
) -> list[str]:
    """Capture what several calibrated cameras filmed as one sequence, and return its name in a list."""
    name = rig_name(sources, calibration, names)
    check_writable(workspace.root, folder=True)
    out = workspace.sequence_dir(name) / "capture"
    _report(capture_cameras(sources, calibration, out, name, settings, replace))
    return [name]


def check_camera_ids(calibration: Path, ids: Sequence[str]) -> None:
    """Check that the cameras to hold out are in the calibration, before any work."""
    known = [camera.camera_id for camera in read_calibration(calibration)]
    for camera_id in ids:
        if camera_id not in known:
            raise UserError(
                f"--hold-out-cameras {camera_id}: {calibration} has no such camera, it has {', '.join(known)}"
            )


def _report(capture: Capture) -> None:
    found, blurred = int(capture.valid.any(axis=1).sum()), int((capture.valid & ~capture.usable).sum())
    cameras = len(capture.camera_ids)
    say(
        f"{capture.name}: {counted(capture.timesteps, 'frame')} of {capture.width}x{capture.height}"
        + (f" by {cameras} cameras" if cameras > 1 else "")
        + f", a face in {found} of them"
        + (f", blurred in {blurred}" if blurred else "")
    )
