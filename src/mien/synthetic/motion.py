"""Motion of a head: pose, speech, smiles, brows, blinks and gaze, from a seed, with natural timing."""

from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import Float

from mien.face import FaceModel, FaceParams
from mien.rotation import axis_angle_from_matrix, matrix_from_axis_angle
from mien.synthetic.noise import smoothstep
from mien.synthetic.recipe import SyntheticRecipe

Tracks = dict[str, np.ndarray]
"""Coefficients over time by ARKit's names."""

_VISEMES: dict[str, Mapping[str, float]] = {
    "rest": {},
    "a": {"jawOpen": 0.4, "mouthLowerDown": 0.3, "mouthUpperUp": 0.3},
    "e": {"jawOpen": 0.2, "mouthStretch": 0.35, "mouthSmile": 0.15, "mouthLowerDown": 0.3, "mouthUpperUp": 0.3},
    "i": {"jawOpen": 0.1, "mouthSmile": 0.3, "mouthStretch": 0.3, "mouthLowerDown": 0.3, "mouthUpperUp": 0.35},
    "o": {"jawOpen": 0.3, "mouthFunnel": 0.5},
    "u": {"jawOpen": 0.12, "mouthPucker": 0.55, "mouthFunnel": 0.2},
    "m": {"mouthClose": 0.03, "mouthPress": 0.35, "mouthRollLower": 0.15, "mouthRollUpper": 0.15},
    "f": {"jawOpen": 0.06, "mouthRollLower": 0.25, "mouthUpperUp": 0.2},
    "s": {"jawOpen": 0.06, "mouthStretch": 0.2, "mouthLowerDown": 0.25, "mouthUpperUp": 0.1},
}
_GESTURES: dict[str, Mapping[str, float]] = {
    "smile": {
        "mouthSmile": 0.7, "cheekSquint": 0.45, "eyeSquint": 0.3, "mouthUpperUp": 0.3, "mouthLowerDown": 0.1,
        "mouthDimple": 0.2,
    },
    "raise": {"browInnerUp": 0.7, "browOuterUp": 0.7, "eyeWide": 0.3},
    "frown": {"browDown": 0.7, "eyeSquint": 0.25, "mouthFrown": 0.2},
    "worry": {"browInnerUp": 0.75, "mouthFrown": 0.35},
}  # fmt: skip
_MAX_GAZE = 0.42  # radians; further, the head turns


def head_motion(model: FaceModel, identity: torch.Tensor, recipe: SyntheticRecipe, seed: int) -> FaceParams:
    """Face parameters of every timestep; the camera stands at the world's origin and looks along -z.

    The head turns about the neck's base, which sways; the neck joint, where the model has one, bends so that the
    base of the neck stays with the shoulders, which follow the head's turns by `SHOULDERS_FOLLOW`.
    """
    random = np.random.default_rng([seed, 1])
    times = np.arange(recipe.timesteps) / recipe.fps
    pitch_yaw_roll = np.stack(
        [_drift(random, times, amplitude) for amplitude in np.radians(np.array(recipe.rotation)[[1, 0, 2]])], axis=-1
    )
    sway = np.stack([_drift(random, times, amplitude) for amplitude in recipe.translation], axis=-1)
    gaze = _gaze(random, times, recipe)
    gaze -= np.clip(0.85 * pitch_yaw_roll[:, :2], -_MAX_GAZE, _MAX_GAZE)  # the eyes keep looking into the camera
    tracks = _expression_tracks(random, times, recipe)
    rotations = euler_matrices(torch.from_numpy(pitch_yaw_roll).float())
    pivot = neck_pivot(model, identity)
    anchor = torch.tensor([0.0, 0.0, -recipe.distance]) + pivot + torch.from_numpy(sway).float()
    return FaceParams(
        identity=identity,
        expression=_expression(model, tracks),
        joints=_joints(model, rotations, torch.from_numpy(gaze).float()),
        head_rotation=axis_angle_from_matrix(rotations),
        head_translation=anchor - rotations @ pivot,
    )


SHOULDERS_FOLLOW = 0.25
"""The share of the head's rotation that the shoulders make too."""


def shoulder_rotation(head_rotation: Float[torch.Tensor, "*b 3"]) -> Float[torch.Tensor, "*b 3 3"]:
    """Rotations of the shoulders, from the head's as axis-angle."""
    return matrix_from_axis_angle(SHOULDERS_FOLLOW * head_rotation)


def neck_pivot(model: FaceModel, identity: torch.Tensor) -> Float[torch.Tensor, " 3"]:
    """The point of the head frame, at the neck joint, that nods and turns leave in place."""
    rest = model.joint_template + torch.einsum("i,ikc->kc", identity, model.joint_identity_basis)
    if "neck" in model.joint_names:
        return rest[model.joint_names.index("neck")]
    return torch.tensor([0.0, -0.10, -0.02])


def euler_matrices(pitch_yaw_roll: Float[torch.Tensor, "*b 3"]) -> Float[torch.Tensor, "*b 3 3"]:
    """Roll, then pitch, then yaw, about the head's +z, +x and +y axes, radians; positive pitch looks down."""
    axes = torch.eye(3)
    pitch, yaw, roll = (matrix_from_axis_angle(pitch_yaw_roll[..., i, None] * axes[i]) for i in range(3))
    return yaw @ pitch @ roll


def _drift(random: np.random.Generator, times: np.ndarray, amplitude: float) -> np.ndarray:
    """Slow aimless motion that just reaches the amplitude."""
    total = np.zeros_like(times)
    for frequency, strength in ((0.11, 1.0), (0.19, 0.7), (0.33, 0.35), (0.62, 0.12)):
        frequency *= random.uniform(0.85, 1.15)
        total += strength * np.sin(2 * np.pi * (frequency * times + random.uniform()))
    return amplitude * total / max(np.abs(total).max(), 1e-9)


