"""The seam: an avatar is a function from face parameters to Gaussians.

A new method is one file with an `Avatar`, one with its settings, and one line in `mien.avatar.methods`.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace

from jaxtyping import Float
from torch import Tensor, nn

from mien.avatar.baked import BakedAvatar
from mien.avatar.density import DensityControl
from mien.avatar.schedules import TRAINED, Progress, Rate
from mien.avatar.settings import MethodConfig
from mien.avatar.store import GaussianStore, Moments
from mien.face import FaceModel, FaceParams
from mien.gaussians import Gaussians
from mien.render.rendering import Rendering

_CALM_SHARE = 0.1
"""Share of the timesteps that count as at rest."""


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
