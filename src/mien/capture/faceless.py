"""Why no face may have been found in a video, and what to do about it."""

import itertools

import numpy as np

from mien.capture.faces import FaceFinder
from mien.capture.source import FrameSource
from mien.capture.survey import SURVEY_SIZE, Survey
from mien.errors import UserError

_LOOKED_AT = 8
"""Frames, spread over the video, that are turned to see whether it lies on its side."""
_DARK, _BRIGHT = 0.12, 0.93
"""Mean levels (0..1) beyond which a video is too dark or too bright."""


def explain_no_face(frames: FrameSource, survey: Survey, turned: int) -> UserError:
    """What to tell when nobody is seen, with the remedy that fits.

    Args:
        frames: the source.
        survey: of it, without a face.
        turned: degrees by which its pictures are turned already.
    """
    level = float(survey.thumbnails.mean()) / 255
    found = f"{frames.path}: no face found in any of its {len(survey.timestamps)} frames"
    turn = _turn_that_shows_a_face(frames, len(survey.timestamps))
    if turn:
        return UserError(f"{found} as they are; it lies on its side: add --capture.turn {(turned + turn) % 360}")
    if level < _DARK:
        return UserError(f"{found}; it is very dark (mean level {level:.0%}): film again with light on the face")
    if level > _BRIGHT:
        return UserError(f"{found}; it is over-exposed (mean level {level:.0%}): film again with less exposure")
    return UserError(f"{found}; give a video in which one is seen clearly")


def _turn_that_shows_a_face(frames: FrameSource, count: int) -> int:
    """Degrees clockwise after which most faces are found; 0 if none ever is."""
    seen = dict.fromkeys((90, 270, 180), 0)
    with FaceFinder() as finder:
        for frame in itertools.islice(frames.frames(SURVEY_SIZE), 0, count, -(-count // _LOOKED_AT)):
            picture = frame.picture()
            for turn in seen:
                seen[turn] += len(finder.find(np.ascontiguousarray(np.rot90(picture, -turn // 90)))) > 0
    best = max(seen, key=lambda turn: seen[turn])
    return best if seen[best] else 0
