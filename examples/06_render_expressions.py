"""Render a trained avatar: one row of expressions, one row of views.

python examples/06_render_expressions.py out/examples/subject --out out/examples/expressions.png
"""

import argparse
import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch

from mien.avatar import load_avatar
from mien.disk.workspace import open_workspace
from mien.render import rasterize
from mien.render.camera_paths import orbit
from mien.training.run import run_camera

EXPRESSIONS = {"jawOpen": 0.5, "mouthSmileLeft": 0.8, "eyeBlinkLeft": 1.0, "browInnerUp": 0.8}
ANGLES = (-20, -7, 7, 20)


@torch.no_grad()
def main() -> None:
    """Pose the avatar, render it, and write a sheet of pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("workspace", type=Path, help="workspace of the avatar")
    parser.add_argument("--run", default=None, help="name of the run; the only one by default")
    parser.add_argument("--out", type=Path, required=True, help="picture to write")
    parser.add_argument("--size", type=int, default=256, help="side of each picture in pixels")
    options = parser.parse_args()

    torch.set_num_threads(1)
    workspace = open_workspace(options.workspace)
    run_dir = workspace.run_dir(workspace.pick_run(options.run))
    avatar = load_avatar(run_dir)
    camera = run_camera(run_dir).resized(options.size, options.size)
    at_rest = avatar.subject  # FaceParams of one timestep: this person's identity, neutral expression and pose

    top = []
    for name, amount in EXPRESSIONS.items():
        expression = at_rest.expression.clone()
        expression[:, avatar.face_model.expression_names.index(name)] = amount
        posed = avatar.pose(replace(at_rest, expression=expression))
        top.append(rasterize(posed.gaussians.timestep(0), camera, background=torch.ones(3)).image)

    gaussians = avatar.pose(at_rest).gaussians.timestep(0)
    views = [orbit(camera, at_rest.head_translation[0], math.radians(angle)) for angle in ANGLES]
    bottom = [rasterize(gaussians, view, background=torch.ones(3)).image for view in views]

    sheet = torch.cat([torch.cat(top, dim=1), torch.cat(bottom, dim=1)]).clamp(0, 1).numpy()
    options.out.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(options.out), (sheet[:, :, ::-1] * 255 + 0.5).astype(np.uint8))
    print(f"wrote {options.out}: {', '.join(EXPRESSIONS)}; views from {ANGLES} degrees")


if __name__ == "__main__":
    main()
