"""Choose values at edges: numbers and texts that break readers."""

import math
from random import Random
from typing import Any

INTEGERS = (
    0, 1, -1, 2, 7, 255, 256, 65535, 65536, 2**24 + 1, 4 * 10**8, 2**31 - 1, 2**31, -(2**31), 2**32 - 1, 2**32,
    2**53 + 1,
    2**63 - 1, 2**63, -(2**63), 2**64 - 1, 2**64, 10**400, -(10**400),
)  # fmt: skip
FLOATS = (math.nan, math.inf, -math.inf, 3e38, -3e38, 3.5e38, 1e308, 1e-320, -0.0, 0.5, 1e16, 1e-9, 1e30, -1e30)
CANARY, PORT = "@CANARY@", "@PORT@"
"""Placeholders for the folder that nothing may be written into, and for the port that nothing may connect to."""
DEEP = "@DEEP"
"""Placeholder for nested brackets; the digits after it give the depth."""
SCRIPT = "<script>mien_fuzz(1)</script>"
"""Text that must be escaped in every report."""
TEXTS = (
    "", " ", "text", "0", "nan", "null", "x" * 300, "x" * 100_000, "a\nb", "\x1b]0;own\x07\x1b[31mred", "a\x00b",
    "\u202eabc",
    "\ud800", "\x9b31m", "..", ".", "/", "../../x", "../" * 12 + "etc/passwd", f"{CANARY}/victim.json",
    f"../../../..{CANARY}/victim",
    "C:\\x", "con", "-", "--help", "a:b", f"http://127.0.0.1:{PORT}/x", "%s%n", "{0}", SCRIPT, "größer", "\U0001f600",
    "é" * 200,
)  # fmt: skip
_DEPTHS = (2, 100, 500, 990, 1000, 5000, 100_000)


def edge_integer(dice: Random) -> int:
    """Return a whole number at an edge, or beside one."""
    return dice.choice(INTEGERS) + dice.choice((0, 0, 0, 1, -1))


def edge_number(dice: Random) -> int | float:
    """Return a number at an edge."""
    return edge_integer(dice) if dice.random() < 0.5 else dice.choice(FLOATS)


def edge_value(dice: Random) -> Any:
    """Return a json value at an edge."""
    kind = dice.randrange(8)
    if kind < 3:
        return edge_number(dice)
    if kind < 5:
        return dice.choice(TEXTS)
    if kind == 5:
        return f"{DEEP}{dice.choice(_DEPTHS)}"
    return dice.choice(
        (None, True, False, [], {}, [[]], [None], {"": 0}, [0] * 1000, [[0, 0], [0]], {"tensor": "x"}, {"kind": "x"})
    )


def packed_integer(dice: Random, size: int, order: str = "little") -> bytes:
    """Return an edge as an unsigned field of this many bytes."""
    value = edge_integer(dice) if dice.random() < 0.8 else dice.getrandbits(8 * size)
    return (value % (1 << 8 * size)).to_bytes(size, "little" if order == "little" else "big")


def put(data: bytes, at: int, field: bytes) -> bytes:
    """Return `data` with some bytes replaced."""
    return data[:at] + field + data[at + len(field) :]
