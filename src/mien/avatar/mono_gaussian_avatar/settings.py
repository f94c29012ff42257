"""The settings of MonoGaussianAvatar."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

from mien.avatar.schedules import Rate
from mien.avatar.settings import GAUSSIAN_COUNT, FaceTuning, MethodConfig, PerceptualLoss, Photometric
from mien.ranges import NOT_NEGATIVE, Above, Range, ToLoad

LENGTH_UNIT = 0.25
"""Unit of length, in metres. The paper's head model is four times life size, and its radii and weights fit that."""
_WIDTH = Range(1, 1024)
_EPOCHS = 100


def _photometric() -> Photometric:
    return Photometric(l1_weight=1.0, ssim_weight=0.25)


def _face_tuning() -> FaceTuning:
    rate = Rate(1e-3, begin=10 / _EPOCHS)
    return FaceTuning(expression=rate, joints=rate, head_rotation=rate, head_translation=Rate(3e-4, begin=10 / _EPOCHS))


@dataclass(frozen=True)
class MonoGaussianAvatarConfig(MethodConfig):
    """Settings of MonoGaussianAvatar. The defaults suit a CPU and runs of some thousand steps."""

    photometric: Photometric = field(default_factory=_photometric)
    """Weights of the losses that compare a rendering with its target. The weights of L1 and 1 - SSIM are the
    paper's."""
    face_tuning: FaceTuning = field(default_factory=_face_tuning)
    """Whether and how fast training changes the tracked face parameters of each frame. As in the paper, this begins
    with epoch 10."""
    frames_per_step: Annotated[int, Range(1, 64)] = 1
    """Largest number of frames that one optimiser step uses (paper: 8). They share what depends on the points alone,
    so that a frame takes less time; but the run then has fewer updates, since each frame counts as a step."""
    points_per_step: Annotated[int, Range(1, 100_000_000)] = 102_400
    """Largest number of points, summed over the frames of an optimiser step. With more points, steps have fewer
    frames, but at least one."""
    start: Literal["sphere", "face"] = "sphere"
    """Where points start: on a sphere around the head (paper), or on the surface of the face model."""
    pretraining: Annotated[int, Range(0, 1_000_000)] = 0
    """Number of steps before the first picture, in which the deformation network learns the motion of the face model
    (paper: none)."""
    points: Annotated[int, Range(1, 1_000_000), ToLoad(1)] = 400
    """Number of Gaussians at the start."""
    sphere_radius: Annotated[float, Range(1e-3, 10)] = 0.125
    """Radius of the initial sphere around the origin of the head frame, in metres."""
    max_points: Annotated[int, GAUSSIAN_COUNT] = 10_000
    """Largest number of Gaussians. Growth stops there (paper: 100,000)."""
    epochs: Annotated[int, Range(1, 100_000), Above("first_epoch")] = _EPOCHS
    """The paper's epoch with which the run ends. After each epoch, points are pruned and refilled; number of points,
    radii and the weight of the face model's terms follow the epochs."""
    first_epoch: Annotated[int, Range(0, 100_000)] = 0
    """The paper's epoch with which the run begins. It has to be smaller than `epochs`. Points that start on the face
    need no large radii."""
    schedule: Literal["paper", "code"] = "code"
    """Whose numbers of points and radii: those of the paper, whose children are on a sphere around their parents, or
    those of the published code, whose children are in a cube."""
    attribute_width: Annotated[int, _WIDTH] = 64
    """Width of the attribute network (paper: 256)."""
    attribute_layers: Annotated[int, Range(1, 32)] = 3
    """Number of layers of the attribute network's trunk (paper: 7). The fourth reads the encoding of positions again,
    if the network is wider than that."""
    encoding_bands: Annotated[int, Range(0, 24)] = 9
    """Number of octaves of the attribute network's encoding of positions (paper: 6). The shortest wave is 6 mm; with 6
    octaves, it is 49 mm."""
    sphere_start: bool = False
    """Whether the attribute network's trunk starts as about the signed distance to a sphere, as in the paper."""
    deformation_width: Annotated[int, _WIDTH] = 64
    """Width of the deformation network (paper: 128)."""
    change_width: Annotated[int, _WIDTH] = 32
    """Width of the network that changes attributes with motion (paper: 64)."""
    scale_gain: Annotated[float, Range(0, 1000)] = 0.00625
    """Largest scale that the networks add to the radius that all points share, in metres (paper: 0.0025 for pictures of
    1024x1024)."""
    means_rate: Rate = Rate(1e-4, 1e-5)
    """Learning rate of the points, in metres per step (paper: 2.5e-5)."""
    network_rate: Rate = Rate(1e-3, 1e-4)
    """Learning rate of the networks, per step (paper: 1e-4, over some hundred thousand steps)."""
    own_rate: Rate = Rate(0.0)
    """Learning rate of each point's own attributes, per step. They are added to the raw attributes that the network
    predicts for its position, which are smooth. With 0, points have none (paper)."""
    rate_halvings: Annotated[tuple[float, ...], Range(0, 1, ascending=True)] = ()
    """Times at which the rates of points and networks are halved, as fractions of the run (paper: epochs 80 and
    100)."""
    face_weight: Annotated[float, NOT_NEGATIVE] = 10.0
    """Weight of the losses that keep the networks near the face model. It halves at epochs 20, 30, 50 and 70."""
    face_points: Annotated[int, GAUSSIAN_COUNT] = 256
    """Number of points that these losses use in each step, in turn."""


