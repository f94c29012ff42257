"""The settings of MonoGaussianAvatar."""

from dataclasses import dataclass
from typing import Annotated, Literal

from mien.avatar.settings import (
    EPSILON_RANGE,
    FREE_POINTS_PAPER_FEATURES,
    Differences,
    FreePointsConfig,
    Photometric,
    Rate,
    free_points_paper,
)
from mien.disk.config import NotBelow, Range

LENGTH_UNIT = 0.25
"""Unit of length, in metres. The paper's head model is four times life size, and its radii and weights fit that."""
_WIDTH = Range(1, 1024)
WeightNorm = Literal["trunks", "code", "paper"]
"""The layers of the networks that have weight normalisation."""


@dataclass(frozen=True)
class MonoGaussianAvatarConfig(FreePointsConfig):
    """Settings of MonoGaussianAvatar. The defaults suit a CPU and runs of some thousand steps.

    They add to the paper: points start on the face (`start`), networks learn the motion of the face model before the
    first picture (`pretraining`), and points have attributes of their own (`own_rate`).
    """

    photometric: Photometric = Photometric(l1_weight=1.0, ssim_weight=0.25)
    """Losses of pictures. The weights of L1 and 1 - SSIM are the paper's."""
    points_per_step: Annotated[int, Range(1, 100_000_000)] = 102_400
    """Largest number of points, summed over the frames of an optimiser step."""
    epochs: Annotated[int, Range(1, 100_000), NotBelow("first_epoch", above=True)] = 115
    """The paper's epoch with which the run ends. After each epoch, points are pruned and refilled; number of points,
    radii and the weight of the face model's terms follow the epochs."""
    first_epoch: Annotated[int, Range(0, 100_000)] = 60
    """The paper's epoch with which the run begins. Points that start on the face need no large radii."""
    schedule: Literal["paper", "code"] = "code"
    """Whose numbers of points and radii: the paper's, with children on a sphere around their parents, or those of the
    published code, with children in a cube."""
    late_epoch: Annotated[int, Range(1, 100_000)] = 102
    """The paper's epoch with whose start new points are put 0.001 m from their parents (published code: 101)."""
    attribute_width: Annotated[int, _WIDTH] = 64
    """Width of the attribute network."""
    attribute_layers: Annotated[int, Range(1, 32)] = 3
    """Number of layers of its trunk. The fourth reads the encoding of positions again, if it fits."""
    encoding_bands: Annotated[int, Range(0, 24)] = 9
    """Number of octaves of its encoding of positions. The shortest wave is 6 mm; with 6 octaves, 49 mm."""
    sphere_start: bool = False
    """Whether its trunk starts as about the signed distance to a sphere, as in the paper."""
    weight_norm: WeightNorm = "trunks"
    """Layers with weight normalisation: those of the trunks, also the hidden one of the skinning weights as in the
    published code (code), or all, each but the last followed by an activation, as in the paper's figures (paper)."""
    change_width: Annotated[int, _WIDTH] = 32
    """Width of the network that changes attributes with motion."""
    scale_gain: Annotated[float, Range(0, 1000)] = 0.00625
    """Largest scale that the networks add to the radius of all points, in metres (paper: 0.0025 at 1024x1024)."""
    own_rate: Rate = Rate(5e-2, 2e-3)
    """Learning rate of what each point adds to the attributes of its position, per step. With 0, nothing."""
    adam_epsilon: Annotated[float, EPSILON_RANGE] = 1e-15
    """Adam's epsilon for points and networks. Only 1e-15 is in the native code (published code: 1e-8)."""
    rate_halvings: Annotated[tuple[float, ...], Range(0, 1, ascending=True)] = ()
    """Times at which their rates are halved, as fractions of the run (paper: epochs 80 and 100)."""
    face_expression_units: Literal["own", "mean", "each"] = "each"


_PAPER_EPOCHS, _PAPER_FRAMES = 120, 2_500
"""The preset `paper` spans the epochs up to which results are published, over a video of 100 seconds."""
_PAPER = {
    **free_points_paper(_PAPER_EPOCHS),
    "photometric": {"perceptual": FREE_POINTS_PAPER_FEATURES},
    "frames_per_step": 8,
    "first_epoch": 0,
    "schedule": "paper",
    "late_epoch": 101,
    "attribute_width": 256,
    "attribute_layers": 7,
    "encoding_bands": 6,
    "sphere_start": True,
    "weight_norm": "paper",
    "change_width": 64,
    "means_rate": {"start": 1e-4 * LENGTH_UNIT, "end": None},
    "own_rate": {"start": 0.0, "end": None},
    "adam_epsilon": 1e-8,
    "rate_halvings": [80 / _PAPER_EPOCHS, 100 / _PAPER_EPOCHS],
    "face_expression_weight": 1e3,
    "face_correctives_weight": 1e3,
}
"""The paper's settings (docs/paper_preset.md)."""
_CPU_FRAMES = 30
"""Frames of an epoch in `paper-cpu`, with which a run takes about an hour and a half on one core."""

PRESETS: dict[str, Differences] = {
    "paper": {"method": _PAPER, "settings": {"steps": _PAPER_EPOCHS * _PAPER_FRAMES}},
    "paper-cpu": {
        # Of eight frames a step, 650 updates would be left, and the avatar would be a smear.
        "method": _PAPER | {"max_points": 20_000, "frames_per_step": 1},
        "settings": {"steps": _PAPER_EPOCHS * _CPU_FRAMES},
    },
}
"""How presets differ from the defaults. A draft is only a shorter run."""
