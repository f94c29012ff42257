"""The interface of avatars: an avatar is a function from face parameters to Gaussians.

A new method is one file with an `Avatar` and its settings, and one line in `mien.avatar.methods` (CONTRIBUTING.md, "Add
a method"). Methods that stay keep their settings in a file of their own, which needs no torch.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field

from jaxtyping import Float
from torch import Tensor, nn

from mien.adam import EPSILON, FactoredGradient, FactoredMoments, Moments
from mien.avatar.bound_surface import BoundSurface
from mien.avatar.density import DensityControl
from mien.avatar.resting import at_rest
from mien.avatar.settings import TRAINED, MethodConfig, Progress, Rate
from mien.avatar.store import GaussianStore
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.gaussians import Gaussians, Rendering
from mien.runtime.baked import BakedAvatar, Filmed

UNBAKED_REMEDY = "export a .ply instead, or draw it with `mien render`"
"""What to do with avatars that have no record of `mien.runtime`."""


@dataclass(frozen=True, eq=False)
class Posed:
    """Gaussians of some timesteps, as `Avatar.pose` returns them."""

    gaussians: Gaussians
    aux: Mapping[str, Tensor]
    """Tensors that the method's own regularizers need, computed once."""


@dataclass(frozen=True, eq=False)
class ParameterGroup:
    """Tensors that share a learning rate."""

    name: str
    tensors: Mapping[str, Tensor]
    """Leaves of the autograd graph, by name."""
    rate: Rate
    moments: dict[str, Moments | FactoredMoments] | None = None
    """State of the optimiser, by the names of `tensors`. If it is None, the optimiser keeps the state
    itself, by group and name."""
    times_extent: bool = False
    """Whether the rate is multiplied by the extent of the cameras (`Progress.extent`)."""
    times_root_frames: bool = False
    """Whether the rate is multiplied by the root of the number of frames of a step, whose mean gradient is steadier."""
    factored: Mapping[str, FactoredGradient] = field(default_factory=dict)
    """Gradients, by the names of `tensors`, that `Tensor.grad` does not hold."""
    halvings: tuple[float, ...] = ()
    """Times at which the rate is halved, as fractions of the run."""
    begin: float = 0.0
    """Time up to which the rate is 0, as a fraction of the run."""
    epsilon: float = EPSILON
    """Adam's epsilon. It does not reach gradients that are `factored`."""
    factored_moments: type[Moments] | type[FactoredMoments] = FactoredMoments
    """State of the optimiser for gradients that are `factored`: `Moments` are Adam's as published."""

    def rate_at(self, progress: Progress) -> float:
        """The learning rate at a step."""
        if progress.fraction < self.begin:
            return 0.0
        halved = 0.5 ** sum(progress.fraction >= time for time in self.halvings)
        rate = self.rate.at(progress) * (progress.extent if self.times_extent else 1.0) * halved
        return rate * math.sqrt(progress.frames) if self.times_root_frames else rate


def store_group(store: GaussianStore, name: str, rate: Rate, *, times_extent: bool = False) -> ParameterGroup:
    """The group of one per-Gaussian tensor; its optimiser state stays in the store."""
    return ParameterGroup(name, {name: store[name]}, rate, store.moments, times_extent)


def factored_group(
    store: GaussianStore,
    name: str,
    rate: Rate,
    gradient: FactoredGradient,
    moments: type[Moments] | type[FactoredMoments] = FactoredMoments,
) -> ParameterGroup:
    """The group of one per-Gaussian tensor [n, k, f] whose gradient is a sum of outer products."""
    own = {name: store[name]}
    return ParameterGroup(name, own, rate, store.moments, factored={name: gradient}, factored_moments=moments)


def network_group(name: str, network: nn.Module, rate: Rate) -> ParameterGroup:
    """The group of all parameters of a network."""
    return ParameterGroup(name, dict(network.named_parameters()), rate)


@dataclass(frozen=True, eq=False)
class Pretraining:
    """Training of a new avatar before the first picture."""

    count: int
    """Number of steps."""
    run: Callable[[FaceParams], Iterator[None]]
    """Trains it, given all training timesteps. Yields after each step."""


