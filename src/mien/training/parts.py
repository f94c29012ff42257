"""What joins a training beside the avatar: the interface of its parts. The trainer calls them and knows none of them.

A part is a record of functions. It gives those that it needs, and the others do nothing. `joining.py` lists the parts
of a run in the order in which they are called.
"""

from collections.abc import Callable
from collections.abc import Sequence as Items
from dataclasses import dataclass, field
from typing import Any

from jaxtyping import Bool, Float
from torch import Tensor

from mien.avatar.avatar import Avatar, ParameterGroup, Posed
from mien.avatar.density import DensityControl
from mien.avatar.schedules import Progress
from mien.avatar.settings import Photometric
from mien.camera import Camera
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.render.rendering import Rendering
from mien.training.density_control.strategy import DensityStrategy
from mien.training.face_track import FaceTrack
from mien.training.footage.coverage import Coverage, measure_coverage
from mien.training.footage.frames import Frame
from mien.training.footage.sequence import Sequence, Target
from mien.training.losses import PerceptualGoal
from mien.training.settings import TrainSettings


@dataclass(frozen=True, eq=False)
class BatchFrame:
    """One frame of a step."""

    number: int
    """Number of frames that the run used before it."""
    frame: Frame
    index: int
    """Its timestep in the track."""
    camera: Camera
    """Its camera, at the size of the target."""
    target: Target
    goal: Callable[[], PerceptualGoal] | None
    """Makes the goal of the perceptual loss. None if the frame is compared without that loss."""


def _when_asked(make: Callable[[], Any]) -> Callable[[], Any]:
    return make


@dataclass(frozen=True, eq=False)
class Step:
    """A training step, as parts see it."""

    avatar: Avatar
    track: FaceTrack
    density: DensityStrategy
    settings: TrainSettings
    batch: tuple[BatchFrame, ...]
    progress: Progress
    """How far the run was before the step."""
    camera: Callable[[Frame], Camera]
    """Returns the camera of a frame, at training resolution."""
    representative: tuple[Frame, ...]
    """A few frames that show the head from all the sides that were filmed."""
    meanwhile: Callable[[Callable[[], Any]], Callable[[], Any]] = _when_asked
    """Returns a function that returns what the given one does, which another thread may call until then."""
    changed: bool = False
    """Whether density control has changed the Gaussians in this step."""

    @property
    def done(self) -> int:
        """Number of steps of the run after this one."""
        return self.progress.step + len(self.batch)

    @property
    def fraction_done(self) -> float:
        """How far the run is after this step, 0..1."""
        return self.done / self.settings.steps

    def reaches(self, every: int) -> bool:
        """Whether the step reaches a multiple of `every`."""
        return passed(self.progress.step, self.done, every)


@dataclass(eq=False)
class Preparation:
    """What a part may need to prepare itself before the first step. The avatar is on the CPU, in float32."""

    avatar: Avatar
    face_model: FaceModel
    sequences: Items[Sequence]
    faces: Items[FaceParams]
    """Face parameters of each sequence."""
    frames: Items[Frame]
    """The frames that are trained on."""
    settings: TrainSettings
    like: Tensor
    """Has the float dtype and the device of the training."""
    known_coverage: Coverage | None = field(default=None)

    @property
    def coverage(self) -> Coverage:
        """The part of the head that the training pictures show, computed at its first use."""
        if self.known_coverage is None:
            self.known_coverage = measure_coverage(self.face_model, self.sequences, self.faces, self.frames)
        return self.known_coverage


def _nothing(step: Step) -> None: ...


def _after_backward(step: Step, renderings: Items[Rendering]) -> None: ...


def _no_losses(step: Step) -> dict[str, Float[Tensor, ""]]:
    return {}


def _posed(posed: Posed, one: BatchFrame) -> Posed:
    return posed


def _seen(rendering: Rendering, one: BatchFrame) -> Rendering:
    return rendering


def _no_groups() -> list[ParameterGroup]:
    return []


def _no_state() -> dict[str, Tensor]:
    return {}


def _stateless(state: dict[str, Tensor]) -> None: ...


def _no_results() -> dict[str, dict[str, Tensor]]:
    return {}


def _weights(weights: Photometric) -> Photometric:
    return weights


def _density(control: DensityControl) -> DensityControl:
    return control


def _settings(settings: TrainSettings) -> TrainSettings:
    return settings


@dataclass(frozen=True, eq=False)
class TrainingPart:
    """Functions that the trainer calls at their times. Those that a part does not give do nothing."""

    name: str
    """Prefix of its tensors in checkpoints."""
    hideable: Bool[Tensor, " f"] | None = None
    """Triangles of which targets say whether the mesh hides them, on the CPU."""
    settings: Callable[[TrainSettings], TrainSettings] = _settings
    """Decides settings that are left open (`auto`)."""
    density: Callable[[DensityControl], DensityControl] = _density
    """Changes the avatar's density control, before the first step."""
    before_step: Callable[[Step], None] = _nothing
    """Changes the avatar before it is posed."""
    posed: Callable[[Posed, BatchFrame], Posed] = _posed
    """Changes the Gaussians of a frame before they are drawn."""
    seen: Callable[[Rendering, BatchFrame], Rendering] = _seen
    """Changes a picture before it is compared."""
    weights: Callable[[Photometric], Photometric] = _weights
    """Changes the weights of the losses that compare pictures."""
    losses: Callable[[Step], dict[str, Float[Tensor, ""]]] = _no_losses
    """Own losses by name, already weighted."""
    rare_losses: tuple[str, ...] = ()
    """Names of losses that not every step has. Curves have them as 0 then."""
    after_backward: Callable[[Step, Items[Rendering]], None] = _after_backward
    """Reads or changes gradients. It gets the pictures as they were drawn."""
    parameter_groups: Callable[[], list[ParameterGroup]] = _no_groups
    """Own trained tensors."""
    after_update: Callable[[Step], None] = _nothing
    """Changes tensors after the optimiser's step and density control."""
    after_step: Callable[[Step], None] = _nothing
    """Works between two steps, after all parts were updated."""
    state: Callable[[], dict[str, Tensor]] = _no_state
    """Tensors that a checkpoint has to save."""
    load_state: Callable[[dict[str, Tensor]], None] = _stateless
    """Restores what `state` returned. Names, types and shapes were checked."""
    results: Callable[[], dict[str, dict[str, Tensor]]] = _no_results
    """Tensors by name that a finished run keeps, by the name of their file in its folder."""


def passed(before: int, now: int, every: int) -> bool:
    """Whether a multiple of `every` was reached since `before`."""
    return now // every > before // every
