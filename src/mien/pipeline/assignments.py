"""Values of `--set jawOpen=0.6 smile=0.4 left_eye_y=0.2`: expressions, gaze, preset faces and joint angles."""

import difflib
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mien.errors import UserError
from mien.runtime.named import GAZE_NAMES, is_gaze, parts_of, presets_for, turned_eyes

_MAX_ANGLE = 1.0
"""Largest angle of a joint in either direction, in radians."""
_NUMBER = re.compile(r"-?\d*\.?\d+")


@dataclass(frozen=True)
class Settable:
    """The parts of a face that can be set by name."""

    expressions: tuple[str, ...]
    bounds: Sequence[Sequence[float]]
    """Lowest and highest value of each expression. Equal ones mean that it does nothing."""
    joints: tuple[str, ...]
    """Names of the free joints."""
    face_model: str
    unit: str = "the full expression"
    """Meaning of the value 1 of an expression."""
    presets: Sequence[Sequence[float]] | None = None
    """The bounds for preset faces; None for the same ones."""

    @property
    def angles(self) -> tuple[str, ...]:
        """Names of the joint angles."""
        return angle_names(self.joints)


def angle_names(joints: Sequence[str]) -> tuple[str, ...]:
    """Names of the angles of free joints, in the order of the flattened axis-angle vectors."""
    return tuple(f"{name}_{axis}" for name in joints for axis in "xyz")


def assign(
    assignments: Sequence[str],
    settable: Settable,
    expression: Float[np.ndarray, "*t e"],
    joints: Float[np.ndarray, "*t j 3"],
) -> tuple[Float[np.ndarray, "*t e"], Float[np.ndarray, "*t j 3"]]:
    """Return copies of the expression and of the joints, with what texts NAME=NUMBER set.

    Names of gaze turn the eyes from where they look. A preset face is added to `expression`, so that it starts from the
    person at rest. Of two names that set the same expression, the last one counts.
    """
    set_to, turned, look = expression.copy(), joints.copy(), dict[str, float]()
    angles = turned.reshape(*turned.shape[:-2], -1)
    for name, value in _read(assignments, settable):
        if name in settable.angles:
            angles[..., settable.angles.index(name)] = value
            continue
        for part in parts_of(name, value):
            if is_gaze(part.name, settable.joints):
                look[part.name] = part.value
                continue
            index = settable.expressions.index(part.name)
            lower, upper = (settable.presets or settable.bounds)[index]
            added = (expression[..., index] + part.value).clip(lower, upper)
            set_to[..., index] = added if part.is_added else value
    return set_to, turned_eyes(turned, settable.joints, look) if look else turned


def _read(assignments: Sequence[str], settable: Settable) -> list[tuple[str, float]]:
    values, limits = [], _limits(settable)
    for position, assignment in enumerate(assignments):
        name, equals, text = assignment.partition("=")
        if name not in limits:
            raise UserError(f"--set {assignment}: no expression {name!r}; {_hint(name, settable, limits)}")
        lower, upper, unit = limits[name]
        if not equals:
            apart = "".join(assignments[position + 1 : position + 2])
            number = apart if _NUMBER.fullmatch(apart) else ""
            raise UserError(f"--set {f'{name} {number}'.rstrip()}: write {name}={number or '0.6'}")
        try:
            value = float(text)
        except ValueError:
            raise UserError(f"--set {assignment}: {text!r} is not a number; write --set {name}=0.6") from None
        if lower == upper:
            model = settable.face_model
            raise UserError(f"--set {assignment}: {name} does nothing with the face model {model!r}; leave it out")
        if math.isnan(value) or not lower <= value <= upper:
            raise UserError(f"--set {assignment}: {name} goes from {lower:g} to {upper:g}{unit}")
        values.append((name, value))
    return values


def _limits(settable: Settable) -> dict[str, tuple[float, float, str]]:
    """The lowest and the highest value of each name, and the unit in words."""
    full, gaze = "; 1 is the full expression", "; 1 is 30 degrees aside; up and down, lids stop the eye earlier"
    limits = {face: (0.0, 1.0, full) for face in presets_for(settable.expressions, settable.joints)}
    for name, (lower, upper) in zip(settable.expressions, settable.bounds, strict=True):
        limits[name] = (round(float(lower), 4), round(float(upper), 4), f"; 1 is {settable.unit}")
    limits |= {name: (0.0, 1.0, gaze) for name in GAZE_NAMES if is_gaze(name, settable.joints)}
    return limits | {name: (-_MAX_ANGLE, _MAX_ANGLE, " radians") for name in settable.angles}


def _hint(name: str, settable: Settable, known: Iterable[str]) -> str:
    # Compare in lower case, so that `jawopen` is as near to jawOpen as possible.
    folded = {each.lower(): each for each in known}
    near = [folded[match] for match in difflib.get_close_matches(name.lower(), folded, 3, 0.6)]
    if near:
        return f"did you mean {' or '.join(near)}?"
    faces = presets_for(settable.expressions, settable.joints)
    whole = f"; whole faces: {', '.join(faces)}" if faces else ""
    names, angles = ", ".join(settable.expressions), ", ".join(settable.angles)
    return f"there are: {names}{whole}; and joint angles in radians: {angles}"
