"""The settings of GaussianAvatars."""

from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from mien.avatar.settings import (
    Differences,
    FaceTuning,
    GradientSettings,
    MethodConfig,
    PerceptualLoss,
    Photometric,
    Rate,
)
from mien.disk.config import FRACTION, NOT_NEGATIVE, NotBelow, Range, overlay

ChangeKind = Literal["color", "opacity", "offset"]


@dataclass(frozen=True)
class GaussianAvatarsConfig(MethodConfig):
    """Settings of GaussianAvatars. The defaults suit one fixed camera and runs of some thousand steps.

    They add to the paper: places, colours and opacities that change with the expression (`expression_rank`,
    `appearance`), a loss of alpha, more weight and a perceptual loss for eyes and mouth, and tuned poses that stay
    where they are on average.
    """

    frames_per_step: Annotated[int, Range(1, 64)] = 2
    """Number of frames of an optimiser step, each on a thread of its own. Learning rates of Gaussians grow with the
    root of it, and Adam's running means decay by frames."""
    one_frame_from: Annotated[float, FRACTION] = 0.6
    """Fraction of the run from which a step has one frame. Its gradients are less steady, and its details sharper."""
    photometric: Photometric = Photometric(
        alpha_weight=0.2, part_weight=1.0, perceptual=PerceptualLoss(weight=8.0, every=16)
    )
    """Losses of pictures. Without that of alpha, a pale face is a thin one before a white background."""
    face_tuning: FaceTuning = FaceTuning(keep_mean_pose=True, keep_turns=True)
    sh_degree: Annotated[int, Range(0, 3)] = 0
    """Degree of the spherical harmonics. With a single camera, higher ones than 0 absorb the head's pose."""
    sh_frame: Literal["world", "head"] = "world"
    """Frame of spherical harmonics: world, as in the paper, or head, where light turns with the head."""
    sh_warmup: Annotated[float, FRACTION] = 0.3
    """Fraction of the run over which the degrees are switched on, one after the other."""
    first_colors: Literal["grey", "pictures"] = "grey"
    """First colours: almost grey, as in the paper's code, or those of the training pictures, in about a second."""
    means_rate: Rate = Rate(5e-3, 5e-5)
    """Learning rate of the centres, in triangle units per step."""
    means_times_extent: bool = False
    """Whether this rate is multiplied by the extent of the cameras in metres, as in the paper."""
    expression_rank: Annotated[int, Range(0, 8)] = 4
    """Number of activations with which each Gaussian moves, for what the mesh cannot say, such as wrinkles. 0 is the
    paper's method."""
    expression_changes: tuple[ChangeKind, ...] = ("offset",)
    """Attributes that change linearly with these activations: a Gaussian's colour, opacity, or place (offset)."""
    expression_weight: Annotated[float, NOT_NEGATIVE] = 3.0
    """Weight of the mean squared changes with the expression, which holds back what pictures do not need."""
    appearance: Literal["static", "features"] = "features"
    """Whether colour and opacity stay as they are, as in the paper, or also change with features, as in HeadGaS."""
    appearance_directions: Annotated[int, Range(1, 64), NotBelow("expression_rank")] = 11
    """Number of activations that blend a Gaussian's features: of the motion of its region of the face, and of the
    head's pose, in turn. Those of `expression_rank` are the first."""
    appearance_features: Annotated[int, Range(1, 256)] = 16
    """Number of features of each Gaussian."""
    position_weight: Annotated[float, NOT_NEGATIVE] = 0.01
    """Weight of the penalty of centres further than one triangle unit from their triangle's centre."""
    scale_threshold: Annotated[float, NOT_NEGATIVE] = 0.6
    """Scale up to which a Gaussian has no penalty, in triangle units."""
    surface_limits: bool = False
    """Whether Gaussians are kept flat on the mesh. Where sides are filled, they always are (`--training.unseen`)."""
    density: GradientSettings = field(default_factory=lambda: GradientSettings(grow_gradient=1e-4))
    """Density control: when and where Gaussians are added and removed."""

    def frames_at(self, fraction: float) -> int:
        """The number of frames of a step, given the fraction of the run that is over."""
        return self.frames_per_step if fraction < self.one_frame_from else 1


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
    "frames_per_step": 1,
    "photometric": {"alpha_weight": 0.0, "part_weight": 0.0, "perceptual": {"weight": 0.0, "every": 8}},
    "appearance": "static",
    "expression_rank": 0,
    "expression_changes": ["color", "opacity", "offset"],
    "face_tuning": {"keep_mean_pose": False, "keep_turns": False},
}
"""Takes away what the defaults add to the paper."""
_PAPER: dict[str, Any] = _PUBLISHED | {
    "sh_degree": _SH_DEGREE,
    "sh_warmup": (_SH_DEGREE + 1) * _DEGREE_STEPS / _STEPS,
    "means_times_extent": True,
    "face_tuning": _PUBLISHED["face_tuning"]
    | {
        "expression": _VISIT * 1e-3,
        "joints": _VISIT * 1e-5,
        "head_rotation": _VISIT * 1e-5,
        "head_translation": _VISIT * 1e-6,
    },
    "density": {
        "start": (_FIRST + _ROUND) / _STEPS,
        "stop": (_STEPS - _ROUND) / _STEPS,
        "rounds": (_STEPS - _FIRST) // _ROUND - 1,
        "grow_gradient": 2e-4,
        "size_unit": "extent",
        "split_size": 0.01,
        "prune_radius": 20.0,
        "rules_off": ["prune_wide"],  # as the published code does, and by measurement (docs/log.md)
        "opacity_resets": [step / _STEPS for step in (_FIRST, *range(_RESET, _STEPS, _RESET))],
        "max_gaussians": 200_000,
    },
}
"""The paper's settings (docs/paper_preset.md). Times are fractions, so that they fit runs of any length."""

PRESETS: dict[str, Differences] = {
    "draft": {
        "method": {
            "appearance": "static",
            "one_frame_from": 1.0,
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
