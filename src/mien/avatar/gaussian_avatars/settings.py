"""The settings of GaussianAvatars."""

from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from mien.avatar.schedules import Rate
from mien.avatar.settings import (
    Differences,
    FaceTuning,
    GradientSettings,
    MethodConfig,
    PerceptualLoss,
    Photometric,
)
from mien.disk.config import FRACTION, NOT_NEGATIVE, NotBelow, Range, overlay


@dataclass(frozen=True)
class SurfaceLimits:
    """Limits that keep Gaussians flat on the mesh, where one camera cannot see how deep they lie.

    Lengths are those of the neutral head. Without limits, skin that was trained from the front falls to shards when it
    is seen from the side.
    """

    enabled: bool = False
    """Whether the limits are kept, by a correction after each step. They are always kept where sides are filled
    (`--training.unseen`)."""
    depth: Annotated[float, Range(0, 0.1)] = 0.003
    """Largest distance of a centre from the mesh along the triangle's normal, in metres."""
    hair_share: Annotated[float, Range(0, 10)] = 1.3
    """How far a centre may lie above the scalp, beside the depth, as a multiple of the height of hair."""
    thickness: Annotated[float, Range(1e-5, 0.1)] = 0.0005
    """Largest scale (standard deviation) along the normal, in metres."""
    hair_thickness: Annotated[float, Range(0, 10)] = 0.3
    """What is added to the thickness on the scalp, as a multiple of the height of hair."""
    width: Annotated[float, Range(1e-5, 1)] = 0.006
    """Largest scale along the surface, in metres."""
    hair_width: Annotated[float, Range(0, 10)] = 1.0
    """What is added to the width on the scalp, as a multiple of the height of hair."""
    ratio: Annotated[float, Range(1, 1000)] = 5.0
    """Largest ratio of the two scales along the surface. Larger ones are needles."""
    tilt: Annotated[float, Range(0, 180)] = 20.0
    """Largest angle between a Gaussian's thin axis and the normal, in degrees."""


@dataclass(frozen=True)
class GaussianAvatarsConfig(MethodConfig):
    """Settings of GaussianAvatars. The defaults suit one fixed camera and runs of some thousand steps.

    They add to the paper: places, colours and opacities that change with the expression (`expression_rank`,
    `appearance`), a loss of alpha, more weight and a perceptual loss for eyes and mouth, and tuned poses that stay
    where they are on average.
    """

    photometric: Photometric = Photometric(
        alpha_weight=0.2, part_weight=1.0, perceptual=PerceptualLoss(weight=8.0, every=16)
    )
    """Weights of the losses that compare a rendering with its target. Without the loss of alpha, a pale face is a thin
    one before a white background. The weight of eyes and mouth and the perceptual loss take a third more time."""
    face_tuning: FaceTuning = FaceTuning(keep_mean_pose=True, keep_turns=True)
    """Whether and how fast training changes the tracked face parameters of each frame."""
    sh_degree: Annotated[int, Range(0, 3)] = 0
    """Degree of the spherical harmonics for view-dependent colour. Keep 0 with a single camera, because view-dependent
    colours then absorb the head's pose."""
    sh_frame: Literal["world", "head"] = "world"
    """Frame in which spherical harmonics are evaluated: world, as in the paper, or head, where light turns with the
    head."""
    sh_warmup: Annotated[float, FRACTION] = 0.3
    """Fraction of the run over which the degrees of the spherical harmonics are switched on, one after the other."""
    first_colors: Literal["grey", "pictures"] = "grey"
    """Colours of the Gaussians before the first step: almost grey, as in the paper's code, or their triangles' mean
    colours in the training pictures, which takes about a second."""
    means_rate: Rate = Rate(5e-3, 5e-5)
    """Learning rate of the centres, in triangle units per step."""
    means_times_extent: bool = False
    """Whether the learning rate of the centres is multiplied by the extent of the training cameras in metres, as in the
    paper."""
    log_scales_rate: Rate = Rate(0.017)
    """Learning rate of the logarithms of the scales, per step."""
    quats_rate: Rate = Rate(1e-3)
    """Learning rate of the rotations (quaternions), per step."""
    opacity_rate: Rate = Rate(0.05)
    """Learning rate of the opacities (logits), per step."""
    color_rate: Rate = Rate(2.5e-3)
    """Learning rate of the constant colour coefficients, per step. Coefficients of higher degrees have a constant rate:
    a twentieth of the start of this rate."""
    expression_rank: Annotated[int, Range(0, 8)] = 4
    """Number of activations of the face with which each Gaussian changes, for what the mesh cannot say: wrinkles, or
    shoulders that stay while the head turns. 0 is the paper's method, without such changes."""
    expression_color_rate: Rate = Rate(0.0)
    """Learning rate of the changes of colour with the expression, in colour coefficients per unit of an activation and
    step. If its start is 0, colours do not change."""
    expression_opacity_rate: Rate = Rate(0.0)
    """Learning rate of the changes of opacity (logits) with the expression, per unit of an activation and step. If its
    start is 0, opacities do not change."""
    expression_offset_rate: Rate = Rate(1e-3, 1e-5)
    """Learning rate of the changes of place with the expression, in triangle units per unit of an activation and step.
    If its start is 0, places do not change."""
    expression_weight: Annotated[float, NOT_NEGATIVE] = 3.0
    """Weight of the mean squared changes with the expression, which keeps changes small that pictures do not need."""
    appearance: Literal["static", "features"] = "features"
    """Whether a Gaussian's colour and opacity stay as they are, as in the paper, or also change with features that the
    activations of the face blend and one small network reads, as in HeadGaS."""
    appearance_directions: Annotated[int, Range(1, 64), NotBelow("expression_rank")] = 12
    """Number of activations of the face that blend the features, with `appearance` features. The first ones are those
    of `expression_rank`, so there are at least as many."""
    appearance_features: Annotated[int, Range(1, 256)] = 16
    """Number of features of each Gaussian, with `appearance` features."""
    appearance_hidden: Annotated[int, Range(1, 1024)] = 32
    """Width of the only hidden layer of the features' network."""
    appearance_rate: Rate = Rate(2.5e-3)
    """Learning rate of the features, per step."""
    appearance_network_rate: Rate = Rate(2e-3, 2e-4)
    """Learning rate of the features' network, per step."""
    appearance_weight: Annotated[float, NOT_NEGATIVE] = 0.1
    """Weight of the mean squared changes of colour and opacity by features."""
    position_threshold: Annotated[float, NOT_NEGATIVE] = 1.0
    """Distance from the triangle's centre up to which a Gaussian's centre has no penalty, in triangle units."""
    position_weight: Annotated[float, NOT_NEGATIVE] = 0.01
    """Weight of the position penalty, which is the distance beyond the position threshold."""
    scale_threshold: Annotated[float, NOT_NEGATIVE] = 0.6
    """Scale up to which a Gaussian has no penalty, in triangle units."""
    scale_weight: Annotated[float, NOT_NEGATIVE] = 1.0
    """Weight of the scale penalty, which is the scale beyond the scale threshold."""
    surface: SurfaceLimits = field(default_factory=SurfaceLimits)
    """Limits that keep Gaussians on the surface of the mesh."""
    density: GradientSettings = field(default_factory=lambda: GradientSettings(grow_gradient=1e-4))
    """Density control: when and where Gaussians are added and removed."""


