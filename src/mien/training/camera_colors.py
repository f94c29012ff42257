"""A colour transform for each camera, which is learned beside the avatar and used only in training.

Cameras of a rig differ in exposure and white balance. Without a transform, the avatar has to explain the differences by
colours that depend on the view, or by fog in front of a camera.
"""

from collections.abc import Sequence as Items
from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

from mien.adam import Moments
from mien.avatar import ParameterGroup, Rate
from mien.errors import UserError
from mien.render.rendering import Rendering
from mien.training.constants import TRAINING
from mien.training.footage import Frame, Sequence
from mien.training.parts import TrainingPart
from mien.training.settings import TrainSettings


class CameraColors:
    """An affine map of colours for each camera id that is trained on. All start as the identity.

    Args:
        sequences: The sequences of a run.
        frames: The frames that are trained on.
        settings: The settings of the run.
        like: The maps have its dtype and its device.

    Raises:
        UserError: only one camera is trained on.
    """

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
        self._changes = like.new_zeros(len(ids), 3, 4).requires_grad_()
        self._rate = Rate(settings.camera_color_rate, TRAINING.camera_colors_last_rate * settings.camera_color_rate)
        self._moments = {"changes": Moments.zeros(self._changes.detach())}
        places = {camera_id: place for place, camera_id in enumerate(ids)}
        self._places = [[places.get(camera_id, 0) for camera_id in one.capture.camera_ids] for one in sequences]

    def changes(self) -> Float[Tensor, "c 3 4"]:
        """What each camera's map adds to a colour: a matrix, then an offset. That of the right one is zero."""
        right = self._changes[:1] if self._first_is_right else self._changes.mean(0, keepdim=True)
        return self._changes - right

    def seen_by(self, rendering: Rendering, background: Float[Tensor, " 3"], frame: Frame) -> Rendering:
        """The rendering of a training frame in its camera's colours. The background keeps its colour."""
        change = self.changes()[self._places[frame.sequence][frame.camera]]
        alpha = rendering.alpha[..., None]
        foreground = rendering.image - (1 - alpha) * background
        return replace(rendering, image=rendering.image + foreground @ change[:, :3].T + alpha * change[:, 3])

    def parameter_groups(self) -> list[ParameterGroup]:
        """One group of all maps."""
        return [ParameterGroup("camera_colors", {"changes": self._changes}, self._rate, {**self._moments})]

    def state(self) -> dict[str, Tensor]:
        """Tensors that a checkpoint has to save. They share memory with the maps."""
        moments = self._moments["changes"]
        return {
            "changes": self._changes.detach(), "changes.first": moments.first, "changes.second": moments.second,
            "changes.step": moments.step,
        }  # fmt: skip

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Restore what `state` returned."""
        for name, own in self.state().items():
            own.copy_(state[name])


def camera_colors(
    sequences: Items[Sequence], frames: Items[Frame], settings: TrainSettings, like: Tensor
) -> CameraColors | None:
    """The colour transforms of a run, or None if its settings ask for none.

    Raises:
        UserError: only one camera is trained on.
    """
    return None if settings.camera_colors == "none" else CameraColors(sequences, frames, settings, like)


def camera_colors_part(
    sequences: Items[Sequence], frames: Items[Frame], settings: TrainSettings, like: Tensor
) -> TrainingPart | None:
    """`camera_colors` as a part of a training.

    Raises:
        UserError: only one camera is trained on.
    """
    colors = camera_colors(sequences, frames, settings, like)
    if colors is None:
        return None
    return TrainingPart(
        "colors",
        seen=lambda rendering, one: colors.seen_by(rendering, one.target.background, one.frame),
        parameter_groups=colors.parameter_groups,
        state=colors.state,
        load_state=colors.load_state,
    )
