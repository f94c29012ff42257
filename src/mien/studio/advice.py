"""Advice on what to film again: the few things that an avatar has seen too little of in its training pictures."""

from functools import lru_cache
from pathlib import Path

import numpy as np

from mien.errors import UserError
from mien.runtime.baked import PortableAvatar
from mien.runtime.file import read_portable

_MOST = 3
"""Number of things that are asked for at once."""
_SIDE, _UP_OR_DOWN = np.radians(35.0), np.radians(12.0)
"""How far a camera should have seen the head from each side, and from above and below. Fills begin beyond it."""
_FACES = {
    "Smile, and show your teeth": (("mouthSmileLeft", "mouthSmileRight"), 0.4),
    "Say a long A, with your mouth wide open": (("jawOpen",), 0.4),
    "Say O and U, with round lips": (("mouthFunnel", "mouthPucker"), 0.3),
    "Raise your eyebrows": (("browInnerUp", "browOuterUpLeft", "browOuterUpRight"), 0.3),
    "Shut your eyes for a second": (("eyeBlinkLeft", "eyeBlinkRight"), 0.5),
}
"""Each has what to do, which expressions show it, and how strong one of them should be."""


def advice(portable: PortableAvatar) -> list[str]:
    """Return up to three things to film, what lacks most first."""
    filmed, rest = portable.filmed, portable.neutral.expression
    if filmed is None:
        return []
    (right, left), (below, above) = filmed.head_angles
    lacks = {
        # A camera sees the person's right side when the head turns to the left.
        "Turn your head further to the left": 1 + right / _SIDE,
        "Turn your head further to the right": 1 - left / _SIDE,
        "Lift your chin, and look up": 1 + below / _UP_OR_DOWN,
        "Lower your chin, and look down": 1 - above / _UP_OR_DOWN,
    }
    names = portable.expression_names
    for words, (shown_by, enough) in _FACES.items():
        columns = [names.index(name) for name in shown_by if name in names]
        if columns:
            lacks[words] = 1 - max(filmed.highest[index] - rest[index] for index in columns) / enough
    found = sorted((-lack, words) for words, lack in lacks.items() if lack > 0.1)
    return [words for _, words in found[:_MOST]]


def advice_for(path: Path) -> list[str]:
    """The same for a .mien file; nothing if it is missing or damaged."""
    try:
        return list(_remembered(path, path.stat().st_mtime_ns))
    except (OSError, UserError):
        return []


@lru_cache(maxsize=64)
def _remembered(path: Path, changed: int) -> tuple[str, ...]:
    return tuple(advice(read_portable(path)))
