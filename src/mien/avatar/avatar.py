"""The interface of avatars: an avatar is a function from face parameters to Gaussians.

A new method is one file with an `Avatar` and its settings, and one line in `mien.avatar.methods` (CONTRIBUTING.md, "Add
a method"). Methods that stay keep their settings in a file of their own, which needs no torch.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from mien.adam import FactoredGradient, FactoredMoments, Moments
from mien.avatar.density import DensityControl
from mien.avatar.schedules import TRAINED, Progress, Rate
from mien.avatar.settings import MethodConfig
from mien.avatar.store import GaussianStore
from mien.face import FaceModel, FaceParams
from mien.gaussians import Gaussians
from mien.render.rendering import Rendering
from mien.runtime.baked import BakedAvatar, Filmed

UNBAKED_REMEDY = "export a .ply instead, or draw it with `mien render`"
"""What to do with avatars that have no record of `mien.runtime`."""
_CALM_SHARE = 0.1
"""Share of the timesteps that are used to estimate the expression at rest."""


@dataclass(frozen=True, eq=False)
class Posed:
    """Gaussians of some timesteps, as `Avatar.pose` returns them."""

    gaussians: Gaussians
    aux: Mapping[str, Tensor]
    """Tensors that the method's own regularizers need, computed once."""


_FILL_HEIGHT = 0.9
"""Height of a fill as a share of the hair's. Hair is thinner at its outline, and a higher fill stands out beyond it."""


@dataclass(frozen=True, eq=False)
class SurfacePrior:
    """What is known of each of the f triangles of a head without training: from the mesh, the mattes and symmetry."""

    hair: Float[Tensor, " f"]
    """Height of hair along the triangle's normal, in metres; 0 on skin that no hair hangs over."""
    hanging: Float[Tensor, " f"] | None = None
    """How far hair that hangs beside skin and neck stands out along the normal, in metres. None means 0."""
    colors: Float[Tensor, "f 3"] | None = None
    """Colours, 0..1, completed where no picture shows any. None if nothing was completed."""
    doubt: Float[Tensor, " f"] | None = None
    """0 for triangles that pictures show well, 1 for those that none shows. None if nothing was completed."""
    made_up: Bool[Tensor, " f"] | None = None
    """Triangles that are filled rather than trained: no picture shows them, and they are above the cut at the neck."""
    closed: Bool[Tensor, " f"] | None = None
    """Triangles that are an opaque surface before the first step: the made-up ones, and the inside of the mouth, which
    is trained where pictures show it. None if these are the made-up ones."""
    strands: Bool[Tensor, " f"] | None = None
    """Made-up triangles that are covered with strands of hair. None means none."""
    looseness: Float[Tensor, " f"] | None = None
    """Factors on the limits to the surface (`Avatar.keep_to`), for parts that the mesh fits less well. None means 1."""

    @property
    def fill_height(self) -> Float[Tensor, " f"]:
        """Height at which a fill lies above its triangle, in metres."""
        return _FILL_HEIGHT * self.hair


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
    factored: Mapping[str, FactoredGradient] = field(default_factory=dict)
    """Gradients, by the names of `tensors`, that `Tensor.grad` does not hold."""
    halvings: tuple[float, ...] = ()
    """Times at which the rate is halved, as fractions of the run."""

    def rate_at(self, progress: Progress) -> float:
        """The learning rate at a step."""
        halved = 0.5 ** sum(progress.fraction >= time for time in self.halvings)
        return self.rate.at(progress) * (progress.extent if self.times_extent else 1.0) * halved


def store_group(store: GaussianStore, name: str, rate: Rate, *, times_extent: bool = False) -> ParameterGroup:
    """The group of one per-Gaussian tensor; its optimiser state stays in the store."""
    return ParameterGroup(name, {name: store[name]}, rate, store.moments, times_extent)


def factored_group(store: GaussianStore, name: str, rate: Rate, gradient: FactoredGradient) -> ParameterGroup:
    """The group of one per-Gaussian tensor [n, k, f] whose gradient is a sum of outer products."""
    return ParameterGroup(name, {name: store[name]}, rate, store.moments, factored={name: gradient})


def network_group(name: str, network: nn.Module, rate: Rate) -> ParameterGroup:
    """The group of all parameters of a network."""
    return ParameterGroup(name, dict(network.named_parameters()), rate)


