"""Generate a head's motion from a seed, with natural timing.

The order of the file: the script in time, the expressions (speech, smiles and brows, posed expressions, blinks), then
the pose and gaze of the head. Names of expressions are ARKit's.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate

import numpy as np
import torch
from jaxtyping import Float

from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.lab.synthetic.arithmetic import smoothstep
from mien.lab.synthetic.posing import rest_joints
from mien.lab.synthetic.recipe import PEOPLE, Segment, SegmentKind, SyntheticRecipe
from mien.machine import exact
from mien.runtime.rotation import axis_angle_from_matrix, matrix_from_axis_angle

_TURNS = ((0.0, 1.0), (0.0, -1.0), (0.7, 0.0), (-0.8, 0.0), (0.4, 0.7), (-0.4, -0.7), (0.4, -0.7), (-0.4, 0.7))
"""Goals of successive turns, as shares of the largest pitch (positive looks down) and yaw."""

_Tracks = dict[str, np.ndarray]
"""Coefficients over time by name. A name without a side means both sides."""


@dataclass(frozen=True)
class _Span:
    """A segment with its start and end in the clip, in seconds."""

    kind: SegmentKind
    start: float
    end: float
    first: bool
    last: bool

    def window(self, times: np.ndarray) -> np.ndarray:
        """Return 1 inside and 0 outside, with soft ends inside, except at the beginning and the end of the clip."""
        ramp = min(0.5, 0.25 * (self.end - self.start))
        rise = 1.0 if self.first else smoothstep(self.start, self.start + ramp, times)
        fall = 0.0 if self.last else smoothstep(self.end - ramp, self.end, times)
        return rise - fall + np.zeros_like(times)


def _lay_out(recipe: SyntheticRecipe) -> tuple[_Span, ...]:
    segments = recipe.script or (Segment("free", recipe.seconds),)
    ends = list(accumulate(segment.seconds for segment in segments))
    last = len(segments) - 1
    return tuple(
        _Span(segment.kind, end - segment.seconds, end, index == 0, index == last)
        for index, (segment, end) in enumerate(zip(segments, ends, strict=True))
    )


def _moving_clock(times: np.ndarray, spans: tuple[_Span, ...]) -> np.ndarray:
    """Return the seconds of motion so far: a clock that stops while the script is still."""
    speed = 1 - _share_of("still", times, spans)
    step = float(times[1] - times[0]) if len(times) > 1 else 0.0
    return np.concatenate([[0.0], np.cumsum(speed[:-1]) * step])


def _share_of(kind: SegmentKind, times: np.ndarray, spans: tuple[_Span, ...]) -> np.ndarray:
    """Return the share of this kind at each time, 0..1."""
    return sum((span.window(times) for span in spans if span.kind == kind), np.zeros_like(times))


def _wide_turns(times: np.ndarray, spans: tuple[_Span, ...], pitch: float, yaw: float) -> tuple[np.ndarray, np.ndarray]:
    """Return pitch and yaw of the turns, up to these angles: sideways, up, down, diagonally, and back."""
    down, left = np.zeros_like(times), np.zeros_like(times)
    for span in spans:
        if span.kind != "turns":
            continue
        before = np.zeros(2)
        moves = max(int((span.end - span.start) / 2.2), 2)
        length = (span.end - span.start) / moves
        for index in range(moves):
            goal = np.array(_TURNS[index % len(_TURNS)] if index < moves - 1 else (0.0, 0.0))
            begin = span.start + index * length
            share = smoothstep(begin, begin + 0.9 * length, times)
            down += share * (goal - before)[0]
            left += share * (goal - before)[1]
            before = goal
    return pitch * down, yaw * left


def _make_tracks(
    random: np.random.Generator, times: np.ndarray, scale: float, spans: tuple[_Span, ...], *, blinks: bool
) -> _Tracks:
    """Return every coefficient over time that is not always 0; `scale` is that of everything but blinks."""
    tracks: _Tracks = {}
    for span in spans:
        for add in _EXPRESSIONS_OF[span.kind]:
            part: _Tracks = {}
            add(random, times, span, part)
            window = span.window(times)
            _add(tracks, dict.fromkeys(part, 1.0), scale * window, part)
    if blinks:
        _add_blinks(random, times, spans, tracks)
    return tracks


def _add(tracks: _Tracks, shape: Mapping[str, float], weight: np.ndarray, factors: _Tracks | None = None) -> None:
    for name, value in shape.items():
        tracks[name] = tracks.get(name, 0) + value * weight * (1 if factors is None else factors[name])


def _bump(times: np.ndarray, start: float, high: float, down: float, end: float) -> np.ndarray:
    """Return a rise from `start` to `high` and a fall from `down` to `end`, 0..1."""
    return smoothstep(start, high, times) - smoothstep(down, end, times)


def _add_speech(random: np.random.Generator, times: np.ndarray, span: _Span, tracks: _Tracks) -> None:
    """Add phrases of one to two seconds: visemes every 0.12 to 0.24 s that blend into each other, then a pause."""
    names = [name for name in PEOPLE["visemes"] if name != "rest"]
    keys, shapes, loudness = [span.start], ["rest"], [1.0]
    clock = span.start + random.uniform(0.1, 0.4)
    while clock < span.end + 1:
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
        _add(tracks, PEOPLE["visemes"][shape], loud * weight)


def _add_gestures(random: np.random.Generator, times: np.ndarray, span: _Span, tracks: _Tracks) -> None:
    """Add smiles, raised and lowered brows that rise, hold and fall. Every kind recurs."""
    order: list[str] = []
    clock = span.start + random.uniform(0.2, 0.8)
    while clock < span.end:
        if not order:
            order = [*random.permutation([*PEOPLE["gestures"], "smile"])]
        rise, hold, fall = random.uniform(0.25, 0.45), random.uniform(0.3, 0.9), random.uniform(0.35, 0.6)
        weight = _bump(times, clock, clock + rise, clock + rise + hold, clock + rise + hold + fall)
        _add(tracks, PEOPLE["gestures"][order.pop()], random.uniform(0.7, 1.0) * weight)
        clock += rise + hold + 0.6 * fall + random.uniform(0.0, 0.5)


def _add_posed(random: np.random.Generator, times: np.ndarray, span: _Span, tracks: _Tracks) -> None:
    """Add one posed expression after the other: rise, hold, fall. All kinds occur before one recurs."""
    order: list[str] = []
    clock = span.start + 0.2
    while clock < span.end - 1.0:
        order = order or [*random.permutation([*PEOPLE["posed"]])]
        rise, hold, fall = random.uniform(0.3, 0.5), random.uniform(0.4, 0.9), random.uniform(0.3, 0.5)
        down = clock + rise + hold
        weight = _bump(times, clock, clock + rise, down, down + fall)
        _add(tracks, PEOPLE["posed"][order.pop()], random.uniform(0.8, 1.0) * weight)
        clock = down + fall + random.uniform(0.0, 0.25)


def _add_blinks(random: np.random.Generator, times: np.ndarray, spans: tuple[_Span, ...], tracks: _Tracks) -> None:
    """Add blinks every 1.2 to 3.5 s. They last 0.18 to 0.3 s and close in a third of that."""
    clock = random.uniform(0.5, 1.5)
    closed = np.zeros_like(times)
    while clock < times[-1]:
        length = random.uniform(0.18, 0.3)
        if not any(span.kind == "still" and span.start < clock + length and clock < span.end for span in spans):
            bump = _bump(times, clock, clock + 0.35 * length, clock + 0.45 * length, clock + length)
            closed = np.maximum(closed, bump)
        clock += random.uniform(1.2, 3.5)
    tracks["eyeBlink"] = np.maximum(tracks.get("eyeBlink", 0), closed)


_AddExpressions = Callable[[np.random.Generator, np.ndarray, _Span, _Tracks], None]
_EXPRESSIONS_OF: dict[str, tuple[_AddExpressions, ...]] = {
    "still": (),
    "speech": (_add_speech,),
    "expressions": (_add_posed,),
    "turns": (),
    "free": (_add_speech, _add_gestures),
}


def generate_motion(model: FaceModel, identity: torch.Tensor, recipe: SyntheticRecipe, seed: int) -> FaceParams:
    """Return face parameters of every timestep. The camera is at the world's origin and looks along -z.

    The head turns about the base of the neck, which sways. The neck joint, if the model has one, bends so that the base
    of the neck stays with the shoulders.
    """
    random = np.random.default_rng([seed, 1])
    times, spans = np.arange(recipe.timesteps) / recipe.fps, _lay_out(recipe)
    clock = _moving_clock(times, spans)
    pitch_yaw_roll = np.stack(
        [_drift(random, clock, amplitude) for amplitude in np.radians(np.array(recipe.rotation)[[1, 0, 2]])], axis=-1
    )
    sway = np.stack([_drift(random, clock, amplitude) for amplitude in recipe.translation], axis=-1)
    pitch_yaw_roll *= 1 - _share_of("turns", times, spans)[:, None]
    turned = _wide_turns(times, spans, *np.radians(recipe.turns)[::-1])
    pitch_yaw_roll[:, :2] += np.stack(turned, axis=-1)
    gaze = _gaze(random, times, spans) if recipe.blinks else np.zeros((len(times), 2))
    gaze -= np.clip(0.85 * pitch_yaw_roll[:, :2], -0.42, 0.42)  # the eyes keep looking into the camera
    tracks = _make_tracks(random, times, recipe.expression, spans, blinks=recipe.blinks)
    rotations = _euler_matrices(pitch_yaw_roll)
    pivot = neck_pivot(model, identity)
    anchor = np.array([0.0, 0.0, -recipe.distance]) + pivot + sway
    head_rotation = axis_angle_from_matrix(rotations)
    return FaceParams(
        identity=identity, expression=_expression(model, tracks, len(times)),
        joints=_joints(model, rotations, head_rotation, gaze), head_rotation=torch.from_numpy(head_rotation).float(),
        head_translation=torch.from_numpy(anchor - exact.dot(rotations, pivot)).float(),
    )  # fmt: skip


def shoulder_rotation(head_rotation: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3 3"]:
    """Return the shoulders' rotations, which are a quarter of the head's (axis-angle)."""
    return matrix_from_axis_angle(0.25 * head_rotation)


def neck_pivot(model: FaceModel, identity: torch.Tensor) -> Float[np.ndarray, " 3"]:
    """Return the point at the neck joint, in the head frame, that stays in place when the head nods and turns."""
    if "neck" in model.joint_names:
        return rest_joints(model, identity)[model.joint_names.index("neck")]
    return np.array([0.0, -0.10, -0.02])


def _euler_matrices(pitch_yaw_roll: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3 3"]:
    """Return rotations by roll, then pitch, then yaw, about the head's +z, +x and +y axes.

    Angles are in radians. Positive pitch looks down.
    """
    axes = np.eye(3)
    pitch, yaw, roll = (matrix_from_axis_angle(pitch_yaw_roll[..., i, None] * axes[i]) for i in range(3))
    return exact.product(exact.product(yaw, pitch), roll)


def with_expressions(model: FaceModel, face: FaceParams, expressions: Sequence[Mapping[str, float]]) -> FaceParams:
    """Return one timestep with other expressions, by coefficient, one after the other. Coefficients not named are 0."""
    posed = face[[0] * len(expressions)]
    rows = [[one.get(name, 0.0) for name in model.expression_names] for one in expressions]
    return replace(posed, expression=torch.tensor(rows).to(posed.expression))


def _drift(random: np.random.Generator, times: np.ndarray, amplitude: float) -> np.ndarray:
    """Return slow, aimless motion whose maximum is the amplitude."""
    total = np.zeros_like(times)
    for frequency, strength in ((0.11, 1.0), (0.19, 0.7), (0.33, 0.35), (0.62, 0.12)):
        frequency *= random.uniform(0.85, 1.15)
        total += strength * np.sin(2 * np.pi * (frequency * times + random.uniform()))
    return amplitude * total / max(np.abs(total).max(), 1e-9)


def _gaze(random: np.random.Generator, times: np.ndarray, spans: tuple[_Span, ...]) -> np.ndarray:
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


def _expression(model: FaceModel, tracks: _Tracks, timesteps: int) -> Float[torch.Tensor, "t e"]:
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
    model: FaceModel, rotations: Float[np.ndarray, "t 3 3"], head_rotation: Float[np.ndarray, "t 3"],
    gaze: Float[np.ndarray, "t 2"],
) -> Float[torch.Tensor, "t j 3"]:  # fmt: skip
    joints = np.zeros((len(gaze), len(model.free_joint_names), 3))
    shoulders = shoulder_rotation(head_rotation)
    for column, name in enumerate(model.free_joint_names):
        if "eye" in name:
            joints[:, column, :2] = gaze
        elif name == "neck":
            joints[:, column] = axis_angle_from_matrix(exact.product(np.swapaxes(rotations, 1, 2), shoulders))
    return torch.from_numpy(joints).float()
