"""The settings of MonoGaussianAvatar."""

from dataclasses import dataclass, field
from typing import Annotated

from mien.avatar.schedules import Rate
from mien.avatar.settings import MAX_GAUSSIANS, MethodConfig, Photometric
from mien.ranges import NOT_NEGATIVE, Range, ToLoad

_WIDTH = Range(1, 1024)


def _photometric() -> Photometric:
    return Photometric(l1_weight=1.0, ssim_weight=0.25)


@dataclass(frozen=True)
class MonoGaussianAvatarConfig(MethodConfig):
    """Settings of MonoGaussianAvatar; defaults suit a CPU and runs of some thousand steps."""

    photometric: Photometric = field(default_factory=_photometric)
    """Weights of the losses that compare a rendering with its target; those of L1 and 1 - SSIM are the paper's."""
    points: Annotated[int, Range(1, 1_000_000), ToLoad(1)] = 400
    """Number of Gaussians to begin with, on a sphere."""
    sphere_radius: Annotated[float, Range(1e-3, 10)] = 0.125
    """Radius of that sphere about the origin of the head frame, in metres."""
    max_points: Annotated[int, MAX_GAUSSIANS] = 6_000
    """Growth stops at this number of Gaussians (paper: 100,000)."""
    rounds: Annotated[int, Range(1, 100_000)] = 50
    """Number of equal parts of the run. After each but the last, points are pruned and refilled (paper: 100, one part
    an epoch)."""
    attribute_width: Annotated[int, Range(40, 1024)] = 64
    """Width of the attribute network (paper: 256)."""
    attribute_layers: Annotated[int, Range(1, 32)] = 4
    """Number of layers of the attribute network (paper: 7)."""
    deformation_width: Annotated[int, _WIDTH] = 64
    """Width of the deformation network (paper: 128)."""
    change_width: Annotated[int, _WIDTH] = 32
    """Width of the network that changes attributes with motion (paper: 64)."""
    scale_gain: Annotated[float, Range(0, 1000)] = 0.00625
    """The largest scale that the networks add to the radius that all points share, in metres (paper: 0.0025 for
    pictures of 1024x1024)."""
    means_rate: Rate = Rate(1e-4, 1e-5)
    """Learning rate of the points, in metres per step."""
    network_rate: Rate = Rate(1e-3, 1e-4)
    """Learning rate of the networks, per step (paper: 1e-4, over some hundred thousand steps)."""
    face_weight: Annotated[float, NOT_NEGATIVE] = 10.0
    """Weight of staying near the face model. It halves at 0.2, 0.3, 0.5 and 0.7 of the run."""
    face_points: Annotated[int, MAX_GAUSSIANS] = 512
    """Number of points that are held near the face model in each step, in turn."""


PRESETS = {"draft": MonoGaussianAvatarConfig(), "standard": MonoGaussianAvatarConfig()}
"""What the presets mean for this method: a draft is only shorter."""
