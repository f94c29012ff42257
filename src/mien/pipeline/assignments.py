"""Values of `--set jawOpen=0.6 smile=0.4 left_eye_y=0.2`: expressions, gaze, preset faces and joint angles."""

import difflib
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mien.errors import UserError
from mien.runtime.named import GAZE_NAMES, is_gaze, parts_of, presets_for, turned_eyes

_MAX_ANGLE = 1.0
"""Largest angle of a joint in either direction, in radians."""


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
            lower, upper = settable.bounds[index]
            added = (expression[..., index] + part.value).clip(lower, upper)
            set_to[..., index] = added if part.is_added else value
    return set_to, turned_eyes(turned, settable.joints, look) if look else turned


def _read(assignments: Sequence[str], settable: Settable) -> list[tuple[str, float]]:
    values = []
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
        values.append((name, value))
    return values


def _check_range(name: str, value: float, settable: Settable, assignment: str) -> None:
    """Check the value of a name that the face has."""
    lower, upper, unit = 0.0, 1.0, "the full expression"
    if name in settable.angles:
        if math.isnan(value) or abs(value) > _MAX_ANGLE:
            raise UserError(f"--set {assignment}: {name} goes from -{_MAX_ANGLE:g} to {_MAX_ANGLE:g} radians")
        return
    if is_gaze(name, settable.joints):
        unit = "30 degrees aside; up and down, lids stop the eye earlier"
    elif name in settable.expressions:
        lower, upper = (round(float(bound), 4) for bound in settable.bounds[settable.expressions.index(name)])
        unit = settable.unit
    if lower == upper:
        model = settable.face_model
        raise UserError(f"--set {assignment}: {name} does nothing with the face model {model!r}; leave it out")
    if math.isnan(value) or not lower <= value <= upper:
        raise UserError(f"--set {assignment}: {name} goes from {lower:g} to {upper:g}; 1 is {unit}")


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def _check_name(name: str, settable: Settable, assignment: str) -> None:
    names, angles, joints = settable.expressions, settable.angles, settable.joints
    faces, gazes = presets_for(names, joints), [gaze for gaze in GAZE_NAMES if is_gaze(gaze, joints)]
    if name in (*names, *angles, *faces, *gazes):
        return
    # Compare in lower case, so that `jawopen` is as near to jawOpen as possible.
    folded = {known.lower(): known for known in (*names, *angles, *faces, *gazes)}
    near = [folded[match] for match in difflib.get_close_matches(name.lower(), folded, 3, 0.6)]
    whole = f"; whole faces: {', '.join(faces)}" if faces else ""
    every = f"there are: {', '.join(names)}{whole}; and joint angles in radians: {', '.join(angles)}"
    hint = f"did you mean {' or '.join(near)}?" if near else every
    raise UserError(f"--set {assignment}: no expression {name!r}; {hint}")