_PAPER_EPOCHS, _PAPER_FRAMES = 120, 2_500
"""The preset `paper` spans the epochs up to which results are published, over a video of 100 seconds."""


def _paper() -> MonoGaussianAvatarConfig:
    """The paper's settings (docs/paper_preset.md)."""
    rate = Rate(5e-4, begin=10 / _PAPER_EPOCHS)
    perceptual = PerceptualLoss(weight=0.1, start=0.0, every=1, crop=224, blocks=3)
    return MonoGaussianAvatarConfig(
        photometric=Photometric(l1_weight=1.0, ssim_weight=0.25, perceptual=perceptual),
        face_tuning=FaceTuning(expression=rate, joints=rate, head_rotation=rate, head_translation=Rate(0.0)),
        frames_per_step=8,
        max_points=100_000,
        epochs=_PAPER_EPOCHS,
        schedule="paper",
        attribute_width=256,
        attribute_layers=7,
        encoding_bands=6,
        sphere_start=True,
        deformation_width=128,
        change_width=64,
        means_rate=Rate(1e-4 * LENGTH_UNIT),
        network_rate=Rate(1e-4),
        rate_halvings=(80 / _PAPER_EPOCHS, 100 / _PAPER_EPOCHS),
        face_points=100_000,
    )


def _standard() -> MonoGaussianAvatarConfig:
    """Points that start on the face, with attributes of their own and networks that know the face model's motion."""
    rate = Rate(4e-4, begin=0.1)
    return MonoGaussianAvatarConfig(
        face_tuning=FaceTuning(
            expression=rate, joints=rate, head_rotation=rate, head_translation=Rate(1.2e-4, begin=0.1)
        ),
        frames_per_step=2,
        start="face",
        pretraining=1_000,
        points=10_000,
        max_points=30_000,
        first_epoch=60,
        epochs=115,
        network_rate=Rate(5e-4, 5e-5),
        own_rate=Rate(5e-2, 2e-3),
    )


PRESETS = {"draft": _standard(), "standard": _standard(), "paper": _paper()}
"""Settings of this method for each preset. `draft` and `standard` are equal: a draft is only a shorter run."""
PRESET_STEPS = {"paper": _PAPER_EPOCHS * _PAPER_FRAMES}
"""Number of steps of the presets for which the method has its own."""
