"""Fit 3D Gaussians to one picture by gradient descent, with the differentiable renderer alone. It needs no data.

python examples/01_fit_gaussians.py --out out/examples/fit.png
"""

import argparse
from pathlib import Path

import cv2
import numpy as np
import torch

from mien.camera import camera_from_fov
from mien.gaussians import Gaussians
from mien.render import rasterize

SIZE = 128


def target_picture() -> torch.Tensor:
    """Return a disc with a colour gradient on black, [H, W, 3] in 0..1."""
    rows, columns = torch.meshgrid(torch.linspace(-1, 1, SIZE), torch.linspace(-1, 1, SIZE), indexing="ij")
    inside = (rows**2 + columns**2 < 0.5).float()
    return torch.stack([inside, inside * (columns + 1) / 2, inside * (rows + 1) / 2], dim=-1)


def main() -> None:
    """Optimise positions, sizes, opacities and colours, and write target and result side by side."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="picture to write")
    parser.add_argument("--gaussians", type=int, default=600, help="number of Gaussians")
    parser.add_argument("--steps", type=int, default=200, help="optimiser steps")
    options = parser.parse_args()

    torch.manual_seed(0)
    torch.set_num_threads(1)  # mien's native operations have threads of their own: MIEN_THREADS
    n = options.gaussians
    camera = camera_from_fov(0.6, SIZE, SIZE)  # at the origin, looks along +z; units are metres and radians
    means = (torch.rand(n, 3) * 0.6 + torch.tensor([-0.3, -0.3, 0.7])).requires_grad_()
    log_scales = torch.full((n, 3), -4.5, requires_grad=True)
    opacity_logits = torch.zeros(n, requires_grad=True)
    sh = torch.zeros(n, 1, 3, requires_grad=True)  # degree 0: one colour per Gaussian, 0.5 + 0.282 sh
    quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(n, 1)  # wxyz

    target = target_picture()
    picture = torch.zeros_like(target)
    optimizer = torch.optim.Adam([means, log_scales, opacity_logits, sh], lr=0.02)
    for step in range(options.steps):
        gaussians = Gaussians(means, quats, log_scales.exp(), opacity_logits.sigmoid(), sh)
        picture = rasterize(gaussians, camera, background=torch.zeros(3)).image
        loss = (picture - target).abs().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if step % 50 == 0 or step == options.steps - 1:
            print(f"step {step}: mean absolute error {loss.item():.4f}")

    both = torch.cat([target, picture.detach()], dim=1).clamp(0, 1).numpy()
    options.out.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(options.out), (both[:, :, ::-1] * 255 + 0.5).astype(np.uint8))
    print(f"wrote {options.out}: target | fit")


if __name__ == "__main__":
    main()
