"""Expressions on the command line: `--set jawOpen=0.6 mouthSmileLeft=0.4`."""

from dataclasses import replace

from mien.errors import UserError
from mien.face import FaceModel, FaceParams


def with_expression(face: FaceParams, model: FaceModel, assignments: tuple[str, ...]) -> FaceParams:
    """`face` with some expression coefficients set by name, at every timestep; none set: `face` itself.

    Raises:
        UserError: an assignment is not NAME=NUMBER, or the face model has no expression of that name.
    """
    expression = face.expression.clone()
    for assignment in assignments:
        name, _, text = assignment.partition("=")
        if name not in model.expression_names:
            raise UserError(
                f"--set {assignment}: no expression {name!r}; there are: {', '.join(model.expression_names)}"
            )
        try:
            value = float(text)
        except ValueError:
            raise UserError(f"--set {assignment}: {text!r} is no number; write for example --set {name}=0.6") from None
        if not abs(value) <= _LARGEST:
            raise UserError(
                f"--set {assignment}: {text} is outside -{_LARGEST:g}..{_LARGEST:g}; 1 is the full expression"
            )
        expression[:, model.expression_names.index(name)] = value
    return replace(face, expression=expression)


_LARGEST = 3.0
"""Three times the full expression: beyond, no avatar shows anything but garbage."""
