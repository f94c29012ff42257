"""The seam: an avatar is a function from face parameters to Gaussians.

A new method is one file with a config dataclass and an `Avatar`, and one line in `mien.avatar.methods`.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from jaxtyping import Float
from torch import Tensor, nn

from mien.avatar.baked import BakedAvatar
from mien.avatar.density import DensityControl
from mien.avatar.store import GaussianStore, Moments
from mien.face import FaceModel, FaceParams
from mien.gaussians import Gaussians
from mien.render.rendering import Rendering

_CALM_SHARE = 0.1
"""Of the timesteps that count as at rest."""


@dataclass(frozen=True)
class Progress:
    """How far training is: all that schedules may depend on."""

    step: int
    """Steps done before this one."""
    steps: int
    """Of the whole run."""
    epoch: int = 0
    """Passes over the training frames done before this one."""

    @property
    def fraction(self) -> float:
        """0 at the first step, 1 after the last."""
        return self.step / self.steps


TRAINED = Progress(step=1, steps=1, epoch=1_000_000)
"""The state after training: every schedule at its end."""


@dataclass(frozen=True)
class Rate:
    """A learning rate over the run: constant, or log-linear from `start` to `end`."""

    start: float
    """At the first step (or at `begin`)."""
    end: float | None = None
    """At the last step; None for a constant rate."""
    begin: float = 0.0
    """Fraction of the run before which the rate is 0."""

    def at(self, progress: Progress) -> float:
        """The rate of one step."""
        if progress.fraction < self.begin:
            return 0.0
        if self.end is None:
            return self.start
        along = (progress.fraction - self.begin) / max(1 - self.begin, 1e-9)
        return math.exp((1 - along) * math.log(self.start) + along * math.log(self.end))


@dataclass(frozen=True)
class Photometric:
    """Weights of the losses that compare a rendering with its target."""

    l1_weight: float = 0.8
    """Of the mean absolute difference."""
    ssim_weight: float = 0.2
    """Of 1 - SSIM (11x11 window, sigma 1.5)."""
    alpha_weight: float = 0.0
    """Of the mean absolute difference between the rendering's alpha and the matte."""


@dataclass(frozen=True)
class FaceTuning:
    """Learning rates of the per-frame face parameters, where training may change them.

    Only the frame of a step moves: unlike a dense Adam, momentum does not push frames that were not looked at.
    """

    enabled: bool = True
    """What is corrected in training frames is passed on to the held-out frames between them (`FaceTrack.params`)."""
    expression: Rate = Rate(1e-3)
    """Coefficients."""
    joints: Rate = Rate(1e-3)
    """Radians."""
    head_rotation: Rate = Rate(1e-3)
    """Radians."""
    head_translation: Rate = Rate(3e-4)
    """Metres."""


@dataclass(frozen=True)
class MethodConfig:
    """What every method's config holds; methods add their own fields."""

    photometric: Photometric = field(default_factory=Photometric)
    """The trainer computes these losses; the method's own come from `Avatar.regularizers`."""
    face_tuning: FaceTuning = field(default_factory=FaceTuning)
    """Whether and how training changes the tracked face parameters."""


@dataclass(frozen=True, eq=False)
class Posed:
    """What `Avatar.pose` returns."""

    gaussians: Gaussians
    aux: Mapping[str, Tensor]
    """What the method's own regularizers need, computed once."""


@dataclass(frozen=True, eq=False)
class ParameterGroup:
    """Tensors that share a learning rate."""

    name: str
    tensors: Mapping[str, Tensor]
    """Leaves of the autograd graph, by name."""
    rate: Rate
    moments: dict[str, Moments] | None = None
    """Where the optimiser keeps its state, by the names of `tensors`; None: with the optimiser, by group and name."""


def store_group(store: GaussianStore, name: str, rate: Rate) -> ParameterGroup:
    """The group of one per-Gaussian tensor; its optimiser state stays in the store."""
    return ParameterGroup(name, {name: store[name]}, rate, store.moments)


def network_group(name: str, network: nn.Module, rate: Rate) -> ParameterGroup:
    """The group of all parameters of a network."""
    return ParameterGroup(name, dict(network.named_parameters()), rate)


class Avatar(nn.Module, ABC):
    """Canonical Gaussians and how they depend on the face. All state is in the arguments, none in the order of calls.

    A method's constructor takes `(config, face_model, face)`: the face parameters of all training timesteps, from
    which it may take the subject's shape and statistics. Random numbers come from torch's default generator, which
    the caller seeds. Every tensor that `pose` needs is a parameter, a buffer or in the store, so that loading is
    generic: build with the avatar's `subject`, then overwrite.
    """

    def __init__(self, config: MethodConfig, face_model: FaceModel, face: FaceParams):
        super().__init__()
        self.config = config
        self.face_model = face_model
        self.subject = neutral_of(face)
        """One timestep: this person's identity and offsets, and how it looks at rest."""

    @abstractmethod
    def pose(self, face: FaceParams, progress: Progress = TRAINED) -> Posed:
        """The Gaussians of some timesteps, batched; differentiable in `face` and in the avatar's parameters."""

    @abstractmethod
    def regularizers(self, posed: Posed, rendering: Rendering, progress: Progress) -> dict[str, Float[Tensor, ""]]:
        """The method's own loss terms, weighted."""

    @abstractmethod
    def parameter_groups(self) -> list[ParameterGroup]:
        """What is trained at which rates; asked again after density control has changed the store."""

    @abstractmethod
    def gaussian_store(self) -> GaussianStore:
        """Every per-Gaussian tensor."""

    @abstractmethod
    def density(self) -> DensityControl:
        """Which density control, with this method's hooks."""

    @abstractmethod
    def bake(self) -> BakedAvatar:
        """What runs without this class: for files, the web, engines."""


def move_avatar(avatar: Avatar, like: Tensor) -> None:
    """Give an avatar, in place, the float dtype and the device of `like`, with its face model and its subject.

    To be done before training: the optimiser's state in the store stays where it is.
    """
    if avatar.face_model.template.dtype == like.dtype and avatar.face_model.template.device == like.device:
        return
    avatar.to(like)
    avatar.face_model, avatar.subject = avatar.face_model.to(like), avatar.subject.to(like)


def neutral_of(face: FaceParams) -> FaceParams:
    """The person of `face` at rest, as one timestep: an estimate that a few bad frames do not move.

    Expression: the median over the tenth of the timesteps with the smallest expression coefficients (their Euclidean
    norm); what stays there, such as brows that the tracker always sees raised, is the person's own. Joints and head
    pose: the median over all timesteps, because people mostly look where the camera is.
    """
    face = face.detach()
    activity = face.expression.norm(dim=-1)
    calm = activity.argsort(stable=True)[: max(1, round(_CALM_SHARE * len(face)))]
    return replace(
        face,
        expression=face.expression[calm].median(0, keepdim=True).values,
        joints=face.joints.median(0, keepdim=True).values,
        head_rotation=face.head_rotation.median(0, keepdim=True).values,
        head_translation=face.head_translation.median(0, keepdim=True).values,
    )
