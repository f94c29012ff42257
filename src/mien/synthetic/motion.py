"""Generate a head's motion from a seed, with natural timing: pose, speech, smiles, brows, blinks and gaze."""

import numpy as np
import torch
from jaxtyping import Float

from mien import exact
from mien.face import FaceModel, FaceParams
from mien.runtime.rotation import axis_angle_from_matrix, matrix_from_axis_angle
from mien.synthetic.expressions import Tracks, expression_tracks
from mien.synthetic.noise import smoothstep
from mien.synthetic.posing import rest_joints
from mien.synthetic.recipe import SyntheticRecipe
from mien.synthetic.script import Span, moving_clock, share_of, spans_of, wide_turns

_MAX_GAZE = 0.42  # radians; beyond this the head turns


def head_motion(model: FaceModel, identity: torch.Tensor, recipe: SyntheticRecipe, seed: int) -> FaceParams:
    """Return face parameters of every timestep. The camera is at the world's origin and looks along -z.

    The head turns about the base of the neck, which sways. The neck joint, if the model has one, bends so that the base
    of the neck stays with the shoulders. The shoulders follow the head's turns by `SHOULDERS_FOLLOW`.
    """
    random = np.random.default_rng([seed, 1])
    times, spans = np.arange(recipe.timesteps) / recipe.fps, spans_of(recipe)
    clock = moving_clock(times, spans)
    pitch_yaw_roll = np.stack(
        [_drift(random, clock, amplitude) for amplitude in np.radians(np.array(recipe.rotation)[[1, 0, 2]])], axis=-1
    )
    sway = np.stack([_drift(random, clock, amplitude) for amplitude in recipe.translation], axis=-1)
    pitch_yaw_roll *= 1 - share_of("turns", times, spans)[:, None]
    turned = wide_turns(times, spans, *np.radians(recipe.turns)[::-1])
    pitch_yaw_roll[:, :2] += np.stack(turned, axis=-1)
    gaze = _gaze(random, times, spans) if recipe.blinks else np.zeros((len(times), 2))
    gaze -= np.clip(0.85 * pitch_yaw_roll[:, :2], -_MAX_GAZE, _MAX_GAZE)  # the eyes keep looking into the camera
    tracks = expression_tracks(random, times, recipe.expression, spans, blinks=recipe.blinks)
    rotations = euler_matrices(pitch_yaw_roll)
    pivot = neck_pivot(model, identity)
    anchor = np.array([0.0, 0.0, -recipe.distance]) + pivot + sway
    head_rotation = axis_angle_from_matrix(rotations)
    return FaceParams(
        identity=identity,
        expression=_expression(model, tracks, len(times)),
        joints=_joints(model, rotations, head_rotation, gaze),
        head_rotation=torch.from_numpy(head_rotation).float(),
        head_translation=torch.from_numpy(anchor - exact.dot(rotations, pivot)).float(),
    )


SHOULDERS_FOLLOW = 0.25
"""Share of the head's rotation that the shoulders follow."""


def shoulder_rotation(head_rotation: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3 3"]:
    """Return the shoulders' rotations, given the head's as axis-angle."""
    return matrix_from_axis_angle(SHOULDERS_FOLLOW * head_rotation)


def neck_pivot(model: FaceModel, identity: torch.Tensor) -> Float[np.ndarray, " 3"]:
    """Return the point at the neck joint, in the head frame, that stays in place when the head nods and turns."""
    if "neck" in model.joint_names:
        return rest_joints(model, identity)[model.joint_names.index("neck")]
    return np.array([0.0, -0.10, -0.02])


def euler_matrices(pitch_yaw_roll: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3 3"]:
    """Return rotations by roll, then pitch, then yaw, about the head's +z, +x and +y axes.

    Angles are in radians. Positive pitch looks down.
    """
    axes = np.eye(3)
    pitch, yaw, roll = (matrix_from_axis_angle(pitch_yaw_roll[..., i, None] * axes[i]) for i in range(3))
    return exact.product(exact.product(yaw, pitch), roll)


def _drift(random: np.random.Generator, times: np.ndarray, amplitude: float) -> np.ndarray:
    """Return slow, aimless motion whose maximum is the amplitude."""
    total = np.zeros_like(times)
    for frequency, strength in ((0.11, 1.0), (0.19, 0.7), (0.33, 0.35), (0.62, 0.12)):
        frequency *= random.uniform(0.85, 1.15)
        total += strength * np.sin(2 * np.pi * (frequency * times + random.uniform()))
    return amplitude * total / max(np.abs(total).max(), 1e-9)


def _gaze(random: np.random.Generator, times: np.ndarray, spans: tuple[Span, ...]) -> np.ndarray:
    """Return the gaze beside the camera as (down, left) angles in radians: fixations with jumps of 40 ms between."""
    gaze = np.zeros((len(times), 2))
    clock, current = 0.0, np.zeros(2)
    while clock < times[-1]:
        clock += random.uniform(0.5, 1.6)
        target = random.normal(0, [0.05, 0.11]) if random.uniform() < 0.6 else np.zeros(2)
        if any(span.kind == "still" and span.start <= clock < span.end for span in spans):
            continue
        gaze += smoothstep(clock, clock + 0.04, times)[:, None] * (target - current)
        current = target
    return gaze


def _expression(model: FaceModel, tracks: Tracks, timesteps: int) -> Float[torch.Tensor, "t e"]:
    """Convert tracks to rows of the model's expression. `eyeBlink` drives `eyeBlinkLeft` and `eyeBlinkRight`."""
    expression = np.zeros((timesteps, len(model.expression_names)))
    closed = tracks.get("eyeBlink", np.zeros(timesteps))
    for column, name in enumerate(model.expression_names):
        side = name.removesuffix("Left").removesuffix("Right")
        if name not in tracks and side not in tracks:
            continue
        values = tracks.get(name, 0.0) + (tracks.get(side, 0.0) if side != name else 0.0)
        if side in ("eyeSquint", "eyeWide"):
            values = values * (1 - closed)  # a closed eye cannot close further
        expression[:, column] = np.clip(values, *model.expression_bounds[column].tolist())
    return torch.from_numpy(expression).float()


def _joints(
    model: FaceModel,
    rotations: Float[np.ndarray, "t 3 3"],
    head_rotation: Float[np.ndarray, "t 3"],
    gaze: Float[np.ndarray, "t 2"],
) -> Float[torch.Tensor, "t j 3"]:
    joints = np.zeros((len(gaze), len(model.free_joint_names), 3))
    shoulders = shoulder_rotation(head_rotation)
    for column, name in enumerate(model.free_joint_names):
        if "eye" in name:
            joints[:, column, :2] = gaze
        elif name == "neck":
            joints[:, column] = axis_angle_from_matrix(exact.product(np.swapaxes(rotations, 1, 2), shoulders))
    return torch.from_numpy(joints).float()
