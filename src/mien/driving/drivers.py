"""Drivers: the motion of a face, with the same face at rest, from tracked sequences or from recordings."""

from collections.abc import Callable
from collections.abc import Sequence as Items
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor

from mien.avatar.avatar import neutral_of
from mien.driving.expression_map import fit_expression_map
from mien.driving.rest import facing
from mien.driving.sources.blendshape_json import read_blendshape_json
from mien.driving.sources.live_link_face import read_live_link_face
from mien.driving.sources.speech import read_speech
from mien.driving.sources.timing import at_moments, even_moments, rate_of
from mien.driving.transfer import face_of_motion
from mien.errors import UserError
from mien.face.loading import load_face_model
from mien.face.model import FaceModel
from mien.face.params import FaceParams, concatenate, most_frontal_camera
from mien.machine.progress import say
from mien.media.choices import SOUND_ENDINGS
from mien.training.footage.sequence import Sequence, read_sequence

_TRACKED_REST = "the calmest tenth of its frames"
_RECORDED_REST = "where its coefficients are 0, with the head's median pose"


@dataclass(frozen=True, eq=False)
class Driver:
    """The driver of an avatar."""

    face: FaceParams
    at_rest: FaceParams
    """The driver at rest, as one timestep: of a tracked driver, its calmest tenth."""
    fps: float
    pictures: Callable[[int], UInt8[np.ndarray, "h w 3"]] | None
    """Returns the driver's picture at a timestep. None if there are no pictures."""
    sound: Path | None = None
    """A file whose sound belongs to the motion."""
    found: FaceParams | None = None
    """The timesteps in which a face was found, at the recording's own times. None if they are those of `face`."""
    ahead: Float[Tensor, "3 3"] | None = None
    """R_world_head of a head that looks at the camera. The identity if None."""
    rest_is: str = _TRACKED_REST
    """What `at_rest` is, for messages."""

    @property
    def seen(self) -> FaceParams:
        """The timesteps in which a face was found."""
        return self.face if self.found is None else self.found


def read_recording(path: Path, face_model: FaceModel, fps: float | None = None) -> Driver:
    """Read a driver from a recording: a .csv of Live Link Face, a .json of blend shapes, or a voice.

    Args:
        path: The file. Its ending decides its format.
        face_model: The avatar's face model.
        fps: Frame rate of the timecode in a csv.
    """
    suffix = path.suffix.lower()
    is_voice = suffix in SOUND_ENDINGS
    if is_voice:
        motion = read_speech(path)
    else:
        motion = read_live_link_face(path, fps) if suffix == ".csv" else read_blendshape_json(path)
    for note in motion.notes:
        say(note)
    if motion.lost:
        say(f"{path}: {motion.lost} of {len(motion)} frames have no face; each repeats the frame before it")
    face, at_rest = face_of_motion(motion, face_model)
    return Driver(face, at_rest, motion.fps, None, path if is_voice else None, rest_is=_RECORDED_REST)


def read_tracked_driver(folders: Items[Path], face_model: FaceModel | None = None) -> Driver:
    """Read a driver from the folders of tracked sequences of one person, one sequence after the other.

    Frames of a variable rate are resampled by their times (`mien.driving.sources.timing`).

    Args:
        folders: Folders of the sequences.
        face_model: The avatar's face model, in whose terms the motion is returned (`fit_expression_map`). None leaves
            it as it was tracked.
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
    fps = rate_of(max(sequences, key=lambda one: one.capture.timesteps).capture)
    faces: list[FaceParams] = []
    places: list[tuple[Sequence, int]] = []
    for one in sequences:
        moments = even_moments(one.capture, fps)
        shown = range(one.capture.timesteps) if moments is None else moments.nearest().tolist()
        faces.append(one.tracking.face if moments is None else at_moments(one.tracking.face, moments))
        places += [(one, timestep) for timestep in shown]
        if moments is not None:
            say(f"{one.name}: its frames have times of their own; they become {len(shown)} at {fps:.4g} a second")

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
