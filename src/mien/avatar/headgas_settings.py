"""The settings of HeadGaS."""

from dataclasses import dataclass, field
from typing import Annotated

from mien.avatar.schedules import Rate
from mien.avatar.settings import GradientSettings, MethodConfig
from mien.ranges import Range, ToLoad


def _density() -> GradientSettings:
    return GradientSettings(opacity_resets=(), max_gaussians=8_000)


@dataclass(frozen=True)
class HeadGasConfig(MethodConfig):
    """Settings of HeadGaS. The defaults suit a CPU and runs of some thousand steps."""

    points: Annotated[int, Range(4, 1_000_000), ToLoad(4)] = 2500
    """Number of Gaussians at the start, sampled on the subject's mesh."""
    features: Annotated[int, Range(1, 1024)] = 16
    """Number of latent features per Gaussian (paper: 32). More features need more memory and time per step."""
    directions: Annotated[int, Range(0, 1024)] = 0
    """Number of directions of the face along which features change: those of the largest spread over the training
    timesteps. 0 means as many as the face has inputs (expression coefficients and angles of joints), as in the paper.
    Fewer need less memory and time per step; a finished avatar follows all inputs either way."""
    hidden: Annotated[int, Range(1, 4096)] = 64
    """Width of the network's only hidden layer."""
    encoding_bands: Annotated[int, Range(0, 24)] = 4
    """Number of octaves of the positional encoding."""
    encoding_length: Annotated[float, Range(1e-4, 1e4)] = 0.05
    """Length of one unit in the positional encoding, in metres."""
    sh_degree: Annotated[int, Range(0, 3)] = 0
    """Degree of the spherical harmonics for view-dependent colour (paper: 3). Keep 0 with a single camera, because
    view-dependent colours then absorb the head's pose."""
    means_rate: Rate = Rate(1e-4, 1e-6)
    """Learning rate of the centres, in metres per step."""
    log_scales_rate: Rate = Rate(5e-3)
    """Learning rate of the logarithms of the scales, per step."""
    quats_rate: Rate = Rate(1e-3)
    """Learning rate of the rotations (quaternions), per step."""
    features_rate: Rate = Rate(2.5e-3)
    """Learning rate of the feature bases and of the neutral features, per step."""
    network_rate: Rate = Rate(2e-3, 2e-4)
    """Learning rate of the network, per step."""
    density: GradientSettings = field(default_factory=_density)
    """Density control: when and where Gaussians are added and removed. Opacities come from the network and are never
    reset. The first of `opacity_resets` after `start` still sets when large Gaussians are removed."""


PRESETS = {"draft": HeadGasConfig(directions=20), "standard": HeadGasConfig(directions=20)}
"""Settings of this method for each preset. They are equal: a draft is only a shorter run."""
