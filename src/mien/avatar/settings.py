"""Settings that several methods share, learning rates, and the progress that schedules depend on.

Needs no torch, because the command line lists and checks settings. Every number has its range beside it
(`mien.disk.config`), and every field a description that `--help-all` shows.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal, TypedDict, final

from mien.disk.config import COUNT_OR_NONE, FRACTION, NOT_NEGATIVE, NotBelow, Range, ToLoad, check_ranges


@dataclass(frozen=True)
class Progress:
    """Progress of training: everything that schedules may depend on."""

    step: int
    """Number of steps before this one."""
    steps: int
    """Number of steps of the whole run."""
    epoch: int = 0
    """Number of passes over the training frames that were completed before this step."""
    extent: float = 1.0
    """Extent of the training cameras, in metres (`camera_extent` in `mien.training.footage`). The unit of some rates
    and sizes."""
    frames: int = 1
    """Number of training frames that this step uses. It counts as so many steps."""

    @property
    def fraction(self) -> float:
        """0 at the first step, 1 after the last."""
        return self.step / self.steps

    @property
    def done(self) -> int:
        """Number of steps after this one."""
        return self.step + self.frames

    def reaches(self, every: int) -> bool:
        """Whether a multiple of a number of steps is done after this step, and was not before it."""
        return self.done // every > self.step // every

    def completes(self, steps: Iterable[int]) -> bool:
        """Whether one of these numbers of steps is done after this step, and was not before it."""
        return any(self.step < count <= self.done for count in steps)


def active_degree(degree: int, warmup: float, progress: Progress) -> int:
    """Highest degree of spherical harmonics that is switched on, of `degree`, if all are from the time `warmup` on."""
    return min(degree, int(progress.fraction / max(warmup, 1e-9) * (degree + 1)))


TRAINED = Progress(step=1, steps=1, epoch=1_000_000)
"""Progress after training: every schedule is at its end."""


@dataclass(frozen=True)
class Rate:
    """A learning rate over the run: constant, or log-linear from `start` to `end`."""

    start: Annotated[float, Range(0, 100)]
    """The rate at the first step. With 0, nothing is learned, whatever `end` is."""
    end: Annotated[float | None, Range(1e-12, 100)] = None
    """The rate at the last step. If it is not given, the rate is constant."""

    def at(self, progress: Progress) -> float:
        """The rate at a step."""
        if self.end is None or self.start == 0:
            return self.start
        along = progress.fraction
        return math.exp((1 - along) * math.log(self.start) + along * math.log(self.end))


GAUSSIAN_COUNT = Range(1, 10_000_000)
"""Range of a number of Gaussians. Tens of millions would not fit into memory."""
EPSILON_RANGE = Range(1e-30, 1)
"""Range of Adam's epsilon."""
RATE = Range(0, 100)
"""Range of a learning rate."""


class Differences(TypedDict, total=False):
    """Changes by a preset, in the form of a file of settings (docs/settings.md). All else stays at its default."""

    settings: dict[str, Any]
    """Settings of a run (`mien.training.TrainSettings`) by name."""
    method: dict[str, Any]
    """Settings of the method by name. A group of settings is a dict again."""


@dataclass(frozen=True)
class PerceptualLoss:
    """A loss of trained features (the first blocks of a VGG16), which keeps details sharp.

    It compares pictures by other features than those of the scored metric (ST-LPIPS).
    """

    weight: Annotated[float, NOT_NEGATIVE] = 0.0
    """Weight of the distance of features. A crop of `parts` counts by its share of the picture's pixels, all else
    (`region`) fully. 0 switches the loss off."""
    start: Annotated[float, FRACTION] = 0.3
    """Time of the first step with this loss, as a fraction of the run."""
    every: Annotated[int, Range(1, 1_000)] = 8
    """Number of steps from one step with this loss to the next."""
    crop: Annotated[int, Range(16, 512)] = 64
    """Side of the crops, in pixels of the training pictures. The cost grows with its square."""
    blocks: Annotated[int, Range(1, 3)] = 2
    """Number of blocks of the network, from fine to coarse features. Each doubles the cost, or more."""
    region: Literal["parts", "person", "picture"] = "parts"
    """Part of the picture that a step compares: a crop drawn at random around the eyes, the mouth, or anywhere in the
    scoring mask's box (parts), all of that box (person), which takes many times as long, or a crop anywhere, drawn so
    that the mean over many steps is the distance of whole pictures (picture)."""

    def due(self, step: int, steps: int) -> bool:
        """Whether a step of a run of `steps` has this loss."""
        return self.weight > 0 and step % self.every == 0 and step >= self.start * steps

    def scaled(self, share: float) -> "PerceptualLoss":
        """This loss times a number."""
        return self if share == 1 else replace(self, weight=share * self.weight)


