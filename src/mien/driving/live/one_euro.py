"""Smoothing that follows fast motion at once: the One Euro filter (Casiez, Roussel and Vogel, CHI 2012).

A low pass whose cutoff grows with the speed of each value: slow values lose their jitter, and fast ones have no lag.
"""

import math

import numpy as np
from jaxtyping import Float

_SPEED_CUTOFF = 3.0
"""Cutoff of the low pass of the speeds, in Hz. Chosen for the exported page with the other two numbers of its filter
(log, "One Euro filter")."""


class OneEuro:
    """The filter of n values."""

    def __init__(self, cutoff: Float[np.ndarray, " n"], beta: Float[np.ndarray, " n"]) -> None:
        """Start a filter.

        Args:
            cutoff: Cutoff at rest, in Hz.
            beta: Growth of the cutoff, in Hz for a speed of one unit a second.
        """
        self._cutoff, self._beta = cutoff, beta
        self._value: Float[np.ndarray, " n"] | None = None
        self._speed = np.zeros(len(cutoff))
        self._seconds = 0.0

    def __call__(self, value: Float[np.ndarray, " n"], seconds: float) -> Float[np.ndarray, " n"]:
        """The smoothed value at a time, which increases. The first value stays as it is."""
        if self._value is None:
            self._value = value.copy()
        elif seconds > self._seconds:
            elapsed = seconds - self._seconds
            speed = (value - self._value) / elapsed
            self._speed += _share(np.full(len(value), _SPEED_CUTOFF), elapsed) * (speed - self._speed)
            cutoff = self._cutoff + self._beta * np.abs(self._speed)
            self._value = self._value + _share(cutoff, elapsed) * (value - self._value)
        self._seconds = seconds
        return self._value.copy()


def _share(cutoff: Float[np.ndarray, " n"], elapsed: float) -> Float[np.ndarray, " n"]:
    """Share of the new value in a low pass."""
    return 1 / (1 + 1 / (2 * math.pi * cutoff * elapsed))
