"""The settings of GaussianAvatars."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

from mien.avatar.schedules import Rate
from mien.avatar.settings import GradientSettings, MethodConfig
from mien.ranges import FRACTION, NOT_NEGATIVE, Range


@dataclass(frozen=True)
class GaussianAvatarsConfig(MethodConfig):
    """Settings of GaussianAvatars. The defaults suit one fixed camera and runs of some thousand steps."""

    sh_degree: Annotated[int, Range(0, 3)] = 0
    """Degree of the spherical harmonics for view-dependent colour. Keep 0 with a single camera, because view-dependent
    colours then absorb the head's pose."""
    sh_frame: Literal["world", "head"] = "world"
    """Frame in which spherical harmonics are evaluated: world, as in the paper, or head, where light turns with the
    head."""
    sh_warmup: Annotated[float, FRACTION] = 0.3
    """Fraction of the run over which the degrees of the spherical harmonics are switched on, one after the other."""
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
    """Learning rate of the constant colour coefficients, per step. Coefficients of higher degrees have a constant rate:
    a twentieth of the start of this rate."""
    expression_rank: Annotated[int, Range(0, 8)] = 0
    """Number of activations of the face with which colour, opacity and place of each Gaussian change, for what the mesh
    cannot say, such as wrinkles. 0 is the paper's method, without such changes."""
    expression_colour_rate: Rate = Rate(1e-3)
    """Learning rate of the changes of colour with the expression, in colour coefficients per unit of an activation and
    step. If its start is 0, colours do not change."""
    expression_opacity_rate: Rate = Rate(0.01)
    """Learning rate of the changes of opacity (logits) with the expression, per unit of an activation and step. If its
    start is 0, opacities do not change."""
    expression_offset_rate: Rate = Rate(1e-3, 1e-5)
    """Learning rate of the changes of place with the expression, in triangle units per unit of an activation and step.
    If its start is 0, places do not change."""
    expression_weight: Annotated[float, NOT_NEGATIVE] = 3.0
    """Weight of the mean squared changes with the expression, which keeps changes small that pictures do not need."""
    position_threshold: Annotated[float, NOT_NEGATIVE] = 1.0
    """Distance from the triangle's centre up to which a Gaussian's centre has no penalty, in triangle units."""
    position_weight: Annotated[float, NOT_NEGATIVE] = 0.01
    """Weight of the position penalty, which is the distance beyond the position threshold."""
    scale_threshold: Annotated[float, NOT_NEGATIVE] = 0.6
    """Scale up to which a Gaussian has no penalty, in triangle units."""
    scale_weight: Annotated[float, NOT_NEGATIVE] = 1.0
    """Weight of the scale penalty, which is the scale beyond the scale threshold."""
    density: GradientSettings = field(default_factory=GradientSettings)
    """Density control: when and where Gaussians are added and removed."""


PRESETS = {"draft": GaussianAvatarsConfig(), "standard": GaussianAvatarsConfig()}
"""Settings of this method for each preset. They are equal: a draft is only a shorter run."""
