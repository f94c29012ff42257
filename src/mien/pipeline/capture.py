"""From videos to captures, as the command line runs it."""

from collections.abc import Sequence
from pathlib import Path

from mien.capture.cameras.calibration import read_calibration
from mien.capture.capture import Capture
from mien.capture.from_cameras import capture_cameras
from mien.capture.from_video import capture_video_parts, is_captured
from mien.capture.settings import CaptureSettings
from mien.disk.files import check_writable
from mien.disk.workspace import Workspace
from mien.errors import UserError
from mien.machine.progress import say
from mien.machine.terminal import counted
from mien.pipeline.names import rig_name, sequence_names


def run_capture_stage(
    workspace: Workspace,
    videos: Sequence[Path],
    names: Sequence[str],
    calibration: Path | None,
    settings: CaptureSettings,
    replace: bool = False,
) -> list[str]:
    """Capture videos into the workspace, and return the names of the sequences, one for each part of each video.

    With a calibration, the videos are of several cameras that filmed at once, and become one sequence.
    """
    if calibration is not None:
        name = rig_name(videos, calibration, names)
        check_writable(workspace.root, folder=True)
        out = workspace.sequence_dir(name) / "capture"
        captures = [capture_cameras(videos, calibration, out, name, settings, replace)]
        _report(captures[0])
        return [name]
    captures, names = [], sequence_names(videos, names)
    check_writable(workspace.root, folder=True)
    for video, name in zip(videos, names, strict=True):
        parts = capture_video_parts(video, workspace.root / "sequences", settings, name, replace)
        for part in parts:
            _report(part)
        captures += parts
    return [capture.name for capture in captures]


def check_captured(
    workspace: Workspace, run: str, videos: Sequence[Path], names: Sequence[str], settings: CaptureSettings
) -> None:
    """Check that videos need not be captured again if a run was trained on them, because the run could not go on."""
    if not (workspace.run_dir(run) / "config.json").is_file():
        return
    for video, name in zip(videos, names, strict=True):
        if not is_captured(video, workspace.root / "sequences", settings, name):
            raise UserError(
                f"{workspace.root}: run {run} was trained on a capture of {video.name} by other settings, or by "
                "another version of mien; give another folder (--out), or delete the run and its capture"
            )


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
