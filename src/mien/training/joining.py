"""The parts that join a training, in the order in which they are called."""

from collections.abc import Callable

from mien.training.camera_colors import camera_colors_part
from mien.training.frame_gains import frame_gains_part
from mien.training.parts import Preparation, TrainingPart
from mien.training.whole_head.mouth_interior import prepare_inside
from mien.training.whole_head.part import prepare_whole_head


def prepare_parts(given: Preparation) -> Callable[[], tuple[TrainingPart, ...]]:
    """Prepare what joins a run, and return a function that makes the parts once the avatar is on its device."""
    colors = camera_colors_part(given.sequences, given.frames, given.settings, given.like)
    gains = frame_gains_part(given.sequences, given.frames, given.settings, given.like)
    whole_head = prepare_whole_head(given)
    inside = prepare_inside(given)

    def make() -> tuple[TrainingPart, ...]:
        head = None if whole_head is None else whole_head().part()
        return tuple(part for part in (inside, head, gains, colors) if part is not None)

    return make
