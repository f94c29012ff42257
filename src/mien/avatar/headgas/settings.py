"""The settings of HeadGaS."""

from dataclasses import dataclass
from typing import Annotated, Literal

from mien.avatar.settings import EPSILON_RANGE, Differences, FaceTuning, GradientSettings, MethodConfig, Rate
from mien.disk.config import FRACTION, NOT_NEGATIVE, Range, ToLoad

Variant = Literal["full", "no_mlp", "delta", "change_all", "no_blending"]
"""The method and its ablations (supplement, section 2), as `mien.avatar.headgas.variants` makes them."""


@dataclass(frozen=True)
class HeadGasConfig(MethodConfig):
    """Settings of HeadGaS. The defaults suit a CPU and runs of some thousand steps."""

    variant: Variant = "full"
    """The method itself (`full`), or an ablation: without a network (`no_mlp`), with one that moves and turns Gaussians
    (`delta`), paints and moves them (`change_all`), or takes the expression itself (`no_blending`)."""
    shift_weight: Annotated[float, NOT_NEGATIVE] = 1.0
    """Weight of the mean absolute shift in metres, for `delta` and `change_all`. The paper does not state it."""
    face_tuning: FaceTuning = FaceTuning(within_bounds=True)
    points: Annotated[int, Range(4, 1_000_000), ToLoad(4)] = 2500
    """Number of Gaussians at the start, sampled on the subject's mesh."""
    features: Annotated[int, Range(1, 1024)] = 32
    """Number of latent features per Gaussian, as in the paper."""
    directions: Annotated[int, Range(0, 1024)] = 20
    """Number of directions of the face along which features change: those of the largest spread over the training
    timesteps. 0: the inputs themselves, as in the paper and always in `no_mlp`. Fewer need less memory and time."""
    activations: Literal["whole", "regions"] = "whole"
    """The motion that features follow: that of the whole face, as in the paper, or that of the region where a Gaussian
    began and of the head (`regions`), which ends soon beyond what was filmed. Ablations, `directions` 0, and an
    `sh_degree` above 0 always follow the whole face."""
    hidden: Annotated[int, Range(1, 4096)] = 64
    """Width of the network's only hidden layer."""
    encoding_bands: Annotated[int, Range(0, 24)] = 4
    """Number of octaves of the positional encoding."""
    encoding_length: Annotated[float, Range(1e-4, 1e4)] = 0.05
    """Length of one unit in the positional encoding, in metres."""
    encoding_gradient: bool = False
    """Whether centres also move by what their encoding changes in the network, as in the paper's formulas."""
    factored_bases: bool = True
    """Whether the bases are trained without a first moment and with one second moment for all directions, which takes
    much less memory and time. Otherwise by Adam."""
    sh_degree: Annotated[int, Range(0, 3)] = 0
    """Degree of the spherical harmonics. With a single camera, higher ones than 0 absorb the head's pose."""
    sh_warmup: Annotated[float, FRACTION] = 0.3
    """Fraction of the run over which the degrees are switched on, one after the other."""
    sh_higher_share: Annotated[float, FRACTION] = 0.05
    """Factor of the coefficients of higher degrees, which the network learns at this share of the rate."""
    means_rate: Rate = Rate(1e-4, 1e-6)
    """Learning rate of the centres, in metres per step."""
    means_times_extent: bool = False
    """Whether this rate is multiplied by the extent of the cameras in metres, as in 3D Gaussian Splatting."""
    log_scales_rate: Rate = Rate(5e-3)
    """Learning rate of the logarithms of the scales, per step."""
    quats_rate: Rate = Rate(1e-3)
    """Learning rate of the rotations (quaternions), per step."""
    features_rate: Rate = Rate(2.5e-3)
    """Learning rate of the feature bases and of the neutral features, per step."""
    network_rate: Rate = Rate(2e-3, 2e-4)
    """Learning rate of the network, per step."""
    network_epsilon: Annotated[float, EPSILON_RANGE] = 1e-15
    """Adam's epsilon for the network. Only 1e-15 is in the native code."""
    judged_expressions: Annotated[int, Range(0, 10_000)] = 64
    """Number of training expressions, as different as possible, at which opacities to prune by are computed."""
    density: GradientSettings = GradientSettings(
        opacity_resets=(), size_start=0.1, prune_size=0.03, max_gaussians=20_000
    )
    """Density control. Opacities come from the network and are never reset, so `size_start` sets when large Gaussians
    are removed."""


_STEPS, _ROUND, _FIRST, _LAST, _DEGREE_STEPS, _PERCEPTUAL = 50_000, 100, 500, 15_000, 1_000, 10_000
"""The paper's run, in steps. The schedule of density control and of degrees is that of 3D Gaussian Splatting.

Its code runs a round every `_ROUND` steps between steps `_FIRST` and `_LAST`, and none at these.
"""

PRESETS: dict[str, Differences] = {
    "paper": {
        "method": {
            "photometric": {
                "perceptual": {
                    "weight": 0.1,
                    "start": _PERCEPTUAL / _STEPS,
                    "every": 1,
                    "region": "person",
                    "blocks": 3,
                },
            },
            "face_tuning": {"enabled": False, "within_bounds": False},
            "directions": 0,
            "encoding_gradient": True,
            "factored_bases": False,
            "network_epsilon": 1e-8,
            "sh_degree": 3,
            "sh_warmup": 4 * _DEGREE_STEPS / _STEPS,
            "means_rate": {"start": 1.6e-4, "end": 1.6e-6},
            "means_times_extent": True,
            "density": {
                "start": (_FIRST + _ROUND) / _STEPS,
                "stop": (_LAST - _ROUND) / _STEPS,
                "rounds": (_LAST - _FIRST) // _ROUND - 1,
                "size_unit": "extent",
                "split_size": 0.01,
                "prune_size": 0.1,
                "size_start": _FIRST / _STEPS,
                "max_gaussians": 45_000,
            },
        },
        "settings": {"steps": _STEPS},
    },
}
"""How presets differ from the defaults (docs/paper_preset.md). Times are fractions, so that they fit runs of any
length. A draft is only a shorter run."""
