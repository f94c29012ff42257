"""Expressions on the command line: `--set jawOpen=0.6 mouthSmileLeft=0.4`."""

import difflib
import math
from dataclasses import replace

from mien.errors import UserError
from mien.face import FaceModel, FaceParams


def with_expression(face: FaceParams, model: FaceModel, assignments: tuple[str, ...]) -> FaceParams:
    """`face` with some expression coefficients set by name, at every timestep; none set: `face` itself.

    Raises:
        UserError: an assignment is not NAME=NUMBER, the face model has no expression of that name, or the number is
            out of that expression's range.
    """
    expression = face.expression.clone()
    for position, assignment in enumerate(assignments):
        name, equals, text = assignment.partition("=")
        index = _index_of(name, model, assignment)
        if not equals:
            apart = "".join(assignments[position + 1 : position + 2])
            number = apart if _is_number(apart) else ""
            raise UserError(f"--set {f'{name} {number}'.rstrip()}: write {name}={number or '0.6'}")
        try:
            value = float(text)
        except ValueError:
            raise UserError(f"--set {assignment}: {text!r} is no number; write for example --set {name}=0.6") from None
        lower, upper = (round(float(bound), 4) for bound in model.expression_bounds[index])
        if lower == upper:
            raise UserError(f"--set {assignment}: {name} does nothing with the face model {model.name!r}; leave it out")
        if math.isnan(value) or not lower <= value <= upper:
            raise UserError(f"--set {assignment}: {name} goes from {lower:g} to {upper:g}; 1 is the full expression")
        expression[:, index] = value
    return replace(face, expression=expression)


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def _index_of(name: str, model: FaceModel, assignment: str) -> int:
    names = model.expression_names
    if name in names:
        return names.index(name)
    # Letter by letter in small letters: `jawopen` is as near to jawOpen as can be.
    folded = {known.lower(): known for known in names}
    near = [folded[match] for match in difflib.get_close_matches(name.lower(), folded, 3, 0.6)]
    hint = f"did you mean {' or '.join(near)}?" if near else f"there are: {', '.join(names)}"
    raise UserError(f"--set {assignment}: no expression {name!r}; {hint}")
