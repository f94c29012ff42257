"""The schedules of MonoGaussianAvatar: number of points, radii, and the decay of the face model's terms, by epoch.

`paper` is the supplement's section B.1, `code` is what the published code does. A run spans a number of these epochs,
whatever its number of steps. Needs no torch.
"""

import math
from dataclasses import dataclass
from typing import Literal

from mien.avatar.mono_gaussian_avatar.settings import LENGTH_UNIT

_FIRST_RADIUS = 0.15 * 0.75 ** math.log2(400 / 100)
"""Radius at the first epoch, of 400 points, in units of the paper. It follows from the published radius of 100."""
_RADIUS_FACTOR = 0.75  # factor on the radius each time that it shrinks. As published
_RADIUS_FACTOR_AT_60 = 0.9  # factor on the radius at epoch 60 in the schedule `code`. As published
_LATE_LENGTH = 0.004  # distance of children from their parents after epoch 100, in units of the paper. As published
_FACE_HALVINGS = (20, 30, 50, 70)  # epochs at which the weight of the face model's terms halves. As published

ScheduleName = Literal["paper", "code"]

_COUNTS: dict[ScheduleName, dict[int, int]] = {
    "paper": {
        5: 800, 10: 1600, 15: 3200, 20: 6400, 25: 10_000, 30: 20_000, 35: 40_000, 40: 80_000, 50: 100_000,
    },
    "code": {
        5: 800, 10: 1600, 15: 3200, 20: 6400, 25: 10_000, 30: 20_000, 40: 40_000, 50: 80_000, 60: 100_000,
    },
}  # fmt: skip
"""Number of points from an epoch on."""
_SHRINKING: dict[ScheduleName, tuple[int, ...]] = {
    "paper": (5, 10, 15, 20, 25, 30, 35, 40, 50, 60),
    "code": (5, 10, 15, 20, 25, 30, 40, 50),
}
"""Epochs at which the radius shrinks, up to epoch 60. Then it shrinks every 5 epochs."""


@dataclass(frozen=True)
class Schedule:
    """Times are fractions of a run from epoch `first_epoch` to epoch `epochs`. What would come later never happens."""

    name: ScheduleName
    epochs: int
    first_count: int
    first_epoch: int = 0
    late_epoch: int = 102
    """The epoch with whose start children are first put at `MONO.late_length`."""

    def rounds(self) -> tuple[float, ...]:
        """Times at which an epoch ends, but for the last one."""
        length = self.epochs - self.first_epoch
        return tuple(epoch / length for epoch in range(1, length))

    def rendering_radius(self, fraction: float) -> float:
        """Length added to all scales, in metres."""
        epoch = self._epoch(fraction)
        factor = _RADIUS_FACTOR ** sum(epoch >= start for start in _SHRINKING[self.name])
        if self.name == "code":
            factor *= _RADIUS_FACTOR_AT_60 if epoch >= 60 else 1.0
        late = epoch if self.name == "code" else min(epoch, 100)
        return LENGTH_UNIT * _FIRST_RADIUS * factor * _RADIUS_FACTOR ** max(0, (late - 60) // 5)

    def sampling_length(self, fraction: float) -> float:
        """Radius of the sphere (`paper`) or side of the cube (`code`) of children around their parent, in metres.

        The time is that of the last step before a round, and therefore in the epoch that ends.
        """
        if self._epoch(fraction) + 1 >= self.late_epoch:
            return LENGTH_UNIT * _LATE_LENGTH
        return self.rendering_radius(fraction)

    def points_at(self, fraction: float) -> int:
        """The number of points after a round."""
        epoch = self._epoch(fraction)
        return max([self.first_count, *(count for start, count in _COUNTS[self.name].items() if epoch >= start)])

    def face_decay(self, fraction: float) -> float:
        """Factor on the weight of the face model's terms."""
        return 0.5 ** sum(self._epoch(fraction) >= epoch for epoch in _FACE_HALVINGS)

    def _epoch(self, fraction: float) -> int:
        """Number of whole epochs before a time; after the run, the number of its last one."""
        # Times of rounds are epoch / length, which multiplied by the length may be a little less than the epoch.
        passed = int(fraction * (self.epochs - self.first_epoch) + 1e-6)
        return min(self.first_epoch + passed, self.epochs - 1)
