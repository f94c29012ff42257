"""Expressions and joints on the command line: `--set jawOpen=0.6 mouthSmileLeft=0.4 left_eye_y=0.2`."""

import difflib
import math
from dataclasses import replace

from mien.errors import UserError
from mien.face import FaceModel, FaceParams
from mien.progress import say
from mien.runtime.baked import Filmed

_MAX_ANGLE = 1.0
"""Largest angle of a joint in either direction, in radians."""


def with_expression(face: FaceParams, model: FaceModel, assignments: tuple[str, ...]) -> FaceParams:
    """`face` with some coefficients or joint angles set by name at every timestep. Without assignments, `face` itself.

    Raises:
        UserError: an assignment is not NAME=NUMBER, the face model has no such expression or joint, or the number is
            out of its range.
    """
    expression, joints = face.expression.clone(), face.joints.flatten(1).clone()
    angles = _angle_names(model)
    for position, assignment in enumerate(assignments):
        name, equals, text = assignment.partition("=")
        _check_name(name, model, assignment)
        if not equals:
            apart = "".join(assignments[position + 1 : position + 2])
            number = apart if _is_number(apart) else ""
            raise UserError(f"--set {f'{name} {number}'.rstrip()}: write {name}={number or '0.6'}")
        try:
            value = float(text)
        except ValueError:
            raise UserError(f"--set {assignment}: {text!r} is not a number; write --set {name}=0.6") from None
        if name in angles:
            if math.isnan(value) or abs(value) > _MAX_ANGLE:
                raise UserError(f"--set {assignment}: {name} goes from -{_MAX_ANGLE:g} to {_MAX_ANGLE:g} radians")
            joints[:, angles.index(name)] = value
            continue
        index = model.expression_names.index(name)
        lower, upper = (round(float(bound), 4) for bound in model.expression_bounds[index])
        if lower == upper:
            raise UserError(f"--set {assignment}: {name} does nothing with the face model {model.name!r}; leave it out")
        if math.isnan(value) or not lower <= value <= upper:
            unit = "the full expression" if model.expression_sigmas is None else "strong, and 0 is the mean face"
            raise UserError(f"--set {assignment}: {name} goes from {lower:g} to {upper:g}; 1 is {unit}")
        expression[:, index] = value
    return replace(face, expression=expression, joints=joints.reshape(face.joints.shape))


def tell_of_unfilmed(assignments: tuple[str, ...], model: FaceModel, filmed: Filmed) -> None:
    """Name the assignments, which `with_expression` accepted, that go beyond what was filmed."""
    names, beyond = (*model.expression_names, *_angle_names(model)), []
    for name, _, text in (assignment.partition("=") for assignment in assignments):
        index = names.index(name)
        lowest, highest = min(0.0, float(filmed.lowest[index])), max(0.0, float(filmed.highest[index]))
        if not lowest <= float(text) <= highest:
            beyond.append(f"{name}={text} ({lowest:.2f} to {highest:.2f})")
    if beyond:
        say(f"beyond what was filmed, so it may look wrong: {', '.join(beyond)}")


def _angle_names(model: FaceModel) -> tuple[str, ...]:
    """Names of the joint angles, in the order of the flattened `FaceParams.joints`."""
    return tuple(f"{name}_{axis}" for name in model.free_joint_names for axis in "xyz")


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def _check_name(name: str, model: FaceModel, assignment: str) -> None:
    names, angles = model.expression_names, _angle_names(model)
    if name in names or name in angles:
        return
    # Compare in lower case, so that `jawopen` is as near to jawOpen as possible.
    folded = {known.lower(): known for known in (*names, *angles)}
    near = [folded[match] for match in difflib.get_close_matches(name.lower(), folded, 3, 0.6)]
    every = f"there are: {', '.join(names)}; and joint angles in radians: {', '.join(angles)}"
    hint = f"did you mean {' or '.join(near)}?" if near else every
    raise UserError(f"--set {assignment}: no expression {name!r}; {hint}")
