"""The frames of a tracked sequence that are written: those that mien trains on, and those that it holds out."""

from collections.abc import Sequence as Items
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float, UInt8

from mien.datasets.flame_poses import AXES, face_of_flame, in_front
from mien.datasets.layouts.layout import MatteKind
from mien.face.model import FaceModel
from mien.face.models.flame_params import flame_params_of
from mien.face.params import FaceParams
from mien.rotation import matrix_from_axis_angle
from mien.training.footage.foreground import foreground_colors
from mien.training.footage.frames import held_out_of, training_frames
from mien.training.footage.sequence import Sequence, composite

if TYPE_CHECKING:
    from mien.camera import Camera
    from mien.training.settings import TrainSettings

_WHITE = np.full(3, 255, np.uint8)


@dataclass(frozen=True, eq=False)
class Filmed:
    """A tracked sequence, and its frames by what they are for."""

    sequence: Sequence
    face_model: FaceModel
    trained: tuple[int, ...]
    """Timesteps that are trained on, in order."""
    held_out: tuple[int, ...]
    """Timesteps that are held out in all cameras, in order."""
    hidden: tuple[int, ...] = ()
    """Indices of cameras that are held out at all timesteps."""
    matte_kind: MatteKind = "head"

    @property
    def timesteps(self) -> list[int]:
        """All timesteps that are written, in order."""
        return sorted((*self.trained, *self.held_out))

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the pictures."""
        return self.sequence.capture.width, self.sequence.capture.height

    @property
    def camera(self) -> "Camera":
        """The first camera."""
        return self.sequence.tracking.cameras[0]

    @property
    def K(self) -> Float[np.ndarray, "3 3"]:
        """Intrinsics of the first camera in pixels, whose corners are whole numbers."""
        return self.camera.K.double().numpy()

    def image(self, timestep: int, camera: int = 0) -> UInt8[np.ndarray, "h w 3"]:
        """Return a picture as it was filmed."""
        return np.array(self.sequence.capture.images[timestep, camera])

    def matte(self, timestep: int, camera: int = 0) -> UInt8[np.ndarray, "h w"]:
        """Return the opacity of what is written."""
        mattes = self.sequence.scoring if self.matte_kind == "head" else self.sequence.capture.mattes
        return np.array(mattes[timestep, camera])

    def over_white(self, timestep: int) -> UInt8[np.ndarray, "h w 3"]:
        """Return a picture of the first camera over white, by its matte."""
        return composite(self.image(timestep), self.matte(timestep), _WHITE)

    def truth(self, timestep: int, camera: int) -> UInt8[np.ndarray, "h w 3"]:
        """Return the picture that `mien evaluate` compares with: the head over white, with cleaned edges."""
        capture = self.sequence.capture
        picture = foreground_colors(self.image(timestep, camera), np.asarray(capture.mattes[timestep, camera]))
        return composite(picture, np.asarray(self.sequence.scoring[timestep, camera]), _WHITE)

    def scored(self) -> list[tuple[int, int]]:
        """Return the held-out pictures: timestep and camera."""
        usable = self.sequence.usable()
        cameras = range(usable.shape[1])
        later = [(t, c) for t in self.held_out for c in cameras if usable[t, c]]
        return later + [(t, c) for t in self.trained for c in self.hidden if usable[t, c]]

    def face(self) -> FaceParams:
        """Return the faces at all written timesteps, seen by `flame_poses.FRONT` in place of the first camera."""
        return in_front(self.sequence.tracking.face[self.timesteps], self.camera.viewmat.double().numpy())

    def head_to_camera(self) -> Float[np.ndarray, "t 4 4"]:
        """Return the head frame's pose at each written timestep in the first camera's OpenCV axes, in metres."""
        face = self.face()
        poses = np.tile(np.eye(4), (len(face), 1, 1))
        poses[:, :3, :3] = AXES @ matrix_from_axis_angle(face.head_rotation.double()).numpy()
        poses[:, :3, 3] = face.head_translation.double().numpy() @ AXES
        return poses


def filmed_frames(sequence: Sequence, face_model: FaceModel, settings: "TrainSettings", mattes: MatteKind) -> Filmed:
    """Return the frames of a sequence that mien trains on, and those that it holds out. Others are left out."""
    trained = {frame.timestep for frame in training_frames([sequence], settings)}
    left_out = held_out_of(sequence, settings.split).numpy()
    usable = sequence.usable().any(1)
    ids = sequence.capture.camera_ids
    hidden = tuple(index for index, name in enumerate(ids) if name in settings.held_out_cameras)
    later = np.flatnonzero(left_out & usable).tolist()
    return Filmed(sequence, face_model, tuple(sorted(trained)), tuple(later), hidden, mattes)


def motion_between(rest: FaceParams, face: FaceParams) -> tuple[Float[np.ndarray, "t 3 3"], Float[np.ndarray, "t 3"]]:
    """Return the rigid motions x -> R x + t that carry the heads of `rest` to those of `face`, in float64."""
    before, after = (matrix_from_axis_angle(each.head_rotation.double()) for each in (rest, face))
    turns = after @ before.mT
    shifts = face.head_translation.double() - torch.einsum("tij,tj->ti", turns, rest.head_translation.double())
    return turns.numpy(), shifts.numpy()


def as_flame(
    folder: Path, filmed: Filmed, face: FaceParams, poses: Items[str], shapes: int, expressions: int
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], Float[np.ndarray, "t 3 3"], Float[np.ndarray, "t 3"]]:
    """Return faces as FLAME's arrays: whole, and those that a layout holds, with so many coefficients.

    Then follow the rigid motions that carry FLAME's heads with the latter to the faces: heads stay where they were
    tracked, also if coefficients that move FLAME's joints are cut.
    """
    whole = flame_params_of(folder, filmed.face_model, face)
    held = {name: whole[name].astype(np.float64) for name in poses}
    held |= {"shape": padded(whole["shape"], shapes), "expr": padded(whole["expr"], expressions)}
    return whole, held, *motion_between(face_of_flame(folder, filmed.face_model, held), face)


def vectors(filmed: Filmed, count: int) -> tuple[Float[np.ndarray, "t n"], tuple[str, ...]]:
    """Return `count` numbers a timestep in place of a foreign model's expressions, and what is said of them.

    If there is no room for all expressions, those that change most are kept.
    """
    face, model = filmed.face(), filmed.face_model
    moved = [name for name in model.free_joint_names if name != "neck"]
    joints = [face.joints[:, model.free_joint_names.index(name)] for name in moved]
    room = count - 3 * len(joints)
    values = face.expression.double().numpy()
    kept = np.sort(np.argsort(-values.std(0), kind="stable")[:room])
    lost = values.shape[1] - len(kept)
    columns = [values[:, kept], *(joint.double().numpy() for joint in joints)]
    told = (
        f"expression: {len(kept)} expression coefficients of {model.name}, then axis-angles of "
        f"{', '.join(moved) or 'no joint'}, then zeros. They are not the {count} of the layout's own model.",
        "Lost: the neck joint, identity and the mesh itself.",
        *[f"Lost: the {lost} expression coefficients that change least."][: lost > 0],
    )
    return padded(np.concatenate(columns, axis=1), count), told


def padded(values: np.ndarray, count: int) -> np.ndarray:
    """Return coefficients with `count` columns: zeros are added, and those beyond are left out."""
    whole = np.zeros((*values.shape[:-1], count))
    known = min(count, values.shape[-1])
    whole[..., :known] = values[..., :known]
    return whole


def lost_words(name: str, values: np.ndarray, count: int) -> tuple[str, ...]:
    """Return what is said of coefficients beyond `count`, if any is not zero."""
    lost = values.shape[-1] - count
    if lost <= 0 or not values[..., count:].any():
        return ()
    return (f"Lost: the last {lost} of {values.shape[-1]} {name} coefficients, for which the layout has no place.",)
