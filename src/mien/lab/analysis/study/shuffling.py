"""The order in which a participant sees clips and methods. page.html has the same function, and a test compares both.

The numbers come from sfc32 (Doty-Humphrey, PractRand: 128 bits of state, of which 32 count), which is short in both
languages. Its state is a hash (FNV-1a) of the study, the participant and the clip, so that an answer file alone tells
the order again.
"""

from collections.abc import Iterator, Sequence

_MASK = 0xFFFFFFFF
_FNV_START, _FNV_PRIME = 0x811C9DC5, 0x01000193
_DISCARDED = 15
"""Number of first outputs that are dropped, until all bits of the state are mixed."""


def shuffled(names: Sequence[str], study: str, participant: str, what: str) -> list[str]:
    """The names in this participant's order (Fisher-Yates). It does not depend on the order in which they are given.

    Args:
        names: Opaque names of clips, or of a clip's tiles. All differ.
        study: The study's name.
        participant: The participant's number, as 8 hex digits.
        what: The clip's name, or `clips` for the order of the clips.
    """
    order, numbers = sorted(names), _numbers(f"{study}/{participant}/{what}")
    for last in range(len(order) - 1, 0, -1):
        other = next(numbers) * (last + 1) >> 32
        order[last], order[other] = order[other], order[last]
    return order


def _numbers(text: str) -> Iterator[int]:
    """Random whole numbers below 2^32."""
    a, b, c = (_hash(f"{salt}{text}") for salt in "012")
    count = 1
    for index in range(1 << 62):
        value = (a + b + count) & _MASK
        count = (count + 1) & _MASK
        a = b ^ (b >> 9)
        b = (c + (c << 3)) & _MASK
        c = (((c << 21) | (c >> 11)) + value) & _MASK
        if index >= _DISCARDED:
            yield value


def _hash(text: str) -> int:
    value = _FNV_START
    for byte in text.encode("ascii"):
        value = ((value ^ byte) * _FNV_PRIME) & _MASK
    return value
