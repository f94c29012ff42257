"""The settings of GaussianAvatars."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

from mien.avatar.schedules import Rate
from mien.avatar.settings import GradientSettings, MethodConfig
from mien.ranges import FRACTION, NOT_NEGATIVE, Range


@dataclass(frozen=True)
class GaussianAvatarsConfig(MethodConfig):
    """Settings of GaussianAvatars; defaults suit one fixed camera and runs of some thousand steps."""

    sh_degree: Annotated[int, Range(0, 3)] = 0
    """Degree of the spherical harmonics that colour depends on the view by. With one camera, colours that depend on
    the view absorb the head's pose: keep 0."""
    sh_frame: Literal["world", "head"] = "world"
    """Frame in which spherical harmonics are evaluated. world: as in the paper; head: light turns with the head."""
    sh_warmup: Annotated[float, FRACTION] = 0.3
    """Fraction of the run over which the degrees are switched on, one after the other."""
    means_rate: Rate = Rate(5e-3, 5e-5)
    """Learning rate of the centres, in triangle units per step. The paper multiplies it by the extent of the cameras,
    which is 0 for one camera; here the factor is 1."""
    log_scales_rate: Rate = Rate(0.017)
    """Learning rate of the logarithms of the scales, per step."""
    quats_rate: Rate = Rate(1e-3)
    """Learning rate of the rotations (quaternions), per step."""
    opacity_rate: Rate = Rate(0.05)
    """Learning rate of the opacities (logits), per step."""
    colour_rate: Rate = Rate(2.5e-3)
    """Learning rate of the constant colour coefficients, per step. Those of higher degrees learn at a constant
    twentieth of its start."""
    position_threshold: Annotated[float, NOT_NEGATIVE] = 1.0
    """Distance from the triangle's centre up to which a Gaussian's centre costs nothing, in triangle units."""
    position_weight: Annotated[float, NOT_NEGATIVE] = 0.01
    """Weight of the position penalty: the distance beyond that threshold."""
    scale_threshold: Annotated[float, NOT_NEGATIVE] = 0.6
    """Scale up to which a Gaussian costs nothing, in triangle units."""
    scale_weight: Annotated[float, NOT_NEGATIVE] = 1.0
    """Weight of the scale penalty: how far scales exceed that threshold."""
    density: GradientSettings = field(default_factory=GradientSettings)
    """Density control: when and where Gaussians grow and are removed."""


PRESETS = {"draft": GaussianAvatarsConfig(), "standard": GaussianAvatarsConfig()}
"""What the presets mean for this method: a draft is only shorter."""