class Avatar(nn.Module, ABC):
    """Canonical Gaussians and how they depend on the face. Results depend only on arguments, not on the order of calls.

    A method's constructor takes `(config, face_model, face)`. `face` holds the face parameters of all training
    timesteps, from which the method may take the subject's shape and statistics. Random numbers come from torch's
    default generator, which the caller seeds. Every tensor that `pose` needs is a parameter, a buffer or in the store.
    Loading is therefore generic: build an avatar with the stored `subject`, then overwrite its tensors.
    """

    def __init__(self, config: MethodConfig, face_model: FaceModel, face: FaceParams):
        super().__init__()
        self.config = config
        self.face_model = face_model
        self.subject = neutral_of(face)
        """One timestep: this person's identity and offsets, and the face at rest."""
        self.filmed: Filmed | None = None
        """What training saw of the face. None if it is not known, as for imported avatars."""

    @abstractmethod
    def pose(self, face: FaceParams, progress: Progress = TRAINED) -> Posed:
        """The Gaussians of some timesteps, as a batch. Differentiable in `face` and in the avatar's parameters."""

    @abstractmethod
    def regularizers(self, posed: Posed, rendering: Rendering, progress: Progress) -> dict[str, Float[Tensor, ""]]:
        """The method's own loss terms, already weighted. Of several frames, `rendering` is that of the first."""

    @abstractmethod
    def parameter_groups(self) -> list[ParameterGroup]:
        """The trained tensors and their learning rates. Called again after density control has changed the store."""

    @abstractmethod
    def gaussian_store(self) -> GaussianStore:
        """The store that holds every per-Gaussian tensor."""

    @abstractmethod
    def density(self) -> DensityControl:
        """The density control, with this method's hooks."""

    @property
    def frames_per_step(self) -> int:
        """Number of training frames that the next optimiser step uses. Most methods use one."""
        return 1

    @property
    def lesson_count(self) -> int:
        """Number of lessons before the first step. Most methods need none."""
        return 0

    def lessons(self, face: FaceParams) -> Iterator[None]:
        """Teach a new avatar what needs no pictures, given all training timesteps; yields after each lesson."""
        yield from ()

    @property
    def wants_first_colors(self) -> bool:
        """Whether `paint` is to be called before the first step. Most methods learn their colours from nothing."""
        return False

    def paint(self, colors: Float[Tensor, "v 3"]) -> None:
        """Take the face model's vertices' mean colours in the training pictures, 0..1, as first colours."""

    def triangles(self) -> Int[Tensor, " n"] | None:
        """The triangle that each Gaussian is bound to. None for methods that bind none, which train on all pixels."""
        return None

    @property
    def wants_surface(self) -> bool:
        """Whether `keep_to` is to be called after each step, also if nothing is filled."""
        return False

    def close(self, prior: SurfacePrior) -> None:
        """Start from what is known of the surface, before the first step: colours, and fills of what nothing shows."""

    def keep_to(self, prior: SurfacePrior) -> None:
        """Bring Gaussians back that have left what is known of the surface, after each step."""

    def restore(self, rows: Int[Tensor, " k"], prior: SurfacePrior, *, close: bool) -> None:
        """Give some Gaussians the completed colours of their triangles, between two steps.

        With `close`, they also get place, shape and opacity of fills, as at the start. Nothing happens for methods that
        bind no Gaussians.
        """

    def height_gradient(self) -> Float[Tensor, " f"] | None:
        """Derivative of the loss by the height of each triangle's Gaussians above it, per metre, after a backward pass.

        It is the sum over the triangle's Gaussians. None if there is none, or for methods that bind no Gaussians.
        """
        return None

    def raise_surface(self, shift: Float[Tensor, " f"]) -> None:
        """Move Gaussians along the normals of their triangles, by metres, between two steps."""

    def furnish(self, chosen: Bool[Tensor, " f"], opacity: float, colors: Float[Tensor, "f 3"]) -> None:
        """Close the surface of those of the chosen triangles that are less than half opaque, between two steps.

        The number of Gaussians does not change. Nothing happens if `triangles` gives None.

        Args:
            chosen: Triangles that may be closed.
            opacity: Opacity of closed triangles.
            colors: Their colours, 0..1.
        """

    @abstractmethod
    def bake(self) -> BakedAvatar:
        """The avatar as a record of `mien.runtime`, which works without torch and this class: for files and engines.

        Raises:
            UserError: there is no such record (`unbaked`).
        """

    @property
    def unbaked(self) -> str | None:
        """Why `bake` refuses this avatar, with its name. None for all that have a record, which is nearly all."""
        return None


def move_avatar(avatar: Avatar, like: Tensor) -> None:
    """Give an avatar, in place, the float dtype and the device of `like`, together with its face model and its subject.

    Call this before training, because the optimiser's state in the store is not moved.
    """
    if avatar.face_model.template.dtype == like.dtype and avatar.face_model.template.device == like.device:
        return
    avatar.to(like)
    avatar.face_model, avatar.subject = avatar.face_model.to(like), avatar.subject.to(like)


def neutral_of(face: FaceParams) -> FaceParams:
    """The person of `face` at rest, as one timestep. A few bad frames do not change this estimate.

    The expression is the median over the tenth of the timesteps with the smallest expression coefficients, measured by
    their Euclidean norm. What remains in it belongs to the person, for example brows that the tracker always sees
    raised. Joints and head pose are the medians over all timesteps, because people mostly look towards the camera.
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
