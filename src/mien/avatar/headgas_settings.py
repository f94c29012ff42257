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
    """Settings of HeadGaS; defaults suit a CPU and runs of some thousand steps."""

    points: Annotated[int, Range(4, 1_000_000), ToLoad(4)] = 2500
    """Number of Gaussians to begin with, sampled on the subject's mesh."""
    features: Annotated[int, Range(1, 1024)] = 16
    """Number of latent features of each Gaussian (paper: 32). Memory and time of a step grow with it."""
    hidden: Annotated[int, Range(1, 4096)] = 64
    """Width of the network's one hidden layer."""
    encoding_bands: Annotated[int, Range(0, 24)] = 4
    """Number of octaves of the positional encoding."""
    encoding_length: Annotated[float, Range(1e-4, 1e4)] = 0.05
    """Length that counts as one unit in the positional encoding, in metres."""
    sh_degree: Annotated[int, Range(0, 3)] = 0
    """Degree of the spherical harmonics that colour depends on the view by (paper: 3). With one camera, colours that
    depend on the view absorb the head's pose: keep 0."""
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
    """Density control: when and where Gaussians grow and are removed. Opacities come from the network, so none is ever
    reset; the first of `opacity_resets` still says when large Gaussians begin to be removed."""


PRESETS = {"draft": HeadGasConfig(), "standard": HeadGasConfig()}
"""What the presets mean for this method: a draft is only shorter."""
