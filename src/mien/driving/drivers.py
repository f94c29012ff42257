"""Drivers: the motion of a face, with the same face at rest, from tracked sequences or from recordings."""

from collections.abc import Callable
from collections.abc import Sequence as Items
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from mien.avatar.resting import neutral_of
from mien.capture.capture import Capture
from mien.capture.quality import frame_rate, is_pause
from mien.driving.blendshape_json import read_blendshape_json
from mien.driving.expression_map import fit_expression_map
from mien.driving.live_link_face import read_live_link_face
from mien.driving.motion import check_times
from mien.driving.rest import facing, rest_of
from mien.driving.speech import motion_of_sound
from mien.driving.transfer import face_of_motion
from mien.errors import UserError
from mien.face.loading import load_face_model
from mien.face.model import FaceModel
from mien.face.params import FaceParams, concatenate, most_frontal_camera
from mien.machine.progress import say
from mien.media.output import SOUND_ENDINGS
from mien.media.video import read_sound
from mien.rotation import axis_angle_from_matrix, matrix_from_axis_angle
from mien.training.footage.sequence import Sequence, read_sequence

_FIRST_SECONDS = 0.5  # length of the beginning that --neutral first takes
_CALM = "the calmest tenth of its frames"


@dataclass(frozen=True, eq=False)
class Driver:
    """The driver of an avatar."""

    face: FaceParams
    at_rest: FaceParams
    """The driver at rest, as one timestep: of a tracked driver, its calmest tenth."""
    fps: float
    pictures: Callable[[int], UInt8[np.ndarray, "h w 3"]] | None
    """Returns the driver's picture at a timestep, if there are pictures."""
    sound: Path | None = None
    """A file whose sound belongs to the motion."""
    found: FaceParams | None = None
    """The timesteps in which a face was found, at the recording's own times. None if they are those of `face`."""
    ahead: Float[Tensor, "3 3"] | None = None
    """R_world_head of a head that looks at the camera, or the identity."""
    rest_is: str = _CALM
    """What `at_rest` is, for messages."""

    @property
    def seen(self) -> FaceParams:
        """The timesteps in which a face was found."""
        return self.face if self.found is None else self.found


def read_recording(path: Path, face_model: FaceModel, fps: float | None = None) -> Driver:
    """Read a .csv of Live Link Face (with the frame rate of its timecode), a .json of blend shapes, or a voice."""
    suffix = path.suffix.lower()
    if suffix == ".csv":
        motion = read_live_link_face(path, fps)
    else:
        motion = read_blendshape_json(path) if suffix == ".json" else motion_of_sound(read_sound(path))
    for note in motion.notes:
        say(note)
    if motion.lost:
        say(f"{path}: {motion.lost} of {len(motion)} frames have no face; each repeats the frame before it")
    face, at_rest = face_of_motion(motion, face_model)
    sound = path if suffix in SOUND_ENDINGS else None
    rest_is = "where its coefficients are 0, with the head's median pose"
    return Driver(face, at_rest, motion.fps, None, sound, rest_is=rest_is)


def read_tracked_driver(folders: Items[Path], face_model: FaceModel | None = None) -> Driver:
    """Read a driver from the folders of tracked sequences of one person, one sequence after the other.

    Frames of a variable rate are resampled by their times. The motion is returned in the terms of the avatar's face
    model (`fit_expression_map`); None leaves it as it was tracked.
    """
    sequences = [read_sequence(folder) for folder in folders]
    shapes = {(one.tracking.face.expression.shape[1], one.tracking.face.joints.shape[1]) for one in sequences}
    names = ", ".join(map(str, folders))
    if len(shapes) > 1:
        raise UserError(f"{names}: were tracked with different face models; track them again")
    if not any(bool(one.tracking.valid.any()) for one in sequences):
        raise UserError(f"{names}: no frame was tracked; track again, or choose another driver")
    found = concatenate([one.tracking.face[one.tracking.valid] for one in sequences])
    at_rest = neutral_of(found)
    cameras = sequences[0].tracking.cameras
    ahead = facing(cameras[most_frontal_camera(cameras, at_rest)].viewmat)
    longest = max(sequences, key=lambda one: one.capture.timesteps).capture
    fps = frame_rate(longest.timestamps - longest.timestamps[:1], longest.fps)
    faces: list[FaceParams] = []
    places: list[tuple[Sequence, int]] = []
    for one in sequences:
        moments, shown, face = _even_moments(one.capture, fps), range(one.capture.timesteps), one.tracking.face
        if moments is not None:
            before, share = moments
            shown, face = (before + (share > 0.5)).tolist(), _at_moments(face, before, share)
            say(f"{one.name}: its frames have times of their own; they become {len(shown)} at {fps:.4g} a second")
        faces.append(face)
        places += [(one, timestep) for timestep in shown]

    face = concatenate(faces)
    tracked_by = sequences[0].tracking.face_model
    if face_model is not None and tracked_by != face_model.name:
        try:
            own = load_face_model(tracked_by)
        except UserError as error:
            other = f"was tracked with another face model than that of the avatar, {face_model.name!r}"
            raise UserError(f"{names}: {other}, and {error}") from None
        say(f"{names}: tracked with {tracked_by}; its expressions are transferred to {face_model.name}")
        transferred = fit_expression_map(own, face_model)
        face, at_rest, found = transferred(face), transferred(at_rest), transferred(found)

    def picture(index: int) -> UInt8[np.ndarray, "h w 3"]:
        sequence, timestep = places[index]
        return np.asarray(sequence.capture.images[timestep, 0])

    return Driver(face, at_rest, fps, picture, found=found, ahead=ahead)


