"""A dataset: how its files are recognised, and what they are read as.

This file needs no torch, because the command line recognises datasets before any work.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    # By their full names: several rooms have a class of the same name, and the reference tells them apart so.
    import mien.avatar
    import mien.capture
    import mien.face
    import mien.tracking


@dataclass(frozen=True, eq=False)
class TrackedSequence:
    """One sequence of a dataset: its pictures, and the face that its authors tracked in them."""

    capture: "mien.capture.Capture"
    """The pictures. The capture's name becomes the name of the sequence."""
    tracking: "mien.tracking.Tracking"
    face_model: "mien.face.FaceModel"
    """The face model that the tracking's parameters belong to."""


@dataclass(frozen=True, eq=False)
class TrainedAvatar:
    """An avatar that another program trained."""

    avatar: "mien.avatar.Avatar"
    face: "mien.face.FaceParams"
    """The person at the t timesteps that came with the avatar."""


@dataclass(frozen=True)
class Dataset:
    """A layout of files, for which there is a reader.

    `recognises(path)` returns what was found, in a few words, or None if the path is something else. It looks at the
    names of files and reads at most small ones, because it is called for any path. It does not raise.

    `read(path, face_model)` returns what `holds` says: sequences, one after the other, so that only one has to be in
    memory, or an avatar. `face_model` is the one that the user named, or None. It raises UserError, in one line that
    names a file, if files are missing or damaged, or if it needs a face model and None is given.
    """

    name: str
    """Name for `mien import --dataset`."""
    about: str
    """The files in a few words, for messages."""
    holds: Literal["sequences", "avatar"]
    recognises: Callable[[Path], str | None]
    read: "Callable[[Path, mien.face.FaceModel | None], Iterable[TrackedSequence] | TrainedAvatar]"
