"""Expressions, gaze, preset faces and joints on the command line: `--set jawOpen=0.6 smile=0.4 left_eye_y=0.2`."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from mien.avatar.avatar import Avatar
from mien.errors import UserError
from mien.face.checks import check_face_params
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.machine.progress import say
from mien.pipeline.assignments import Settable, angle_names, assign
from mien.runtime.baked import Filmed
from mien.runtime.filmed import with_filmed_blinks
from mien.runtime.named import is_gaze, parts_of
from mien.training.run import filmed_range, read_face_track


def with_expression(
    face: FaceParams, model: FaceModel, assignments: tuple[str, ...], filmed: Filmed | None = None
) -> FaceParams:
    """`face` with expressions and joint angles set by name at every timestep (`mien.pipeline.assignments.assign`).

    Presets shut the lids no further than `filmed` shows them shut.
    """
    if not assignments:
        return face
    before = (face.expression.detach().cpu().numpy(), face.joints.detach().cpu().numpy())
    expression, joints = assign(assignments, _settable(model, filmed), *before)
    return replace(
        face,
        expression=torch.from_numpy(expression).to(face.expression),
        joints=torch.from_numpy(joints).to(face.joints),
    )


def chosen_face(
    run_dir: Path, avatar: Avatar, motion: FaceParams | None, timestep: int | None, assignments: tuple[str, ...]
) -> FaceParams:
    """The avatar's face in a motion, at a timestep of it or of the training, or at rest, with expressions by name.

    What was never filmed is told.
    """
    model, subject = avatar.face_model, avatar.subject
    if timestep is not None:
        motion = read_face_track(run_dir, model) if motion is None else motion
        if not 0 <= timestep < len(motion):
            raise UserError(f"--timestep {timestep}: {run_dir} has the timesteps 0 to {len(motion) - 1}; give one")
        motion = motion[timestep]
    face = replace(
        subject if motion is None else motion, identity=subject.identity, vertex_offsets=subject.vertex_offsets
    )
    check_face_params(model, face, "--motion", "choose a sequence that was tracked with the avatar's face model")
    if not assignments:
        return face
    filmed = filmed_range(run_dir, avatar)
    face = with_expression(face, model, assignments, filmed)
    tell_of_unfilmed(assignments, face, model, filmed)
    return face


def tell_of_unfilmed(assignments: tuple[str, ...], face: FaceParams, model: FaceModel, filmed: Filmed) -> None:
    """Name the assignments that go beyond what was filmed. `face` is what `with_expression` made of them."""
    names, beyond = (*model.expression_names, *angle_names(model.free_joint_names)), []
    values = torch.cat([face.expression, face.joints.flatten(1)], 1)[0].tolist()
    for name, _, text in (assignment.partition("=") for assignment in assignments):
        for part in parts_of(name, float(text)):
            if is_gaze(part.name, model.free_joint_names):
                continue
            index = names.index(part.name)
            value, shown = (values[index], f"{values[index]:.2f}") if part.is_added else (part.value, text)
            # To the digits that are shown: nobody sees what lies between. Adding 0 makes -0 to 0.
            lowest = round(min(0.0, float(filmed.lowest[index])), 2) + 0.0
            highest = round(max(0.0, float(filmed.highest[index])), 2)
            if not lowest <= round(value, 2) <= highest:
                beyond.append(f"{part.name}={shown} ({lowest:.2f} to {highest:.2f})")
    if beyond:
        say(f"beyond what was filmed, so it may look wrong: {', '.join(beyond)}")


def _settable(model: FaceModel, filmed: Filmed | None) -> Settable:
    unit = "the full expression" if model.expression_sigmas is None else "strong, and 0 is the mean face"
    bounds = model.expression_bounds.tolist()
    shut = with_filmed_blinks(np.array(bounds), model.expression_names, filmed).tolist()
    return Settable(tuple(model.expression_names), bounds, tuple(model.free_joint_names), model.name, unit, shut)
