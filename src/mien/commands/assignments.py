"""What `--set jawOpen=0.6 left_eye_y=0.2` asks for: numbers by the names of expressions and joint angles."""

import difflib
import math
from collections.abc import Sequence
from dataclasses import dataclass

from mien.errors import UserError

_MAX_ANGLE = 1.0
"""Largest angle of a joint in either direction, in radians."""


@dataclass(frozen=True)
class Settable:
    """What of a face can be set by name."""

    expressions: tuple[str, ...]
    bounds: Sequence[Sequence[float]]
    """Lowest and highest value of each expression. Equal ones mean that it does nothing."""
    angles: tuple[str, ...]
    """Names of the joint angles."""
    face_model: str
    unit: str = "the full expression"
    """What 1 means."""


def angle_names(joints: Sequence[str]) -> tuple[str, ...]:
    """Names of the angles of free joints, in the order of the flattened axis-angle vectors."""
    return tuple(f"{name}_{axis}" for name in joints for axis in "xyz")


def read_assignments(assignments: Sequence[str], settable: Settable) -> dict[str, float]:
    """The number of each name that is set, as texts NAME=NUMBER give them.

    Raises:
        UserError: an assignment is not NAME=NUMBER, there is no such expression or joint angle, or the number is out of
            its range.
    """
    values = {}
    for position, assignment in enumerate(assignments):
        name, equals, text = assignment.partition("=")
        _check_name(name, settable, assignment)
        if not equals:
            apart = "".join(assignments[position + 1 : position + 2])
            number = apart if _is_number(apart) else ""
            raise UserError(f"--set {f'{name} {number}'.rstrip()}: write {name}={number or '0.6'}")
        try:
            value = float(text)
        except ValueError:
            raise UserError(f"--set {assignment}: {text!r} is not a number; write --set {name}=0.6") from None
        _check_range(name, value, settable, assignment)
        values[name] = value
    return values


def _check_range(name: str, value: float, settable: Settable, assignment: str) -> None:
    if name in settable.angles:
        if math.isnan(value) or abs(value) > _MAX_ANGLE:
            raise UserError(f"--set {assignment}: {name} goes from -{_MAX_ANGLE:g} to {_MAX_ANGLE:g} radians")
        return
    lower, upper = (round(float(bound), 4) for bound in settable.bounds[settable.expressions.index(name)])
    if lower == upper:
        model = settable.face_model
        raise UserError(f"--set {assignment}: {name} does nothing with the face model {model!r}; leave it out")
    if math.isnan(value) or not lower <= value <= upper:
        raise UserError(f"--set {assignment}: {name} goes from {lower:g} to {upper:g}; 1 is {settable.unit}")


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def _check_name(name: str, settable: Settable, assignment: str) -> None:
    names, angles = settable.expressions, settable.angles
    if name in names or name in angles:
        return
    # Compare in lower case, so that `jawopen` is as near to jawOpen as possible.
    folded = {known.lower(): known for known in (*names, *angles)}
    near = [folded[match] for match in difflib.get_close_matches(name.lower(), folded, 3, 0.6)]
    every = f"there are: {', '.join(names)}; and joint angles in radians: {', '.join(angles)}"
    hint = f"did you mean {' or '.join(near)}?" if near else every
    raise UserError(f"--set {assignment}: no expression {name!r}; {hint}")
