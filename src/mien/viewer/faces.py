"""Expressions for people: groups with readable names, a search, and random faces."""

import re
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32

GROUPS = (
    ("Jaw", re.compile(r"jaw|tongue")),
    ("Mouth", re.compile(r"mouth")),
    ("Eyes", re.compile(r"eye")),
    ("Brows", re.compile(r"brow")),
    ("Cheeks and nose", re.compile(r"cheek|nose")),
)
"""Titles of groups, and how the names of their expressions begin. Other expressions are in the group `OTHER`."""
OTHER = "Other"
_SIDE = re.compile(r"(Left|Right)$")
_AWAY = re.compile(r"(jaw|mouth)(Left|Right)$")
"""Moves to one side or to the other, of which both together are none."""
_CLOSED = re.compile(r"eyeBlink")
"""Moves that random faces leave out: with closed eyes, a face looks asleep."""


def readable(name: str) -> str:
    """The name of an expression or joint for people: `jawOpen` is "jaw open"."""
    apart = re.sub(r"([a-z])([A-Z])", lambda match: f"{match[1]} {match[2].lower()}", name.replace("_", " "))
    return apart.strip()


def group_of(name: str) -> str:
    """The title of an expression's group."""
    return next((title for title, pattern in GROUPS if pattern.match(name)), OTHER)


def grouped(names: Sequence[str], bounds: Float32[np.ndarray, "e 2"]) -> dict[str, list[str]]:
    """The expressions that have an effect (`bounds` differ), by the title of their group, in the order of `GROUPS`."""
    found: dict[str, list[str]] = {title: [] for title in (*(title for title, _ in GROUPS), OTHER)}
    for name, (low, high) in zip(names, bounds, strict=True):
        if low < high:
            found[group_of(name)].append(name)
    return {title: members for title, members in found.items() if members}


def matches(text: str, name: str) -> bool:
    """Whether every word of a search is in an expression's name, readable name or group. No word matches everything."""
    where = f"{name} {readable(name)} {group_of(name)}".lower()
    return all(word in where for word in text.lower().split())


def random_expression(
    names: Sequence[str], rest: Float32[np.ndarray, " e"], bounds: Float32[np.ndarray, "e 2"],
    random: np.random.Generator,
) -> Float32[np.ndarray, " e"]:  # fmt: skip
    """The coefficients of a random face: a few expressions beyond the person at rest, the same on both sides.

    Jaw and mouth go to one side only, and eyes stay open.
    """
    kinds: dict[str, list[int]] = {}
    for index, name in enumerate(names):
        if bounds[index, 0] < bounds[index, 1] and not _CLOSED.match(name):
            kinds.setdefault(_SIDE.sub("", name), []).append(index)
    expression = rest.copy()
    chosen = random.permutation(len(kinds))[:6]
    members = list(kinds.values())
    for kind in chosen:
        share = random.uniform(0, 0.7)
        both: list[int] = members[int(kind)]
        for index in both if len(both) < 2 or not _AWAY.fullmatch(names[both[0]]) else random.permutation(both)[:1]:
            # Expressions of FLAME go in both directions, those of ARKit from 0 to 1.
            low, high = bounds[index]
            towards = low if low < 0 and random.random() < 0.5 else high
            expression[index] += share * towards
    return np.clip(expression, bounds[:, 0], bounds[:, 1]).astype(np.float32)
