"""Rates and delays of a camera that is followed: how many frames a second each stage has, and how old pictures are."""

import threading
from collections import deque

import numpy as np

_KEPT_SECONDS = 5.0
"""Time over which the rate that people see now is taken."""
_MOST_DELAYS = 100_000


class Meters:
    """Counts frames of stages, and delays. Any thread may use it."""

    def __init__(self, stages: tuple[str, ...]) -> None:
        """Count for stages with these names."""
        self._lock = threading.Lock()
        self._recent = {stage: deque[float](maxlen=1000) for stage in stages}
        self._first, self._last = dict.fromkeys(stages, 0.0), dict.fromkeys(stages, 0.0)
        self._count = dict.fromkeys(stages, 0)
        self._delays = deque[float](maxlen=_MOST_DELAYS)

    def count(self, stage: str, now: float) -> None:
        """Count a frame of a stage at a time in seconds."""
        with self._lock:
            if not self._count[stage]:
                self._first[stage] = now
            self._last[stage] = now
            self._count[stage] += 1
            self._recent[stage].append(now)

    def delay(self, seconds: float) -> None:
        """Note the time from a frame that came in to its picture that went out."""
        with self._lock:
            self._delays.append(seconds)

    def rates(self, now: float | None = None) -> dict[str, float]:
        """Frames a second of each stage: of the last seconds before `now`, or (None) of the whole time."""
        with self._lock:
            if now is None:
                return {
                    stage: (count - 1) / (self._last[stage] - self._first[stage]) if count > 1 else 0.0
                    for stage, count in self._count.items()
                }
            return {
                stage: sum(now - _KEPT_SECONDS < moment for moment in moments) / _KEPT_SECONDS
                for stage, moments in self._recent.items()
            }

    def delays(self) -> tuple[float, float, int]:
        """Median and 95th percentile of the delays in seconds, and their number. They are NaN without any."""
        with self._lock:
            delays = np.array(self._delays)
        if not len(delays):
            return float("nan"), float("nan"), 0
        return float(np.median(delays)), float(np.percentile(delays, 95)), len(delays)

    def words(self, now: float | None = None) -> list[str]:
        """Lines for people with the rates and the delays."""
        rates = ", ".join(f"{stage} {rate:.1f}" for stage, rate in self.rates(now).items())
        median, late, count = self.delays()
        lines = [f"Frames a second: {rates}"]
        if count:
            lines.append(f"From frame in to picture out: median {1e3 * median:.0f} ms, 95 percent {1e3 * late:.0f} ms")
        return lines
