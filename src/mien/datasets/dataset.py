"""A dataset: how its files are recognised, and what they are read as.

This file needs no torch, because the command line recognises datasets before any work.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    # By their full names: several rooms have a class of the same name, and the reference tells them apart so.
    import numpy

    import mien.avatar
    import mien.camera
    import mien.capture.capture
    import mien.face
    import mien.tracking.tracking
    import mien.training.settings.splits


@dataclass(frozen=True, eq=False)
class TrackedSequence:
    """One sequence of a dataset: its pictures, and the face that its authors tracked in them."""

    capture: "mien.capture.capture.Capture"
    """The pictures. The capture's name becomes the name of the sequence."""
    tracking: "mien.tracking.tracking.Tracking"
    face_model: "mien.face.FaceModel"
    """The face model that the tracking's parameters belong to."""
    own_split: "mien.training.settings.splits.OwnSplit | None" = None
    """Timesteps and cameras that the dataset's authors hold out. None if they name no split."""
    foreign: "Mapping[str, numpy.ndarray]" = field(default_factory=dict)
    """Arrays for which mien has no place, such as coefficients of a model that nobody can ship. They are kept beside
    the capture, in foreign.safetensors."""


@dataclass(frozen=True, eq=False)
class FilmedSequence:
    """One sequence of a dataset without a face that mien can use: pictures, cameras, mattes and landmarks."""

    capture: "mien.capture.capture.Capture"
    own_split: "mien.training.settings.splits.OwnSplit | None" = None
    foreign: "Mapping[str, numpy.ndarray]" = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Footage:
    """One sequence of a dataset that `mien capture` has to process: videos, and perhaps their calibration."""

    name: str
    videos: tuple[Path, ...]
    """A video of each camera, in the order of `cameras`, or one video."""
    cameras: "Mapping[str, mien.camera.Camera] | None" = None
    """Each camera by its id, for uncut pictures. None if the video is not calibrated."""
    clean_plates: Mapping[str, Path] | None = None
    """A picture of the empty scene for each camera, by the camera's id."""
    color_corrections: "Callable[[], Mapping[str, numpy.ndarray]] | None" = None
    """Reads the coefficients [3, n] that correct each camera's colours (`mien.media.color_correction`), by its id.
    It raises UserError if they are damaged. None if there are none."""
    stride: int = 1
    """Take every n-th frame."""
    own_split: "mien.training.settings.splits.OwnSplit | None" = None
    files: "Mapping[str, bytes]" = field(default_factory=dict)
    """Files to keep beside the capture, by name."""


ReadSequence = TrackedSequence | FilmedSequence | Footage


@dataclass(frozen=True, eq=False)
class TrainedAvatar:
    """An avatar that another program trained."""

    avatar: "mien.avatar.Avatar"
    face: "mien.face.FaceParams"
    """The person at the t timesteps that came with the avatar."""


@dataclass(frozen=True)
class Clip:
    """Facts about a sequence that are known before its pictures are read."""

    name: str
    frames: int | None
    """Number of timesteps, or None if only reading tells."""
    cameras: int = 1


@dataclass(frozen=True)
class Findings:
    """The content of a dataset, as the command line tells it before anything is written."""

    clips: tuple[Clip, ...]
    face_model: str | None = None
    """The face model of its tracking, in words. None if it has no tracking that mien can use."""
    split: str | None = None
    """The split of its authors, in words."""
    missing: tuple[str, ...] = ()
    """Parts that are missing or not used, each in words."""
    color_correction: str | None = None
    """The correction of its cameras' colours, in words. None if the layout has none; a missing one is in `missing`."""


@dataclass(frozen=True)
class Dataset:
    """A layout of files, for which there is a reader.

    `recognises(path)` returns what was found, in a few words, or None if the path is something else. It looks at the
    names of files and reads at most small ones, because it is called for any path. It does not raise.

    `read(path, face_model)` returns what `holds` says: sequences, one after the other, so that only one has to be in
    memory, or an avatar. `face_model` is the one that the user named, or None. It raises UserError, in one line that
    names a file, if files are missing or damaged, or if it needs a face model and None is given.

    `survey(path)` returns what the files hold, without reading pictures. `read_pictures(path)` returns the same
    sequences without the tracking of the authors. Both are None for datasets that have no such thing.
    """

    name: str
    """Name for `mien import --dataset`."""
    about: str
    """The files in a few words, for messages."""
    holds: Literal["sequences", "avatar"]
    recognises: Callable[[Path], str | None]
    read: "Callable[[Path, mien.face.FaceModel | None], Iterable[ReadSequence] | TrainedAvatar]"
    survey: Callable[[Path], Findings] | None = None
    read_pictures: "Callable[[Path], Iterable[ReadSequence]] | None" = None
