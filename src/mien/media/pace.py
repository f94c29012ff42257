"""Step 5: the frame rate of a clip, the times between its frames, and its pauses."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from mien.machine.progress import say

_RATE_TOLERANCE = 0.01  # relative difference up to which the measured frame rate is taken for the file's nominal one
_RATE_STEADY_RATIO = 1.6
"""Ratio to the median up to which times between frames count for the rate. It is above 1.5, which films at 24 frames a
second have on a grid of 60: they alternate between two and three steps."""

_MAX_INTERVAL_RATIO = 1.5
"""Ratio of the longest to the median time between frames from which a clip's rate is called variable."""
_PAUSE_SECONDS, _PAUSE_STEPS = 0.5, 2.5
"""Time between two frames from which it is called a pause: in seconds, and as a multiple of the median, so that a
dropped frame of a slow clip is none."""


def pace_report(name: str, timestamps: Float[np.ndarray, " t"]) -> dict[str, Any]:
    """Return the time between frames for the report, and tell the user if it varies."""
    if len(timestamps) < 3:
        return {"frame_interval_ms": None, "variable_frame_rate": False}
    intervals = 1000 * np.diff(timestamps)
    least, usual, most = (round(float(value), 2) for value in (intervals.min(), np.median(intervals), intervals.max()))
    is_variable = most > _MAX_INTERVAL_RATIO * usual or least * _MAX_INTERVAL_RATIO < usual
    if is_variable:
        say(f"{name}: frames {least:g} to {most:g} ms apart (variable rate); all are kept, each with its own time")
    return {
        "frame_interval_ms": {"least": least, "median": usual, "most": most},
        "variable_frame_rate": is_variable,
        **tell_pauses(name, timestamps),
    }


def is_pause(steps: Float[np.ndarray, " s"]) -> Bool[np.ndarray, " s"]:
    """Tell which times between frames are pauses, in which the video has no frame for long."""
    return steps > max(_PAUSE_SECONDS, _PAUSE_STEPS * float(np.median(steps)))


def tell_pauses(name: str, timestamps: Float[np.ndarray, " t"]) -> dict[str, int]:
    """Tell the user about pauses. Return their number for the report, or nothing if there is none."""
    steps = np.diff(timestamps)
    pauses = np.flatnonzero(is_pause(steps)) if len(steps) else []
    if not len(pauses):
        return {}
    longest = pauses[int(np.argmax(steps[pauses]))]
    which = "a pause" if len(pauses) == 1 else f"{len(pauses)} pauses, the longest"
    say(
        f"{name}: {which} of {steps[longest]:.1f} s without a frame, after {timestamps[longest]:.1f} s; the frame rate "
        "is that of the other frames"
    )
    return {"pauses": len(pauses)}


def frame_rate(timestamps: Float[np.ndarray, " t"], nominal: float) -> float:
    """Return the file's nominal rate, unless its timestamps differ from it (variable rate, dropped frames, pauses).

    Then it is the rate of the frames that are about as far apart as the median, so that pauses and dropped frames do
    not count.
    """
    steps = np.diff(timestamps)
    usual = float(np.median(steps)) if len(steps) else 0.0
    if usual <= 0:
        return nominal
    steady = (steps <= _RATE_STEADY_RATIO * usual) & (steps * _RATE_STEADY_RATIO >= usual)
    if steady.all():
        measured = float(len(steps) / timestamps[-1])
    else:
        measured = 1 / float(steps[steady].mean() if steady.any() else usual)
    return nominal if abs(measured - nominal) <= _RATE_TOLERANCE * nominal else measured
