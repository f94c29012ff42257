"""The settings of the textured mesh."""

from dataclasses import dataclass
from typing import Annotated

from mien.avatar.settings import GAUSSIAN_COUNT, FaceTuning, MethodConfig, Photometric
from mien.disk.config import Range, ToLoad


@dataclass(frozen=True)
class TexturedMeshConfig(MethodConfig):
    """Settings of the textured mesh. The defaults suit one fixed camera and runs of some thousand steps."""

    photometric: Photometric = Photometric(alpha_weight=1.0, part_weight=1.0)
    """Losses of pictures. That of alpha draws the surface to the outline of the hair."""
    face_tuning: FaceTuning = FaceTuning(keep_mean_pose=True, keep_turns=True)
    surfels: Annotated[int, GAUSSIAN_COUNT, ToLoad(1)] = 60_000
    """About the number of surfels, at least one for each triangle."""
    smoothing: Annotated[int, Range(0, 1_000)] = 8
    """Number of times that a vertex's offset and colour are averaged with its neighbours'."""
