"""Every back end that runs here draws the same picture as another program (gsplat)."""

import math
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from mien.camera import camera_from_fov
from mien.gaussians import Gaussians
from mien.render.rasterize import Backend
from rasterize_scenes import GSPLAT
from rasterize_scenes import rasterize_anywhere as rasterize


@pytest.mark.parametrize("backend", ["reference", "native", GSPLAT])
def test_tiny_case_matches_the_picture_that_gsplat_made(test_data: Path, backend: Backend) -> None:
    stored = load_file(test_data / "golden" / "tiny_case.safetensors")
    viewmat = torch.eye(4)
    viewmat[:3, 3] = -torch.tensor([0.123, 0.456, -8.0])
    camera = camera_from_fov(math.pi / 2, 123, 82, viewmat)
    gaussians = Gaussians(
        stored["means"], stored["quats"], stored["scales"].exp(), stored["opacities"].sigmoid(), stored["coeffs"]
    )
    rendering = rasterize(gaussians, camera, torch.zeros(3), backend=backend)
    picture = torch.cat([rendering.image, rendering.alpha[..., None]], -1)
    # Measured 1e-6: the same arithmetic in another order; 1e-4 would show a wrong constant (dilation, cutoff, clamp).
    torch.testing.assert_close(picture, stored["out_img"], rtol=0, atol=1e-5)