def _expression_tracks(random: np.random.Generator, times: np.ndarray, recipe: SyntheticRecipe) -> Tracks:
    tracks: Tracks = {}
    _add_speech(random, times, recipe.expression, tracks)
    _add_gestures(random, times, recipe.expression, tracks)
    if recipe.blinks:
        _add_blinks(random, times, tracks)
    return tracks


def _add(tracks: Tracks, shape: Mapping[str, float], weight: np.ndarray) -> None:
    for name, value in shape.items():
        tracks[name] = tracks.get(name, 0) + value * weight


def _add_speech(random: np.random.Generator, times: np.ndarray, scale: float, tracks: Tracks) -> None:
    """Phrases of one to two seconds: visemes every 0.12 to 0.24 s that flow into each other, then a pause."""
    names = [name for name in _VISEMES if name != "rest"]
    keys, shapes, loudness = [0.0], ["rest"], [1.0]
    clock = random.uniform(0.1, 0.4)
    while clock < times[-1] + 1:
        for _ in range(random.integers(6, 11)):
            keys.append(clock)
            shapes.append(names[random.integers(len(names))])
            loudness.append(random.uniform(0.7, 1.15))
            clock += random.uniform(0.12, 0.24)
        pause = random.uniform(0.25, 0.7)
        keys += [clock, clock + pause]
        shapes += ["rest", "rest"]
        loudness += [1.0, 1.0]
        clock += pause + 0.12
    for index, (shape, loud) in enumerate(zip(shapes, loudness, strict=True)):
        before, now = keys[max(index - 1, 0)], keys[index]
        after = keys[min(index + 1, len(keys) - 1)]
        weight = smoothstep(before - 1e-6, now, times) * (1 - smoothstep(now, after + 1e-6, times))
        _add(tracks, _VISEMES[shape], scale * loud * weight)


def _add_gestures(random: np.random.Generator, times: np.ndarray, scale: float, tracks: Tracks) -> None:
    """Smiles, raised and lowered brows that come, stay and go; every kind returns."""
    order: list[str] = []
    clock = random.uniform(0.2, 0.8)
    while clock < times[-1]:
        if not order:
            order = [*random.permutation([*_GESTURES, "smile"])]
        rise, hold, fall = random.uniform(0.25, 0.45), random.uniform(0.3, 0.9), random.uniform(0.35, 0.6)
        weight = smoothstep(clock, clock + rise, times) - smoothstep(
            clock + rise + hold, clock + rise + hold + fall, times
        )
        _add(tracks, _GESTURES[order.pop()], scale * random.uniform(0.7, 1.0) * weight)
        clock += rise + hold + 0.6 * fall + random.uniform(0.0, 0.5)


def _add_blinks(random: np.random.Generator, times: np.ndarray, tracks: Tracks) -> None:
    """Closed in a third of a blink of 0.18 to 0.3 s, opened in the rest, every 1.2 to 3.5 s."""
    clock = random.uniform(0.5, 1.5)
    while clock < times[-1]:
        length = random.uniform(0.18, 0.3)
        weight = smoothstep(clock, clock + 0.35 * length, times) - smoothstep(
            clock + 0.45 * length, clock + length, times
        )
        tracks["eyeBlink"] = np.maximum(tracks.get("eyeBlink", 0), weight)
        clock += random.uniform(1.2, 3.5)


def _gaze(random: np.random.Generator, times: np.ndarray, recipe: SyntheticRecipe) -> np.ndarray:
    """Where the eyes look beside the camera: (down, left) angles in radians, held, with jumps of 40 ms between."""
    gaze = np.zeros((len(times), 2))
    if not recipe.blinks:
        return gaze
    clock, current = 0.0, np.zeros(2)
    while clock < times[-1]:
        clock += random.uniform(0.5, 1.6)
        target = random.normal(0, [0.05, 0.11]) if random.uniform() < 0.6 else np.zeros(2)
        gaze += smoothstep(clock, clock + 0.04, times)[:, None] * (target - current)
        current = target
    return gaze


def _expression(model: FaceModel, tracks: Tracks) -> Float[torch.Tensor, "t e"]:
    """Tracks as rows of the model's expression; `eyeBlink` drives `eyeBlinkLeft` and `eyeBlinkRight`."""
    timesteps = len(next(iter(tracks.values())))
    expression = np.zeros((timesteps, len(model.expression_names)))
    closed = tracks.get("eyeBlink", np.zeros(timesteps))
    for column, name in enumerate(model.expression_names):
        side = name.removesuffix("Left").removesuffix("Right")
        values = tracks.get(name, tracks.get(side))
        if values is None:
            continue
        if side in ("eyeSquint", "eyeWide"):
            values = values * (1 - closed)  # a closed eye has no further to go
        expression[:, column] = np.clip(values, *model.expression_bounds[column].tolist())
    return torch.from_numpy(expression).float()


def _joints(
    model: FaceModel, rotations: Float[torch.Tensor, "t 3 3"], gaze: Float[torch.Tensor, "t 2"]
) -> Float[torch.Tensor, "t j 3"]:
    joints = torch.zeros(len(gaze), len(model.free_joint_names), 3)
    shoulders = shoulder_rotation(axis_angle_from_matrix(rotations))
    for column, name in enumerate(model.free_joint_names):
        if "eye" in name:
            joints[:, column, :2] = gaze
        elif name == "neck":
            joints[:, column] = axis_angle_from_matrix(rotations.transpose(-1, -2) @ shoulders)
    return joints
