"""Expressions, gaze, preset faces and joints on the command line: `--set jawOpen=0.6 smile=0.4 left_eye_y=0.2`."""

import difflib
import math
from dataclasses import replace

import torch

from mien.errors import UserError
from mien.face import FaceModel, FaceParams
from mien.progress import say
from mien.runtime.baked import Filmed
from mien.runtime.named import GAZE_NAMES, is_gaze, parts_of, presets_for, turned_eyes

_MAX_ANGLE = 1.0
"""Largest angle of a joint in either direction, in radians."""


def with_expression(face: FaceParams, model: FaceModel, assignments: tuple[str, ...]) -> FaceParams:
    """`face` with some coefficients or joint angles set by name at every timestep. Without assignments, `face` itself.

    Names of gaze turn the eyes from where they look. A preset face is added to `face`, so that it starts from the
    person at rest. Of two names that set the same expression, the last one counts.

    Raises:
        UserError: an assignment is not NAME=NUMBER, the face model has no such expression or joint, or the number is
            out of its range.
    """
    expression, joints = face.expression.clone(), face.joints.flatten(1).clone()
    angles, look = _angle_names(model), dict[str, float]()
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
        _check_range(name, value, model, assignment)
        if name in angles:
            joints[:, angles.index(name)] = value
            continue
        for part in parts_of(name, value):
            if is_gaze(part.name, model.free_joint_names):
                look[part.name] = part.value
                continue
            index = model.expression_names.index(part.name)
            added = face.expression[:, index] + part.value
            expression[:, index] = added.clamp(*model.expression_bounds[index].tolist()) if part.is_added else value
    turned = joints.reshape(face.joints.shape)
    if look:
        eyes = turned_eyes(turned.detach().cpu().numpy(), model.free_joint_names, look)
        turned = torch.from_numpy(eyes).to(turned)
    return replace(face, expression=expression, joints=turned)


def _check_range(name: str, value: float, model: FaceModel, assignment: str) -> None:
    """Check the value of a name that the face model has.

    Raises:
        UserError: it is out of range, or the name does nothing.
    """
    lower, upper, unit = 0.0, 1.0, "the full expression"
    if name in _angle_names(model):
        if math.isnan(value) or abs(value) > _MAX_ANGLE:
            raise UserError(f"--set {assignment}: {name} goes from -{_MAX_ANGLE:g} to {_MAX_ANGLE:g} radians")
        return
    if is_gaze(name, model.free_joint_names):
        unit = "30 degrees aside; up and down, lids stop the eye earlier"
    elif name in model.expression_names:
        lower, upper = (round(float(bound), 4) for bound in model.expression_bounds[model.expression_names.index(name)])
        if model.expression_sigmas is not None:
            unit = "strong, and 0 is the mean face"
    if lower == upper:
        raise UserError(f"--set {assignment}: {name} does nothing with the face model {model.name!r}; leave it out")
    if math.isnan(value) or not lower <= value <= upper:
        raise UserError(f"--set {assignment}: {name} goes from {lower:g} to {upper:g}; 1 is {unit}")


def tell_of_unfilmed(assignments: tuple[str, ...], face: FaceParams, model: FaceModel, filmed: Filmed) -> None:
    """Name the assignments that go beyond what was filmed. `face` is what `with_expression` made of them."""
    names, beyond = (*model.expression_names, *_angle_names(model)), []
    values = torch.cat([face.expression, face.joints.flatten(1)], 1)[0].tolist()
    for name, _, text in (assignment.partition("=") for assignment in assignments):
        for part in parts_of(name, float(text)):
            if is_gaze(part.name, model.free_joint_names):
                continue
            index = names.index(part.name)
            value, shown = (values[index], f"{values[index]:.2f}") if part.is_added else (part.value, text)
            lowest, highest = min(0.0, float(filmed.lowest[index])), max(0.0, float(filmed.highest[index]))
            if not lowest <= value <= highest:
                beyond.append(f"{part.name}={shown} ({lowest:.2f} to {highest:.2f})")
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
    names, angles, joints = model.expression_names, _angle_names(model), model.free_joint_names
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
