"""The first pass over a source: where the followed face is in every frame, and how many frames there are."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from mien.capture.faces import FaceFinder, FaceFollower
from mien.capture.source import FrameSource
from mien.errors import UserError
from mien.progress import progress_bar, say
from mien.storage import read_arrays, write_arrays

_SURVEY_SIZE = 512
"""Longest side, pixels, of the pictures in which faces are searched: the detectors see 192 pixels at most."""


@dataclass(frozen=True, eq=False)
class Survey:
    """What the first pass found."""

    timestamps: Float[np.ndarray, " t"]
    """Seconds from the first frame."""
    boxes: Float[np.ndarray, "t 4"]
    """Left, top, right, bottom of the followed face as fractions of the picture; NaN where there is none."""
    picture_size: Float[np.ndarray, " 2"]
    """Width and height of the source, pixels."""
    crowded: Float[np.ndarray, " 1"]
    """The number of frames with several faces."""


def survey_faces(frames: FrameSource, memory: Path) -> Survey:
    """Look at all frames, or read from the file `memory` what an earlier call saw.

    Raises:
        UserError: the source cannot be decoded, or shows no face.
    """
    if memory.exists():
        return Survey(**read_arrays(memory))
    timestamps: list[float] = []
    boxes: list[np.ndarray] = []
    follower = FaceFollower()
    first_frame = next(frames.frames())[1]
    title = f"find the face in {frames.path.name}"
    with FaceFinder() as finder, progress_bar(title, frames.expected_frames) as advance:
        for seconds, image in frames.frames(_SURVEY_SIZE):
            box = follower.choose(finder.find(image), seconds)
            boxes.append(np.full(4, np.nan) if box is None else box)
            timestamps.append(seconds)
            advance()
    if np.isnan(boxes).all():
        raise no_face(frames.path, len(boxes))
    if follower.crowded:
        say(
            f"warning: {frames.path}: several faces in {follower.crowded} of {len(boxes)} frames; "
            "the one that is largest at first is followed"
        )
    survey = Survey(
        timestamps=np.array(timestamps),
        boxes=np.array(boxes),
        picture_size=np.array([first_frame.shape[1], first_frame.shape[0]], float),
        crowded=np.array([follower.crowded], float),
    )
    write_arrays(memory, vars(survey))
    return survey


def no_face(path: Path, frames: int) -> UserError:
    """What to tell when nobody is seen."""
    return UserError(f"{path}: no face found in any of its {frames} frames; give a video in which one is seen clearly")
