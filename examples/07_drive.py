"""Drive an avatar by another person's motion, relative to the neutral face of each.

python examples/07_drive.py out/examples/subject --by out/examples/me --out out/examples/driven.mp4
"""

import argparse
from pathlib import Path

import numpy as np
import torch

from mien.avatar import load_avatar, neutral_of
from mien.disk.workspace import open_workspace
from mien.driving import drive
from mien.media.video import write_video
from mien.render import rasterize
from mien.training import read_sequence
from mien.training.run import run_camera


@torch.no_grad()
def main() -> None:
    """Write a video with the driver on the left and the avatar on the right."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("workspace", type=Path, help="workspace of the avatar")
    parser.add_argument("--by", type=Path, required=True, help="workspace of the driver")
    parser.add_argument("--run", default=None, help="name of the run; the only one by default")
    parser.add_argument("--out", type=Path, required=True, help="video to write (.mp4)")
    options = parser.parse_args()

    torch.set_num_threads(1)
    workspace, theirs = open_workspace(options.workspace), open_workspace(options.by)
    run_dir = workspace.run_dir(workspace.pick_run(options.run))
    avatar, camera = load_avatar(run_dir), run_camera(run_dir)
    driver = read_sequence(theirs.sequence_dir(theirs.pick_sequence(None)))

    motion = driver.tracking.face
    at_rest = neutral_of(motion[driver.tracking.valid])  # the driver's own face at rest stays with the driver
    driven = drive(motion, at_rest, avatar.subject, avatar.face_model.expression_bounds)

    def pictures():
        for timestep in range(len(driven)):
            gaussians = avatar.pose(driven[timestep]).gaussians.timestep(0)
            image = rasterize(gaussians, camera, background=torch.ones(3)).image
            right = (image.clamp(0, 1) * 255 + 0.5).to(torch.uint8).numpy()
            left = np.asarray(driver.capture.images[timestep, 0])
            height = min(left.shape[0], right.shape[0])
            yield np.concatenate([left[:height], right[:height]], axis=1)

    options.out.parent.mkdir(parents=True, exist_ok=True)
    write_video(options.out, pictures(), driver.capture.fps)
    print(f"wrote {options.out}: {len(driven)} frames")


if __name__ == "__main__":
    main()
