"""The settings of MonoGaussianAvatar."""

from dataclasses import dataclass, field
from typing import Annotated

from mien.avatar.schedules import Rate
from mien.avatar.settings import GAUSSIAN_COUNT, MethodConfig, Photometric
from mien.ranges import NOT_NEGATIVE, Range, ToLoad

_WIDTH = Range(1, 1024)


def _photometric() -> Photometric:
    return Photometric(l1_weight=1.0, ssim_weight=0.25)


@dataclass(frozen=True)
class MonoGaussianAvatarConfig(MethodConfig):
    """Settings of MonoGaussianAvatar. The defaults suit a CPU and runs of some thousand steps."""

    photometric: Photometric = field(default_factory=_photometric)
    """Weights of the losses that compare a rendering with its target. The weights of L1 and 1 - SSIM are the
    paper's."""
    points: Annotated[int, Range(1, 1_000_000), ToLoad(1)] = 400
    """Number of Gaussians at the start, on a sphere."""
    sphere_radius: Annotated[float, Range(1e-3, 10)] = 0.125
    """Radius of the initial sphere around the origin of the head frame, in metres."""
    max_points: Annotated[int, GAUSSIAN_COUNT] = 6_000
    """Largest number of Gaussians. Growth stops there (paper: 100,000)."""
    rounds: Annotated[int, Range(1, 100_000)] = 50
    """Number of equal parts of the run. Points are pruned and refilled after each part except the last (paper: 100
    parts of one epoch)."""
    attribute_width: Annotated[int, Range(40, 1024)] = 64
    """Width of the attribute network (paper: 256)."""
    attribute_layers: Annotated[int, Range(1, 32)] = 4
    """Number of layers of the attribute network (paper: 7)."""
    deformation_width: Annotated[int, _WIDTH] = 64
    """Width of the deformation network (paper: 128)."""
    change_width: Annotated[int, _WIDTH] = 32
    """Width of the network that changes attributes with motion (paper: 64)."""
    scale_gain: Annotated[float, Range(0, 1000)] = 0.00625
    """Largest scale that the networks add to the radius that all points share, in metres (paper: 0.0025 for pictures of
    1024x1024)."""
    means_rate: Rate = Rate(1e-4, 1e-5)
    """Learning rate of the points, in metres per step."""
    network_rate: Rate = Rate(1e-3, 1e-4)
    """Learning rate of the networks, per step (paper: 1e-4, over some hundred thousand steps)."""
    face_weight: Annotated[float, NOT_NEGATIVE] = 10.0
    """Weight of the losses that keep points near the face model. It halves at 0.2, 0.3, 0.5 and 0.7 of the run."""
    face_points: Annotated[int, GAUSSIAN_COUNT] = 512
    """Number of points that these losses use in each step, in turn."""


PRESETS = {"draft": MonoGaussianAvatarConfig(), "standard": MonoGaussianAvatarConfig()}
"""Settings of this method for each preset. They are equal: a draft is only a shorter run."""
