"""The remaining time of a command of several stages, from expected times that calibrate themselves as pieces finish."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

_PRIOR_SECONDS = 3.0
"""Weight of the expected times against measured ones, as seconds of measured work."""
_TRUSTED_SHARE = 0.1
"""Share of a piece after which its own speed alone tells how long the rest of it takes."""


@dataclass(frozen=True)
class Piece:
    """A part of a stage that has a progress bar of its own."""

    stage: str
    """Name of the stage."""
    title: str
    """Beginning of the title of its progress bar."""
    seconds: float
    """Expected time on a machine like that of docs/results.md, in seconds. Only the ratios matter in the end."""


class Overall:
    """How far a command is, and how long the rest will take. Mutable.

    Pieces come in their order. A piece whose bar never opens, because its result is current, takes no time. A bar that
    no piece belongs to changes nothing.
    """

    def __init__(self, pieces: Sequence[Piece], clock: Callable[[], float] = time.monotonic) -> None:
        self._pieces, self._clock = tuple(pieces), clock
        self._stages = list(dict.fromkeys(piece.stage for piece in pieces))
        self._at = -1
        self._began, self._first, self._share, self._own = 0.0, 0.0, 1.0, 0.0
        self._expected, self._measured = _PRIOR_SECONDS, _PRIOR_SECONDS

    def begin(self, title: str, share: float) -> bool:
        """Note that a bar opens with this share done already; return whether it is a piece's."""
        found = self._find(title)
        if found is None:
            return False
        # The expected time of a piece counts once, with its first part.
        self._own = self._pieces[found].seconds * (1.0 - share) if found != self._at else 0.0
        self._at, self._began, self._first, self._share = found, self._clock(), share, share
        return True

    def advance(self, share: float) -> None:
        """Note that this share of the current piece is done."""
        self._share = min(max(share, self._share), 1.0)

    def end(self) -> None:
        """Note that the current piece is done. Its time tells how long the later ones will take."""
        self._share = 1.0
        self._expected += self._own
        self._measured += self._clock() - self._began if self._first < 1.0 else 0.0

    def remaining(self) -> float:
        """The expected time to the end of the command, in seconds."""
        pace = self._measured / self._expected
        return self._rest(pace) + pace * sum(piece.seconds for piece in self._pieces[self._at + 1 :])

    def stage(self) -> int:
        """Number of the current stage, from 1; 0 before the first."""
        return self._stages.index(self._pieces[self._at].stage) + 1 if self._at >= 0 else 0

    def stage_name(self) -> str | None:
        """Name of the current stage; None before the first."""
        return self._pieces[self._at].stage if self._at >= 0 else None

    def words(self) -> str:
        """The stage and the remaining time, for people."""
        number = self.stage()
        name = self._stages[number - 1] if number else "start"
        return f"stage {number} of {len(self._stages)} ({name}), {_about(self.remaining())} left of the whole command"

    def short_words(self) -> str:
        """The same for a place beside a progress bar."""
        return f"all: stage {self.stage()} of {len(self._stages)}, {_about(self.remaining())}"

    def _find(self, title: str) -> int | None:
        """The next piece of this title. A bar that comes once more, for another part of a clip, is the same piece."""
        own = [index for index, piece in enumerate(self._pieces) if title.startswith(piece.title)]
        later = [index for index in own if index > self._at]
        return later[0] if later else self._at if self._at in own else None

    def _rest(self, pace: float) -> float:
        """The expected time to the end of the current piece: as expected at first, then as measured."""
        if self._share >= 1.0:
            return 0.0
        spent, gained = self._clock() - self._began, self._share - self._first
        expected = max(pace * self._own - spent, 0.0)
        if gained <= 0.0:
            return expected
        trust = min(gained / _TRUSTED_SHARE, 1.0)
        return (1.0 - trust) * expected + trust * spent / gained * (1.0 - self._share)


def _about(seconds: float) -> str:
    if seconds < 10:
        return "less than 10 s"
    if seconds < 90:
        return f"about {10 * round(seconds / 10)} s"
    if seconds < 90 * 60:
        return f"about {round(seconds / 60)} min"
    return f"about {seconds / 3600:.1f} h"
