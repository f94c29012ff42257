"""The settings of the textured mesh."""

from dataclasses import dataclass
from typing import Annotated, Literal

from mien.avatar.settings import GAUSSIAN_COUNT, FaceTuning, MethodConfig, Photometric, Rate
from mien.disk.config import NOT_NEGATIVE, Range, ToLoad


@dataclass(frozen=True)
class TexturedMeshConfig(MethodConfig):
    """Settings of the textured mesh. The defaults suit one fixed camera and runs of some thousand steps."""

    photometric: Photometric = Photometric(alpha_weight=1.0, part_weight=1.0)
    """Weights of the losses that compare a rendering with its target. The loss of alpha draws the surface to the
    outline of the hair."""
    face_tuning: FaceTuning = FaceTuning(keep_mean_pose=True, keep_turns=True)
    """Whether and how fast training changes the tracked face parameters of each frame."""
    surfels: Annotated[int, GAUSSIAN_COUNT, ToLoad(1)] = 60_000
    """About the number of surfels, which are as large on all triangles. Each triangle has at least one."""
    overlap: Annotated[float, Range(0.5, 10)] = 2.5
    """Scales of a surfel, in standard deviations of the part of its triangle that it covers. Below about 2.3, what is
    behind the mesh shows through."""
    light: Literal["head", "world"] = "head"
    """Frame of the light and of the normals. head: the normals are those of the face at rest, so that colours are
    constant, and the light turns with the head. world: normals follow the face and the head, and the light stays where
    it is; such an avatar cannot be exported."""
    smoothing: Annotated[int, Range(0, 1_000)] = 8
    """Number of times that each vertex's offset and colour are averaged with those of its neighbours. More makes
    smoother surfaces, and what is shown spreads further over what no picture shows."""
    offset_rate: Rate = Rate(2e-4, 2e-5)
    """Learning rate of the vertices' offsets, in metres per step."""
    albedo_rate: Rate = Rate(2e-2, 2e-3)
    """Learning rate of the albedos of surfels and vertices, as logits, per step."""
    normal_rate: Rate = Rate(1e-2, 1e-3)
    """Learning rate of the normal map, per step."""
    light_rate: Rate = Rate(5e-3, 5e-4)
    """Learning rate of the light's coefficients, per step."""
    offset_weight: Annotated[float, NOT_NEGATIVE] = 0.02
    """Weight of the mean squared distance of a vertex's offset from the mean of its neighbours', in square
    millimetres."""
    albedo_weight: Annotated[float, NOT_NEGATIVE] = 0.003
    """Weight of the mean squared difference of surfels' albedos from that of the vertices, and of those from the mean
    of their neighbours', as logits. It gives sides that no picture shows the colours of what is beside them."""
    normal_weight: Annotated[float, NOT_NEGATIVE] = 0.01
    """Weight of the mean squared slope by which the normal map bends normals."""
    light_weight: Annotated[float, NOT_NEGATIVE] = 0.01
    """Weight of the mean squared difference of the light's coefficients from white light from everywhere. Without it,
    colours of skin and light can be exchanged, and sides that no picture shows have any light."""
