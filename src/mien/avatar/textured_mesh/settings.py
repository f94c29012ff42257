"""The settings of the textured mesh."""

from dataclasses import dataclass
from typing import Annotated, Literal

from mien.avatar.settings import GAUSSIAN_COUNT, FaceTuning, MethodConfig, Photometric, Rate
from mien.disk.config import NOT_NEGATIVE, Range, ToLoad


@dataclass(frozen=True)
class TexturedMeshConfig(MethodConfig):
    """Settings of the textured mesh. The defaults suit one fixed camera and runs of some thousand steps."""

    photometric: Photometric = Photometric(alpha_weight=1.0, part_weight=1.0)
    """Losses of pictures. That of alpha draws the surface to the outline of the hair."""
    face_tuning: FaceTuning = FaceTuning(keep_mean_pose=True, keep_turns=True)
    surfels: Annotated[int, GAUSSIAN_COUNT, ToLoad(1)] = 60_000
    """About the number of surfels, at least one for each triangle."""
    overlap: Annotated[float, Range(0.5, 10)] = 2.5
    """Scales of a surfel, in standard deviations of what it covers. Below about 2.3, what is behind shows through."""
    light: Literal["head", "world"] = "head"
    """Frame of light and normals: head, with constant colours, or world, where light stays while a head turns; such an
    avatar cannot be exported."""
    smoothing: Annotated[int, Range(0, 1_000)] = 8
    """Number of times that a vertex's offset and colour are averaged with its neighbours'."""
    offset_rate: Rate = Rate(2e-4, 2e-5)
    """Learning rate of the vertices' offsets, in metres per step."""
    albedo_rate: Rate = Rate(2e-2, 2e-3)
    """Learning rate of the albedos of surfels and vertices, as logits, per step."""
    normal_rate: Rate = Rate(1e-2, 1e-3)
    """Learning rate of the normal map, per step."""
    light_rate: Rate = Rate(5e-3, 5e-4)
    """Learning rate of the light's coefficients, per step."""
    offset_weight: Annotated[float, NOT_NEGATIVE] = 0.02
    """Weight of the mean squared distance of offsets from the mean of their neighbours', in square millimetres."""
    albedo_weight: Annotated[float, NOT_NEGATIVE] = 0.003
    """Weight of the mean squared difference of albedos of surfels and vertices, and of neighbours, as logits."""
    normal_weight: Annotated[float, NOT_NEGATIVE] = 0.01
    """Weight of the mean squared slope by which the normal map bends normals."""
    light_weight: Annotated[float, NOT_NEGATIVE] = 0.01
    """Weight of the mean squared difference from white light. Without it, skin and light can be exchanged."""
