"""Write a synthetic capture with exact ground truth as a workspace, which `mien train` and example 05 can use.

python examples/03_synthetic_capture.py --out out/examples/subject
"""

import argparse
from dataclasses import replace
from pathlib import Path

from mien.capture import write_capture
from mien.capture.store import read_capture_hash
from mien.disk.workspace import Workspace
from mien.face import load_face_model
from mien.lab.synthetic import RECIPES, synthesize
from mien.tracking import write_tracking
from mien.tracking.report.overlay import write_overlay
from mien.tracking.scoring import make_scoring
from mien.tracking.scoring_files import write_scoring


def main() -> None:
    """Draw the clip, and write capture, true tracking, scoring masks, and a video of the tracking over the capture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="workspace folder")
    parser.add_argument("--seed", type=int, default=0, help="seed of the person and the motion")
    parser.add_argument("--seconds", type=float, default=4.0, help="length of the clip")
    parser.add_argument("--size", type=int, default=256, help="side of the pictures in pixels")
    options = parser.parse_args()

    side = options.size
    recipe = replace(RECIPES["plain"], seconds=options.seconds, width=side, height=side, texture_size=6 * side)
    capture, truth = synthesize(recipe, options.seed)
    print(f"{capture.timesteps} frames of {capture.width}x{capture.height}, {len(capture.camera_ids)} camera(s)")

    folder = Workspace(options.out).sequence_dir("synthetic")
    face_model = load_face_model(truth.face_model)
    write_capture(folder / "capture", capture)
    write_tracking(folder / "tracking", truth)
    scoring = make_scoring(capture, truth, face_model)  # what is trained on and scored
    write_scoring(folder / "scoring", scoring, read_capture_hash(folder / "capture"))
    write_overlay(folder / "tracking" / "overlay.mp4", capture, truth, face_model)
    print(f"wrote {folder}; look at tracking/overlay.mp4")


if __name__ == "__main__":
    main()