def with_neutral(
    driver: Driver, model: FaceModel, neutral: str | None, who: str, other: Driver | None = None
) -> Driver:
    """The driver with its face at rest as `--neutral` asks, and a line that says what was taken.

    `neutral` is first, calm, model, the file of the `other` driver, or None for the default: `driver.at_rest` within
    the limits of `rest_of`. `who` is what messages call the driver.
    """
    middle, moved = _median(driver.seen), ()
    if neutral is None:
        rest = rest_of(driver.at_rest, model, driver.ahead)
        face, moved, taken = rest.face, rest.moved, driver.rest_is
    elif neutral == "calm":
        face, taken = neutral_of(driver.seen), _CALM
    elif neutral == "first":
        face = _median(driver.seen[: max(1, round(_FIRST_SECONDS * driver.fps))])
        taken = f"its first {_FIRST_SECONDS:g} s"
    elif neutral == "model":
        zeros, taken = model.neutral(), "the face model's own neutral, with the head towards the camera"
        ahead = zeros.head_rotation if driver.ahead is None else axis_angle_from_matrix(driver.ahead)[None]
        face = replace(middle, expression=zeros.expression, joints=zeros.joints, head_rotation=ahead)
    else:
        assert other is not None, "opened"
        face, taken = _median(other.seen), f"the median of {neutral}"
        if any(getattr(face, name).shape != getattr(driver.at_rest, name).shape for name in ("expression", "joints")):
            raise UserError(
                f"--neutral {neutral}: was tracked with another face model than the driver; track both with that of "
                "the avatar"
            )
        # The head's place stays the driver's, because cameras may stand elsewhere.
        face = replace(face, head_translation=middle.head_translation)
    say(f"{who}: its face at rest is {taken}")
    if moved:
        named = ", ".join(moved[:4]) + (f" and {len(moved) - 4} more" if moved[4:] else "")
        say(
            f"{who}: it never rests ({named}), so this counts as motion; --neutral calm takes it as the face at rest, "
            "and --neutral FILE takes that of another recording"
        )
    return replace(driver, at_rest=face)


def _median(face: FaceParams) -> FaceParams:
    fields = ("expression", "joints", "head_rotation", "head_translation")
    return replace(face, **{name: getattr(face, name).median(0, keepdim=True).values for name in fields})


def _even_moments(capture: Capture, fps: float) -> tuple[Int[np.ndarray, " m"], Float[np.ndarray, " m"]] | None:
    """Moments of a sequence at a rate, or None if its frames are evenly spaced at this rate already.

    They are given as the index of the frame before each, never the last one, and the part of the way to the next frame,
    0..1. In a pause, the face is held until the last moment before the next frame, as a player holds the picture.
    """
    seconds = capture.timestamps - capture.timestamps[:1]
    if len(seconds) < 2 or seconds[-1] <= 0:
        return None
    even = np.arange(round(seconds[-1] * fps) + 1) / fps
    if len(even) == len(seconds) and np.abs(even - seconds).max() < 0.5 / fps:
        return None
    check_times(seconds, lambda index: f"{capture.name}, frame {index}")
    before = np.clip(np.searchsorted(seconds, even + 1e-9, side="right") - 1, 0, len(seconds) - 2)
    steps = np.diff(seconds)
    since = np.where(is_pause(steps)[before], seconds[before + 1] - 1 / fps, seconds[before])
    share = (even - since) / np.maximum(seconds[before + 1] - since, 1e-9)
    return before, np.clip(share, 0, 1)


def _at_moments(face: FaceParams, before: Int[np.ndarray, " m"], shares: Float[np.ndarray, " m"]) -> FaceParams:
    """The face at the moments: numbers change linearly from frame to frame, and rotations along the shortest way."""
    earlier, later = face[before.tolist()], face[(before + 1).tolist()]
    share = torch.from_numpy(shares).to(face.expression)[:, None]
    return replace(
        earlier,
        expression=torch.lerp(earlier.expression, later.expression, share),
        joints=_turned(earlier.joints, later.joints, share[:, None]),
        head_rotation=_turned(earlier.head_rotation, later.head_rotation, share),
        head_translation=torch.lerp(earlier.head_translation, later.head_translation, share),
    )


def _turned(
    earlier: Float[Tensor, "m *j 3"], later: Float[Tensor, "m *j 3"], share: Float[Tensor, "m *#j 1"]
) -> Float[Tensor, "m *j 3"]:
    start = matrix_from_axis_angle(earlier)
    way = axis_angle_from_matrix(start.transpose(-1, -2) @ matrix_from_axis_angle(later))
    return axis_angle_from_matrix(start @ matrix_from_axis_angle(share * way))
