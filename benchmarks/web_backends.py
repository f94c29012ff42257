"""Measure how long the web runtime takes for a picture with WebGL2 and WebGPU, both in software, and print a table.

    PYTHONPATH=tests python benchmarks/web_backends.py     # some minutes; needs what the tests of the page need

A picture is finished when a pixel of it has been read back. "Hand over" is the time until the page can go on. At 16x16
pixels, few pixels are blended. Figures are the least of some pictures, because other work may
run beside them.
"""

import argparse
import tempfile
from collections.abc import Callable
from pathlib import Path

from mien.formats.page import write_packed
from mien.runtime.baked import PortableAvatar
from test_web import skinned_head
from test_web_page import PAGE, opened
from web_case import browse, build, drawn_head, painted_head, script, served

HEADS: dict[str, Callable[[], PortableAvatar]] = {
    "gaussian_avatars, 40,000": lambda: drawn_head(40_000, rank=8),
    "gaussian_avatars, 100,000": lambda: drawn_head(100_000, rank=8),
    "headgas, 20,000": lambda: painted_head(20_000),
    "mono_gaussian_avatar, 4,000": skinned_head,
}
MEASURE = """
const { canvas } = viewer, pixel = new OffscreenCanvas(1, 1).getContext("2d", { willReadFrequently: true });
[canvas.width, canvas.height] = [SIDE, SIDE];
const least = (act) => {
  const times = Array.from({ length: FRAMES }, (_, i) => {
    act(i);
    const began = performance.now();
    viewer.draw();
    const handed = performance.now() - began;
    pixel.drawImage(canvas, SIDE / 2, SIDE / 2, 1, 1, 0, 0, 1, 1);
    pixel.getImageData(0, 0, 1, 1);
    return [handed, performance.now() - began];
  }).slice(1);
  return [0, 1].map((k) => Math.min(...times.map((time) => time[k])));
};
return [
  ...least((i) => { viewer.yaw = 0.02 * i; viewer.look(); }),
  ...least((i) => viewer.setExpression("jawOpen", 0.02 + 0.04 * i)),
];
"""


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=9, help="pictures of each kind; the first is not counted")
    parser.add_argument("--heads", nargs="+", default=list(HEADS), choices=list(HEADS), help="avatars (default: all)")
    parser.add_argument("--sides", type=int, nargs="+", default=[512, 16], help="sides of the pictures, in pixels")
    args = parser.parse_args()
    print("| avatar | picture | back end | turn: hand over | turn: picture | new face: hand over | new face: picture |")
    print("|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as name:
        site = build(Path(name))
        (site / "index.html").write_text(PAGE)
        for head in args.heads:
            write_packed(site / "a.packed", HEADS[head]())
            for side in args.sides:
                for backend in ("webgl2", "webgpu"):
                    measure = MEASURE.replace("SIDE", str(side)).replace("FRAMES", str(args.frames))
                    with served(site) as address:
                        page = f"{address}/index.html"
                        told = browse(page, [script(opened("a", backend)), script(measure)], webgpu=True)
                    times = " | ".join(f"{time:.1f} ms" for time in told["results"][1])
                    print(f"| {head} | {side}x{side} | {backend} | {times} |", flush=True)


if __name__ == "__main__":
    main()