@dataclass(frozen=True)
class Photometric:
    """Weights of the losses that compare a rendering with its target."""

    l1_weight: Annotated[float, NOT_NEGATIVE] = 0.8
    """Weight of the mean absolute difference of colours."""
    ssim_weight: Annotated[float, NOT_NEGATIVE] = 0.2
    """Weight of 1 - SSIM (11x11 window, sigma 1.5)."""
    alpha_weight: Annotated[float, NOT_NEGATIVE] = 0.0
    """Weight of the mean absolute difference between the rendering's alpha and the matte."""
    part_weight: Annotated[float, NOT_NEGATIVE] = 0.0
    """Additional weight of L1 and SSIM in the boxes around eyes and mouth."""
    perceptual: PerceptualLoss = field(default_factory=PerceptualLoss)
    """A loss of trained features on small crops."""

    @property
    def needs_parts(self) -> bool:
        """Whether a loss needs the boxes around eyes and mouth."""
        return self.part_weight > 0 or self.perceptual.weight > 0

    def scaled(self, share: float) -> "Photometric":
        """These losses times a number."""
        if share == 1:
            return self
        # Parts count relative to the picture's own weights.
        return replace(
            self,
            l1_weight=share * self.l1_weight,
            ssim_weight=share * self.ssim_weight,
            alpha_weight=share * self.alpha_weight,
            perceptual=self.perceptual.scaled(share),
        )


@dataclass(frozen=True)
class FaceTuning:
    """Whether and how fast training changes the tracked face parameters of each frame.

    A step changes only its own frame. In a dense Adam, momentum would also move frames that the step does not use.
    """

    enabled: bool = True
    """Whether training corrects the tracking. Corrections of held-out frames are interpolated."""
    expression: Annotated[float, RATE] = 1e-3
    """Learning rate of the expression coefficients, per step."""
    joints: Annotated[float, RATE] = 1e-3
    """Learning rate of the free joints' angles, in radians per step."""
    head_rotation: Annotated[float, RATE] = 1e-3
    """Learning rate of the head's rotation, in radians per step."""
    head_translation: Annotated[float, RATE] = 3e-4
    """Learning rate of the head's position, in metres per step."""
    begin: Annotated[float, FRACTION] = 0.0
    """Time up to which faces do not change, as a fraction of the run."""
    keep_mean_pose: bool = False
    """Whether corrections of the head's pose have a mean of zero. With one camera, heads and Gaussians otherwise move
    away from the camera together, which shows from the side."""
    keep_turns: bool = False
    """Whether what follows the head's turns is removed from these corrections, with one camera. A head that is too deep
    otherwise turns less, which shows from the side."""
    within_bounds: bool = False
    """Whether expression coefficients stay within the face model's bounds, or where they were tracked."""

    def slowed(self, share: float) -> "FaceTuning":
        """These settings with a share of all learning rates."""
        names = ("expression", "joints", "head_rotation", "head_translation")
        return replace(self, **{name: share * getattr(self, name) for name in names})


DensityRule = Literal[
    "clone", "split", "prune_faint", "prune_large", "prune_wide", "reset_opacities", "never_empty", "cap"
]
"""A rule of gradient-based density control: duplicate small and split large Gaussians; remove faint ones, large ones
(`prune_size`) and those that are wide on screen (`prune_radius`); lower opacities (the first of `opacity_resets` still
sets when pruning by size begins); keep what the method protects (GaussianAvatars: the last one of each triangle); stop
at `max_gaussians`."""


@dataclass(frozen=True)
class GradientSettings:
    """Gradient-based density control (3D Gaussian Splatting, section 5): when and where Gaussians are added or removed.

    Times are fractions of the run, so that a schedule fits runs of any length.
    """

    start: Annotated[float, FRACTION] = 0.1
    """Time of the first round, as a fraction of the run."""
    stop: Annotated[float, FRACTION, NotBelow("start")] = 0.7
    """Time of the last round, as a fraction of the run."""
    rounds: Annotated[int, COUNT_OR_NONE] = 16
    """Number of rounds, evenly spread from `start` to `stop`. With 0, the number of Gaussians never changes."""
    grow_gradient: Annotated[float, NOT_NEGATIVE] = 2e-4
    """Mean gradient by the centre, in normalised device coordinates, from which Gaussians grow."""
    size_unit: Literal["metres", "extent"] = "metres"
    """Unit of `split_size` and `prune_size`: metres, or the extent of the cameras (docs/paper_preset.md)."""
    split_size: Annotated[float, NOT_NEGATIVE] = 0.0025
    """Size above which Gaussians that grow are split in two, and below which they are duplicated."""
    prune_size: Annotated[float, NOT_NEGATIVE] = 0.1
    """Size above which Gaussians are removed, from `size_start` on."""
    prune_radius: Annotated[float, NOT_NEGATIVE] = 0.0
    """Radius on screen in pixels above which Gaussians are removed, from `size_start` on. 0 removes none."""
    size_start: Annotated[float | None, FRACTION] = None
    """Time after which sizes are pruned, as a fraction of the run. By default, the first opacity reset after
    `start`."""
    opacity_resets: Annotated[tuple[float, ...], Range(0, 1, ascending=True)] = (0.1, 0.4)
    """Times at which opacities are lowered, as fractions of the run."""
    max_gaussians: Annotated[int, GAUSSIAN_COUNT] = 40_000
    """Largest number of Gaussians, but for fills. Those with the largest gradients grow first."""
    rules_off: tuple[DensityRule, ...] = ()
    """Rules that are switched off (docs/settings.md)."""


