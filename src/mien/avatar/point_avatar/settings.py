"""The settings of PointAvatar."""

from dataclasses import dataclass
from typing import Annotated, Literal

from mien.avatar.settings import (
    FREE_POINTS_PAPER_FEATURES,
    GAUSSIAN_COUNT,
    Differences,
    FreePointsConfig,
    Photometric,
    Rate,
    free_points_paper,
)
from mien.disk.config import NOT_NEGATIVE, Range, ToLoad

_WIDTH = Range(1, 1024)


@dataclass(frozen=True)
class PointAvatarConfig(FreePointsConfig):
    """Settings of PointAvatar. The defaults suit a CPU and runs of some thousand steps.

    They add to the paper: points start on the face (`start`), networks learn the motion of the face model before the
    first picture (`pretraining`), and normals are those of the canonical face (`normals`), which can be exported.
    """

    photometric: Photometric = Photometric(l1_weight=1.0, ssim_weight=0.25, alpha_weight=1.0)
    """Losses of pictures. The paper has no SSIM."""
    points: Annotated[int, Range(1, 1_000_000), ToLoad(1)] = 5_000
    max_points: Annotated[int, GAUSSIAN_COUNT] = 40_000
    epochs: Annotated[int, Range(1, 100_000)] = 40
    """Number of epochs of the run. After each, points that no picture showed are replaced, up to the next number."""
    growth_epochs: Annotated[int, Range(1, 100_000)] = 5
    """Number of epochs after which the number of points doubles, and all get smaller."""
    first_radius: Annotated[float, Range(1e-4, 1)] = 0.0375
    """Radius of all points if there were 100 of them, in metres."""
    radius_factor: Annotated[float, Range(0.01, 1)] = 0.75
    """Factor on the radius each time that the number of points doubles."""
    normals: Literal["canonical", "deformed"] = "canonical"
    """Normals that light is computed from: those of the points at rest (canonical), or of the moved points in the
    world, as in the paper (deformed), which cannot be exported."""
    surface_width: Annotated[int, _WIDTH] = 64
    """Width of the network that gives albedo and the distance to the surface."""
    surface_layers: Annotated[int, Range(1, 32)] = 3
    """Number of layers of that network before its outputs."""
    encoding_bands: Annotated[int, Range(0, 24)] = 6
    """Number of octaves of that network's encoding of positions."""
    shading_width: Annotated[int, _WIDTH] = 32
    """Width of the network that turns normals into light."""
    network_rate: Rate = Rate(1e-3, 1e-4)
    face_expression_weight: Annotated[float, NOT_NEGATIVE] = 1e3
    face_correctives_weight: Annotated[float, NOT_NEGATIVE] = 1e3
    distance_weight: Annotated[float, NOT_NEGATIVE] = 1.0
    """Weight of the mean squared distance of points from the surface, in units of 0.25 m."""
    slope_weight: Annotated[float, NOT_NEGATIVE] = 0.1
    """Weight of the mean squared difference of the distance's slope from 1, which makes it a distance."""
    closing: Annotated[int, Range(0, 15)] = 1
    """Pixels by which finished pictures are eroded and then dilated, which closes holes up to twice as wide."""


_PAPER_EPOCHS, _PAPER_FRAMES = 60, 2_500
"""The preset `paper` is a video of 100 seconds, over as many epochs as the number of points needs and 20 more."""
_PAPER = {
    **free_points_paper(_PAPER_EPOCHS),
    "photometric": {"ssim_weight": 0.0, "perceptual": FREE_POINTS_PAPER_FEATURES},
    "frames_per_step": 1,
    "normals": "deformed",
    "surface_width": 256,
    "surface_layers": 7,
    "shading_width": 64,
    "means_rate": {"start": 2.5e-5, "end": None},
}

PRESETS: dict[str, Differences] = {
    "paper": {"method": _PAPER, "settings": {"steps": _PAPER_EPOCHS * _PAPER_FRAMES}},
}
"""How presets differ from the defaults. A draft is only a shorter run."""
