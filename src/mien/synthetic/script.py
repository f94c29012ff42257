"""Lay out a clip's script in time, with the head's wide turns."""

from dataclasses import dataclass
from itertools import accumulate

import numpy as np

from mien.synthetic.noise import smoothstep
from mien.synthetic.recipe import Segment, SegmentKind, SyntheticRecipe

_RAMP = 0.5
"""Seconds in which a part fades in and out."""
_TURNS = ((0.0, 1.0), (0.0, -1.0), (0.7, 0.0), (-0.8, 0.0), (0.4, 0.7), (-0.4, -0.7), (0.4, -0.7), (-0.4, 0.7))
"""Goals of successive turns, as shares of the largest pitch (positive looks down) and yaw."""
_TURN_SECONDS = 2.2
"""Seconds from one goal to the next."""


@dataclass(frozen=True)
class Span:
    """A segment with its start and end in the clip, in seconds."""

    kind: SegmentKind
    start: float
    end: float
    first: bool
    last: bool

    def window(self, times: np.ndarray) -> np.ndarray:
        """Return 1 inside and 0 outside, with soft ends inside, except at the beginning and the end of the clip."""
        ramp = min(_RAMP, 0.25 * (self.end - self.start))
        rise = 1.0 if self.first else smoothstep(self.start, self.start + ramp, times)
        fall = 0.0 if self.last else smoothstep(self.end - ramp, self.end, times)
        return rise - fall + np.zeros_like(times)


def spans_of(recipe: SyntheticRecipe) -> tuple[Span, ...]:
    """Return the recipe's script as spans in time."""
    segments = recipe.script or (Segment("free", recipe.seconds),)
    ends = list(accumulate(segment.seconds for segment in segments))
    last = len(segments) - 1
    return tuple(
        Span(segment.kind, end - segment.seconds, end, index == 0, index == last)
        for index, (segment, end) in enumerate(zip(segments, ends, strict=True))
    )


def moving_clock(times: np.ndarray, spans: tuple[Span, ...]) -> np.ndarray:
    """Return the seconds of motion so far: a clock that stops while the script is still."""
    speed = 1 - sum((span.window(times) for span in spans if span.kind == "still"), np.zeros_like(times))
    step = float(times[1] - times[0]) if len(times) > 1 else 0.0
    return np.concatenate([[0.0], np.cumsum(speed[:-1]) * step])


def share_of(kind: SegmentKind, times: np.ndarray, spans: tuple[Span, ...]) -> np.ndarray:
    """Return the share of this kind at each time, 0..1."""
    return sum((span.window(times) for span in spans if span.kind == kind), np.zeros_like(times))


def wide_turns(times: np.ndarray, spans: tuple[Span, ...], pitch: float, yaw: float) -> tuple[np.ndarray, np.ndarray]:
    """Return pitch and yaw of the turns, up to these angles: sideways, up, down, diagonally, and back."""
    down, left = np.zeros_like(times), np.zeros_like(times)
    for span in spans:
        if span.kind != "turns":
            continue
        before = np.zeros(2)
        moves = max(int((span.end - span.start) / _TURN_SECONDS), 2)
        length = (span.end - span.start) / moves
        for index in range(moves):
            goal = np.array(_TURNS[index % len(_TURNS)] if index < moves - 1 else (0.0, 0.0))
            begin = span.start + index * length
            share = smoothstep(begin, begin + 0.9 * length, times)
            down += share * (goal - before)[0]
            left += share * (goal - before)[1]
            before = goal
    return pitch * down, yaw * left
