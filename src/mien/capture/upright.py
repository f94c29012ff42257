"""Check whether a video lies on its side, and why no face was found in it."""

import itertools

import numpy as np

from mien.capture.faces import FaceFinder
from mien.capture.source import FrameSource
from mien.capture.survey import SURVEY_SIZE, Survey
from mien.errors import UserError
from mien.progress import say

_MAX_TURNED = 8
"""Number of pictures that are turned each way..."""
_BEGINNING = 500
"""...from this many at the beginning, preferably with a face."""
_MIN_GAIN = 0.06
"""Smallest mean gain in confidence (0..1) by turning the pictures. In four clips, upright faces had 0.10 to 0.13 more
than the same faces lying on their side, and at least 0.15 more than upside down."""
_MIN_LEVEL, _MAX_LEVEL = 0.12, 0.93
"""Mean levels (0..1) beyond which a video is too dark or too bright."""


def check_upright(frames: FrameSource, survey: Survey, turned: int) -> None:
    """Warn if faces lie on their side, and refuse a video without a face.

    Args:
        frames: the source.
        survey: the source's survey.
        turned: degrees by which the pictures have been turned already.

    Raises:
        UserError: no face was found. The message names the remedy that fits.
    """
    turn = _best_turn(frames, survey)
    option = f"--capture.turn {(turned + turn) % 360}"
    if not np.isfinite(survey.boxes).any():
        raise _no_face(frames, survey, option if turn else "")
    if turn:
        lies = "upside down" if turn == 180 else "on its side"
        say(f"warning: {frames.path}: the face seems to lie {lies}; if it does, add {option}")


def _best_turn(frames: FrameSource, survey: Survey) -> int:
    """Return the degrees clockwise after which faces are found with the most confidence."""
    seen = np.flatnonzero(np.isfinite(survey.boxes[:_BEGINNING, 0, 0]))
    numbers = seen if len(seen) else np.arange(min(_BEGINNING, len(survey.boxes)))
    chosen = set(numbers[:: -(-len(numbers) // _MAX_TURNED)].tolist())
    totals = np.zeros(4)
    with FaceFinder() as finder:
        for index, frame in enumerate(itertools.islice(frames.frames(SURVEY_SIZE), max(chosen) + 1)):
            if index in chosen:
                picture = frame.picture()
                totals += [finder.surest(np.ascontiguousarray(np.rot90(picture, -quarter))) for quarter in range(4)]
    best = int(totals.argmax())
    return 90 * best if totals[best] > totals[0] + _MIN_GAIN * len(chosen) else 0


def _no_face(frames: FrameSource, survey: Survey, option: str) -> UserError:
    level = float(survey.thumbnails.mean()) / 255
    found = f"{frames.path}: no face found in any of its {len(survey.timestamps)} frames"
    if option:
        return UserError(f"{found} as they are; turned, there is one: add {option}")
    if level < _MIN_LEVEL:
        return UserError(f"{found}; it is very dark (mean level {level:.0%}): film again with light on the face")
    if level > _MAX_LEVEL:
        return UserError(f"{found}; it is over-exposed (mean level {level:.0%}): film again with less exposure")
    return UserError(f"{found}; give a video in which one is seen clearly")
