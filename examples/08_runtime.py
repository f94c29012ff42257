"""Load, pose and render a .mien file with the base install alone: numpy and the native core.

mien export out/examples/subject --out out/examples/avatar.mien
python examples/08_runtime.py out/examples/avatar.mien --out out/examples/frames
"""

import argparse
import math
import time
from pathlib import Path

import numpy as np

from mien import runtime
from mien.media.pixels import png_bytes, to_rgb


def main() -> None:
    """Render a jaw that opens and closes while the head turns, one PNG per frame, and report the time per frame."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("avatar", type=Path, help="a .mien file")
    parser.add_argument("--out", type=Path, required=True, help="folder for the pictures")
    parser.add_argument("--frames", type=int, default=25, help="number of frames")
    parser.add_argument("--size", type=int, default=256, help="side of the pictures in pixels")
    options = parser.parse_args()

    avatar = runtime.load(options.avatar)
    camera = avatar.camera.resized(options.size, options.size)
    at_rest = avatar.face()
    options.out.mkdir(parents=True, exist_ok=True)
    seconds = 0.0
    for frame in range(options.frames):
        phase = 2 * math.pi * frame / options.frames
        began = time.perf_counter()
        gaussians = avatar.pose(
            {"jawOpen": 0.25 * (1 - math.cos(phase))},
            head_rotation=at_rest.head_rotation + np.array([0, 0.2 * math.sin(phase), 0], np.float32),
        )
        image, _alpha = avatar.render(gaussians, camera, background=(1, 1, 1))
        seconds += time.perf_counter() - began
        (options.out / f"{frame:06d}.png").write_bytes(png_bytes(to_rgb(image)))
    print(f"wrote {options.out}: {options.frames} pictures, {1000 * seconds / options.frames:.1f} ms per frame")


if __name__ == "__main__":
    main()