@dataclass(frozen=True, eq=False)
class Extras:
    """Properties that only some methods have. The defaults are those of most methods."""

    surface: BoundSurface | None = None
    """The surface that the Gaussians are bound to. None for methods that bind none, which train on all pixels."""
    frames_per_step: Callable[[float], int] = lambda _: 1
    """Returns the number of training frames of the next optimiser step, given the fraction of the run that is over."""
    apart: bool = False
    """Whether the frames of a step share nothing but the trained tensors, so that each may have a thread of its own."""
    pretraining: Pretraining | None = None
    """Training before the first picture. None if the avatar needs none."""
    closing: int = 0
    """Pixels by which finished pictures are eroded and then dilated (`close_holes`)."""
    unbaked: str | None = None
    """Why `bake` refuses the avatar, with its name. None for all that have a record, which is nearly all."""
    graph_key: Callable[[Progress], Hashable] | None = None
    """Returns the numbers from the host in a pose, if a CUDA graph of it does the same (`mien.training.graphs`): the
    pose has no side effects, as a factored gradient is one, and gives Gaussians alone."""


class Avatar(nn.Module, ABC):
    """Canonical Gaussians and how they depend on the face. Results depend only on arguments, not on the order of calls.

    A method's constructor takes `(config, face_model, face)`. `face` holds the face parameters of all training
    timesteps, from which the method may take the subject's shape and statistics. Random numbers come from torch's
    default generator, which the caller seeds. Every tensor that `pose` needs is a parameter, a buffer or in the store.
    Loading is therefore generic: build an avatar with the stored `subject`, then overwrite its tensors.

    Methods implement what is abstract and override nothing else. What only some methods have is in `extras`.
    """

    store: GaussianStore
    """Holds every per-Gaussian tensor. The method's constructor makes it."""

    def __init__(self, config: MethodConfig, face_model: FaceModel, face: FaceParams, extras: Extras = Extras()):
        super().__init__()
        self.config = config
        self.extras = extras
        self.face_model = face_model
        self.subject = at_rest(face, face_model)
        """One timestep: this person's identity and offsets, and the face at rest."""
        self.filmed: Filmed | None = None
        """The part of the face that training saw. None if it is not known, as for imported avatars."""

    @abstractmethod
    def pose(self, face: FaceParams, progress: Progress = TRAINED) -> Posed:
        """The Gaussians of some timesteps, as a batch, or of one without a batch axis.

        Differentiable in `face` and in the avatar's parameters.
        """

    @abstractmethod
    def regularizers(self, posed: Posed, rendering: Rendering, progress: Progress) -> dict[str, Float[Tensor, ""]]:
        """The method's own loss terms, already weighted. Of several frames, `rendering` is that of the first."""

    @abstractmethod
    def parameter_groups(self) -> list[ParameterGroup]:
        """The trained tensors and their learning rates. Called again after density control has changed the store."""

    @abstractmethod
    def density(self) -> DensityControl:
        """The density control, with this method's hooks."""

    @abstractmethod
    def bake(self) -> BakedAvatar:
        """The avatar as a record of `mien.runtime`, which works without torch and this class: for files and engines."""


def move_avatar(avatar: Avatar, like: Tensor) -> None:
    """Give an avatar, in place, the float dtype and the device of `like`, together with its face model and its subject.

    Call this before training, because the optimiser's state in the store is not moved.
    """
    if avatar.face_model.template.dtype == like.dtype and avatar.face_model.template.device == like.device:
        return
    avatar.to(like)
    avatar.face_model, avatar.subject = avatar.face_model.to(like), avatar.subject.to(like)


@contextmanager
def frozen(avatar: Avatar) -> Iterator[None]:
    """Let gradients reach the face alone, and leave none in the avatar."""
    trained = [tensor for tensor in avatar.parameters() if tensor.requires_grad]
    for tensor in trained:
        tensor.requires_grad_(False)
    try:
        yield
    finally:
        for tensor in trained:
            tensor.requires_grad_(True)
