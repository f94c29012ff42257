"""A colour transform for each camera, which is learned beside the avatar and used only in training.

Cameras of a rig differ in exposure and white balance. Without a transform, the avatar has to explain the differences by
colours that depend on the view, or by fog in front of a camera.
"""

from collections.abc import Sequence as Items
from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

from mien.adam import Moments
from mien.avatar.avatar import ParameterGroup
from mien.avatar.schedules import Rate
from mien.errors import UserError
from mien.render.rendering import Rendering
from mien.training.footage.frames import Frame
from mien.training.footage.sequence import Sequence
from mien.training.settings import TrainSettings

COLOR_RATE = 1e-3  # learning rate of the cameras' colours, and of gains, at the first step
_LAST_SHARE = 0.1  # the same at the last step, as a share of that at the first


class LearnedColors:
    """Numbers of colours that are learned beside the avatar, with their own state of the optimiser."""

    def __init__(self, name: str, values: Tensor):
        self.values = values.detach().clone().requires_grad_()
        self.name, self._rate = name, Rate(COLOR_RATE, _LAST_SHARE * COLOR_RATE)
        self._moments = {"changes": Moments.zeros(values)}

    def parameter_groups(self) -> list[ParameterGroup]:
        """One group of all numbers."""
        return [ParameterGroup(self.name, {"changes": self.values}, self._rate, {**self._moments})]

    def state(self) -> dict[str, Tensor]:
        """Tensors that a checkpoint has to save. They share memory with the numbers."""
        moments = self._moments["changes"]
        return {
            "changes": self.values.detach(), "changes.first": moments.first, "changes.second": moments.second,
            "changes.step": moments.step,
        }  # fmt: skip

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Restore what `state` returned."""
        for name, own in self.state().items():
            own.copy_(state[name])


def recolored(rendering: Rendering, background: Float[Tensor, " 3"], change: Float[Tensor, "3 4"]) -> Rendering:
    """The rendering with other colours: `change` adds a matrix times the colour, and an offset.

    The background keeps its colour.
    """
    alpha = rendering.alpha[..., None]
    foreground = rendering.image - (1 - alpha) * background
    return replace(rendering, image=rendering.image + foreground @ change[:, :3].T + alpha * change[:, 3])


class CameraColors:
    """An affine map of colours for each camera id that is trained on. All start as the identity."""

    def __init__(self, sequences: Items[Sequence], frames: Items[Frame], settings: TrainSettings, like: Tensor):
        trained = {(frame.sequence, frame.camera) for frame in frames}
        ids = dict.fromkeys(sequences[index].capture.camera_ids[camera] for index, camera in sorted(trained))
        if len(ids) < 2:
            raise UserError(
                f"--training.camera-colors {settings.camera_colors}: compares cameras, and this run trains on "
                f"{', '.join(ids)} alone; leave the option out"
            )
        self._first_is_right = settings.camera_colors == "first"
        self.ids = tuple(ids)
        """The cameras, in the order of the maps."""
        self.learned = LearnedColors("colors", like.new_zeros(len(ids), 3, 4))
        places = {camera_id: place for place, camera_id in enumerate(ids)}
        self._places = [[places.get(camera_id, 0) for camera_id in one.capture.camera_ids] for one in sequences]

    def changes(self) -> Float[Tensor, "c 3 4"]:
        """What each camera's map adds to a colour: a matrix, then an offset. That of the right one is zero."""
        changes = self.learned.values
        return changes - (changes[:1] if self._first_is_right else changes.mean(0, keepdim=True))

    def seen_by(self, rendering: Rendering, background: Float[Tensor, " 3"], frame: Frame) -> Rendering:
        """The rendering of a training frame in its camera's colours. The background keeps its colour."""
        return recolored(rendering, background, self.changes()[self._places[frame.sequence][frame.camera]])


def camera_colors(
    sequences: Items[Sequence], frames: Items[Frame], settings: TrainSettings, like: Tensor
) -> CameraColors | None:
    """The colour transforms of a run, or None if its settings ask for none."""
    return None if settings.camera_colors == "none" else CameraColors(sequences, frames, settings, like)
