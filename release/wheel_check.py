"""Checks an installed wheel: the native core loads, draws, and gives the same bytes for one and three threads.

Run it with the interpreter that the wheel was installed for. It needs nothing but the wheel and what it asks for.
"""

import sys

import numpy as np

from mien import _native, runtime


def scene(count: int) -> runtime.Gaussians:
    """A cloud of Gaussians half a metre before the camera."""
    rng = np.random.default_rng(0)
    means = rng.normal(0, 0.05, (count, 3)).astype(np.float32)
    quats = rng.normal(size=(count, 4)).astype(np.float32)
    scales = np.exp(rng.normal(-5, 0.3, (count, 3))).astype(np.float32)
    opacities, sh = rng.uniform(0.1, 1, count).astype(np.float32), rng.normal(0, 0.5, (count, 1, 3)).astype(np.float32)
    return runtime.Gaussians(means, quats, scales, opacities, sh)


def main() -> None:
    """Draw a picture on every number of threads, and compare."""
    K = np.array([[300, 0, 64], [0, 300, 64], [0, 0, 1]], np.float32)
    viewmat = np.eye(4, dtype=np.float32)
    viewmat[2, 3] = 0.5
    camera, pictures = runtime.Camera(K, viewmat, 128, 128), []
    for threads in (1, 3):
        _native.set_thread_count(threads)
        image, alpha = runtime.render(scene(2000), camera)
        assert 0.05 < alpha.mean() < 0.95, f"the picture is empty or full: {alpha.mean()}"
        pictures.append(image.tobytes())
    assert pictures[0] == pictures[1], "another number of threads gives other bytes"
    print(f"Python {sys.version.split()[0]}, kernels {_native.rasterize_isa()}: drawn")


if __name__ == "__main__":
    main()