@dataclass(frozen=True)
class RefillSettings:
    """Prune and refill (MonoGaussianAvatar, PointAvatar). Times are fractions of the run."""

    times: Annotated[tuple[float, ...], Range(0, 1, ascending=True)]
    """Times of the rounds, as fractions of the run."""
    targets: Annotated[tuple[int, ...], GAUSSIAN_COUNT]
    """Number of Gaussians after each round."""
    prune_opacity: Annotated[float, FRACTION] = 0.1
    """Gaussians are removed if their opacity stayed below this in all views since the last round."""


@dataclass(frozen=True)
class MethodConfig:
    """Settings that every method has. Each method adds its own fields.

    The defaults of a method's own class are its preset `standard`. Groups of settings that methods share (losses, face
    tuning, density control) have neutral defaults of their own, and a method says which values it takes. To change one
    setting of a group, change the method's: `replace(config, density=replace(config.density, rounds=8))`.
    """

    photometric: Photometric = field(default_factory=Photometric)
    """Weights of the losses that compare a rendering with its target."""
    face_tuning: FaceTuning = field(default_factory=FaceTuning)
    """Whether and how fast training changes the tracked face parameters of each frame."""

    @final
    def check(self) -> None:
        """Check that all numbers are in their ranges."""
        check_ranges(self, lambda name: f"--method.{name.replace('_', '-')}")


def steps_of_passes(config: MethodConfig, frames: int) -> int | None:
    """The steps of a run in which each epoch of the method is a pass over some training frames; None without epochs."""
    return vars(config)["epochs"] * frames if "epochs" in vars(config) else None


@dataclass(frozen=True)
class FreePointsConfig(MethodConfig):
    """Settings of free points that networks move, which several methods share."""

    face_tuning: FaceTuning = FaceTuning(
        expression=4e-4, joints=4e-4, head_rotation=4e-4, head_translation=1.2e-4, begin=0.1
    )
    """Whether and how fast the tracked face parameters change. In the paper, this begins with epoch 10."""
    frames_per_step: Annotated[int, Range(1, 64)] = 2
    """Largest number of frames of an optimiser step. They share what depends on the points alone."""
    start: Literal["sphere", "face"] = "face"
    """Points start on a sphere around the head, or on the surface of the face model."""
    pretraining: Annotated[int, Range(0, 1_000_000)] = 1_000
    """Number of steps before the first picture, in which a network learns how the face model moves."""
    points: Annotated[int, Range(1, 1_000_000), ToLoad(1)] = 10_000
    """Number of points at the start."""
    sphere_radius: Annotated[float, Range(1e-3, 10)] = 0.125
    """Radius of the initial sphere around the origin of the head frame, in metres."""
    max_points: Annotated[int, GAUSSIAN_COUNT] = 30_000
    """Largest number of points. Growth stops there."""
    deformation_width: Annotated[int, Range(1, 1024)] = 64
    """Width of the deformation network."""
    means_rate: Rate = Rate(1e-4, 1e-5)
    """Learning rate of the points, in metres per step."""
    network_rate: Rate = Rate(5e-4, 5e-5)
    """Learning rate of the networks, per step. The papers' are smaller, over some hundred thousand steps."""
    face_skinning_weight: Annotated[float, NOT_NEGATIVE] = 1.0
    """Weight of the mean squared distance of a point's skinning weights from those of the nearest vertex. A method
    may let this weight and the two below fall in the course of the run."""
    face_expression_weight: Annotated[float, NOT_NEGATIVE] = 1e4
    """Weight of the same distance of expression directions."""
    face_expression_units: Literal["own", "mean", "each"] = "mean"
    """Units of the coefficients there: the face model's own, as in the paper, or those with a mean variance of 1 over
    the training frames (mean), with each term also divided by its variance and their number as in the code (each)."""
    face_correctives_weight: Annotated[float, NOT_NEGATIVE] = 1e4
    """Weight of the same distance of pose correctives."""
    face_points: Annotated[int, GAUSSIAN_COUNT] = 256
    """Number of points that these losses, and the method's others of points, use in each step, in turn."""


FREE_POINTS_PAPER_FEATURES = {"weight": 0.1, "start": 0.0, "every": 1, "crop": 224, "blocks": 3, "region": "picture"}
"""The perceptual loss of the papers of these methods."""


def free_points_paper(epochs: int) -> dict[str, Any]:
    """Return the settings that the presets `paper` of these methods share, over a number of epochs."""
    return {
        "face_tuning": {
            "expression": 5e-4,
            "joints": 5e-4,
            "head_rotation": 5e-4,
            "head_translation": 0.0,
            "begin": 10 / epochs,
        },
        "start": "sphere",
        "pretraining": 0,
        "points": 400,
        "max_points": 100_000,
        "epochs": epochs,
        "deformation_width": 128,
        "face_expression_units": "own",
        "network_rate": {"start": 1e-4, "end": None},
        "face_points": 100_000,
    }
