"""The choice of the driver's face at rest: what `--neutral` means."""

from dataclasses import replace

from mien.avatar.avatar import neutral_of
from mien.driving.drivers import Driver
from mien.driving.rest import rest_of
from mien.errors import UserError
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.machine.progress import say
from mien.rotation import axis_angle_from_matrix

_FIRST_SECONDS = 0.5  # length of the beginning that --neutral first takes, in seconds

_MOST_NAMED = 4


def with_neutral(
    driver: Driver, model: FaceModel, neutral: str | None, who: str, other: Driver | None = None
) -> Driver:
    """The driver with its face at rest as `--neutral` asks, and a line that says what was taken.

    Args:
        driver: The driver. Its `at_rest` is what its frames, or its format, say.
        model: The avatar's face model.
        neutral: first, calm, model, a file, or None for the default: `driver.at_rest` within `rest_of`'s limits.
        who: What messages call the driver.
        other: The driver of the file, if `neutral` is a file.
    """
    seen, moved = driver.seen, ()
    if neutral is None:
        rest = rest_of(driver.at_rest, model, driver.ahead)
        face, moved, taken = rest.face, rest.moved, driver.rest_is
    elif neutral == "calm":
        face, taken = neutral_of(seen), "the calmest tenth of its frames"
    elif neutral == "first":
        face = _median(seen[: max(1, round(_FIRST_SECONDS * driver.fps))])
        taken = f"its first {_FIRST_SECONDS:g} s"
    elif neutral == "model":
        face, taken = _of_model(driver, model), "the face model's own neutral, with the head towards the camera"
    else:
        assert other is not None, "opened"
        face, taken = _of_other(driver, other, neutral), f"the median of {neutral}"
    say(f"{who}: its face at rest is {taken}")
    if moved:
        named = ", ".join(moved[:_MOST_NAMED]) + (
            f" and {len(moved) - _MOST_NAMED} more" if moved[_MOST_NAMED:] else ""
        )
        say(
            f"{who}: it never rests ({named}), so this counts as motion; --neutral calm takes it as the face at rest, "
            "and --neutral FILE takes that of another recording"
        )
    return replace(driver, at_rest=face)


def _median(face: FaceParams) -> FaceParams:
    fields = ("expression", "joints", "head_rotation", "head_translation")
    return replace(face, **{name: getattr(face, name).median(0, keepdim=True).values for name in fields})


def _of_model(driver: Driver, model: FaceModel) -> FaceParams:
    middle, zeros = _median(driver.seen), model.neutral()
    ahead = zeros.head_rotation if driver.ahead is None else axis_angle_from_matrix(driver.ahead)[None]
    return replace(middle, expression=zeros.expression, joints=zeros.joints, head_rotation=ahead)


def _of_other(driver: Driver, other: Driver, file: str) -> FaceParams:
    """The other recording's median face. The head's place stays the driver's, because cameras may stand elsewhere."""
    face = _median(other.seen)
    for name in ("expression", "joints"):
        if getattr(face, name).shape != getattr(driver.at_rest, name).shape:
            raise UserError(
                f"--neutral {file}: was tracked with another face model than the driver; track both with that of the "
                "avatar"
            )
    place = driver.seen.head_translation.median(0, keepdim=True).values
    return replace(face, head_translation=place)