_STEPS, _ROUND, _FIRST, _RESET = 600_000, 2_000, 10_000, 60_000
"""The paper's schedule, in steps: the run, between rounds of density control, to the first reset, between resets.

The published code runs a round every `_ROUND` steps after step `_FIRST`, and none at that step.
"""
_SH_DEGREE, _DEGREE_STEPS = 3, 1_000
_VISIT = 30
"""How much further the paper's optimiser moves a frame between two visits than its learning rate says.

It is one dense Adam over all frames, so a frame goes on moving while others are drawn. A gradient g every T steps moves
it by the rate times sqrt(T) a visit: the sum of the first moments is g, and the root of the second moment is g /
sqrt(T). With more than 1,000 frames, the second moment comes to be that of the last visit alone, and the factor ends
below 1 / sqrt(1 - 0.999) = 32: it is 15 for 250 frames, 25 for 1,000 and 30 for 2,000. Here a step moves only its own
frame, by about the rate. The paper's subjects have nine sequences, so some 1,000 to 3,000 frames.
"""


_PUBLISHED: dict[str, Any] = {
    "photometric": {"alpha_weight": 0.0, "part_weight": 0.0, "perceptual": {"weight": 0.0, "every": 8}},
    "appearance": "static",
    "expression_rank": 0,
    "expression_color_rate": {"start": 1e-3},
    "expression_opacity_rate": {"start": 0.01},
    "face_tuning": {"keep_mean_pose": False, "keep_turns": False},
}
"""Takes away what the defaults add to the paper."""
_PAPER: dict[str, Any] = _PUBLISHED | {
    "sh_degree": _SH_DEGREE,
    "sh_warmup": (_SH_DEGREE + 1) * _DEGREE_STEPS / _STEPS,
    "means_times_extent": True,
    "face_tuning": _PUBLISHED["face_tuning"]
    | {
        "expression": {"start": _VISIT * 1e-3},
        "joints": {"start": _VISIT * 1e-5},
        "head_rotation": {"start": _VISIT * 1e-5},
        "head_translation": {"start": _VISIT * 1e-6},
    },
    "density": {
        "start": (_FIRST + _ROUND) / _STEPS,
        "stop": (_STEPS - _ROUND) / _STEPS,
        "rounds": (_STEPS - _FIRST) // _ROUND - 1,
        "grow_gradient": 2e-4,
        "size_unit": "extent",
        "split_size": 0.01,
        "prune_radius": 20.0,
        "rules": {"prune_wide": False},  # as the published code does, and by measurement (docs/log.md)
        "opacity_resets": [step / _STEPS for step in (_FIRST, *range(_RESET, _STEPS, _RESET))],
        "max_gaussians": 200_000,
    },
}
"""The paper's settings (docs/paper_preset.md). Times are fractions, so that they fit runs of any length."""

PRESETS: dict[str, Differences] = {
    "draft": {
        "method": {
            "appearance": "static",
            "photometric": {"part_weight": 0.0, "perceptual": {"weight": 0.0, "every": 8}},
        }
    },
    "paper": {"method": _PAPER, "settings": {"steps": _STEPS}},
}
"""How presets differ from the defaults. `draft` lacks features and some losses, and is a shorter run."""


def as_published() -> GaussianAvatarsConfig:
    """The settings without what the defaults add to the paper, for runs of some thousand steps.

    Avatars that the paper's own code trained have these settings, and benchmarks of the method use them.
    """
    return overlay(GaussianAvatarsConfig(), _PUBLISHED, "as published", "gaussian_avatars")
