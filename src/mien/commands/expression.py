"""Expressions and joints on the command line: `--set jawOpen=0.6 mouthSmileLeft=0.4 left_eye_y=0.2`."""

from dataclasses import replace

from mien.commands.assignments import Settable, angle_names, read_assignments
from mien.face import FaceModel, FaceParams
from mien.progress import say
from mien.runtime.baked import Filmed


def with_expression(face: FaceParams, model: FaceModel, assignments: tuple[str, ...]) -> FaceParams:
    """`face` with some coefficients or joint angles set by name at every timestep. Without assignments, `face` itself.

    Raises:
        UserError: an assignment is not NAME=NUMBER, the face model has no such expression or joint, or the number is
            out of its range.
    """
    expression, joints = face.expression.clone(), face.joints.flatten(1).clone()
    angles = angle_names(model.free_joint_names)
    for name, value in read_assignments(assignments, _settable(model)).items():
        if name in angles:
            joints[:, angles.index(name)] = value
        else:
            expression[:, model.expression_names.index(name)] = value
    return replace(face, expression=expression, joints=joints.reshape(face.joints.shape))


def tell_of_unfilmed(assignments: tuple[str, ...], model: FaceModel, filmed: Filmed) -> None:
    """Name the assignments, which `with_expression` accepted, that go beyond what was filmed."""
    names, beyond = (*model.expression_names, *angle_names(model.free_joint_names)), []
    for name, _, text in (assignment.partition("=") for assignment in assignments):
        index = names.index(name)
        lowest, highest = min(0.0, float(filmed.lowest[index])), max(0.0, float(filmed.highest[index]))
        if not lowest <= float(text) <= highest:
            beyond.append(f"{name}={text} ({lowest:.2f} to {highest:.2f})")
    if beyond:
        say(f"beyond what was filmed, so it may look wrong: {', '.join(beyond)}")


def _settable(model: FaceModel) -> Settable:
    unit = "the full expression" if model.expression_sigmas is None else "strong, and 0 is the mean face"
    bounds, angles = model.expression_bounds.tolist(), angle_names(model.free_joint_names)
    return Settable(model.expression_names, bounds, angles, model.name, unit)
