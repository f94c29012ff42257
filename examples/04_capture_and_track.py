"""Capture your own video (frames, mattes and landmarks) and fit the face model to it.

python examples/04_capture_and_track.py my_video.mp4 --out out/examples/me
"""

import argparse
import math
from pathlib import Path

from mien.capture import capture_video
from mien.capture.settings import CaptureSettings
from mien.capture.store import read_capture_hash
from mien.disk.workspace import Workspace
from mien.face import load_face_model
from mien.tracking import track, write_tracking
from mien.tracking.report.overlay import write_overlay
from mien.tracking.scoring import make_scoring
from mien.tracking.scoring_files import write_scoring


def main() -> None:
    """Call the functions behind `mien capture` and `mien track`."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("video", type=Path, help="video of one person")
    parser.add_argument("--out", type=Path, required=True, help="workspace folder")
    parser.add_argument("--max-frames", type=int, default=0, help="most frames to capture; 0 for all")
    options = parser.parse_args()

    folder = Workspace(options.out).sequence_dir(options.video.stem)
    capture = capture_video(options.video, folder / "capture", CaptureSettings(max_frames=options.max_frames))
    print(f"a face in {int(capture.valid.any(1).sum())} of {capture.timesteps} frames")

    face_model = load_face_model("anny")
    tracking = track(capture, face_model)
    yaw = tracking.face.head_rotation[:, 1] * 180 / math.pi
    print(
        f"landmark residual {tracking.residuals.nanmedian():.2f} pixels; yaw {yaw.min():.0f} to {yaw.max():.0f} degrees"
    )

    write_tracking(folder / "tracking", tracking)
    scoring = make_scoring(capture, tracking, face_model)
    write_scoring(folder / "scoring", scoring, read_capture_hash(folder / "capture"))
    write_overlay(folder / "tracking" / "overlay.mp4", capture, tracking, face_model)
    print(f"look at {folder / 'tracking' / 'overlay.mp4'}, then train: mien train {options.out}")


if __name__ == "__main__":
    main()
