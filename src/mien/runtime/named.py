"""Names beside those of expressions: ARKit's eight names of gaze, which turn the eyes, preset faces, and visemes.

presets.json beside this file is the only table of preset faces, and visemes.json that of visemes. The web runtime's
build reads them, too.
"""

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

import numpy as np
from jaxtyping import Float32

from mien.runtime.rotation import axis_angle_from_matrix, matrix_from_axis_angle

LOOK_ANGLE = math.radians(30)
"""Rotation of an eye for an eyeLook coefficient of 1, in radians. Apple gives no angle; this is about the most that
eyes turn."""
MOST_UP, MOST_DOWN = math.radians(14), math.radians(18)
"""Pitch that a turned eye comes near but does not exceed, in radians. Beyond it, lids that follow the gaze hide the
iris; measured at 30 degrees (docs/log.md, "Mouth")."""
GAZE_NAMES = tuple(f"eyeLook{way}{side}" for side in ("Left", "Right") for way in ("Down", "In", "Out", "Up"))
"""ARKit's names of gaze. No face model has an expression for them: they turn the eye of their side."""
EYES = {"Left": "left_eye", "Right": "right_eye"}
"""The joint of each side's eye."""
_SIDES = {"Left": ("Out", "In"), "Right": ("In", "Out")}
"""For each eye, the way to the subject's left, then that to the right."""


@dataclass(frozen=True)
class Part:
    """One coefficient that a name sets: that of an expression, or of a gaze."""

    name: str
    value: float
    is_added: bool
    """Whether the value is added to that of the face at rest, as those of presets are."""


@cache
def presets() -> Mapping[str, Mapping[str, float]]:
    """Preset faces by name: coefficients by ARKit's names, which are added to the face at rest."""
    return json.loads(files("mien.runtime").joinpath("presets.json").read_text(encoding="utf-8"))


@cache
def visemes() -> Mapping[str, Mapping[str, float]]:
    """Mouths of sounds by the names of Oculus' 15 visemes: coefficients by ARKit's names, added to the face at rest."""
    return json.loads(files("mien.runtime").joinpath("visemes.json").read_text(encoding="utf-8"))


def is_gaze(name: str, joint_names: Sequence[str]) -> bool:
    """Whether a name turns an eye of a face model with these free joints."""
    return name in GAZE_NAMES and EYES[_side(name)] in joint_names


def presets_for(expression_names: Sequence[str], joint_names: Sequence[str]) -> list[str]:
    """The presets that a face model can show: it has all of their expressions, and eyes for their gaze."""
    known = {*expression_names} - {*GAZE_NAMES}
    return [
        preset
        for preset, values in presets().items()
        if all(name in known or is_gaze(name, joint_names) for name in values)
    ]


def parts_of(name: str, value: float) -> list[Part]:
    """What a name sets: itself, or every coefficient of a preset times `value`."""
    preset = presets().get(name)
    return [Part(name, value, False)] if preset is None else [Part(n, value * v, True) for n, v in preset.items()]


def gaze_of(look: Mapping[str, float | np.ndarray], side: str) -> tuple[float | np.ndarray, float | np.ndarray]:
    """Pitch and yaw of an eye for eyeLook coefficients, in radians: down and to the subject's left are positive.

    `look` has coefficients by name, of which missing ones are 0. `side` is Left or Right.
    """
    to_left, to_right = (look.get(f"eyeLook{way}{side}", 0.0) for way in _SIDES[side])
    down, up = (look.get(f"eyeLook{way}{side}", 0.0) for way in ("Down", "Up"))
    return LOOK_ANGLE * (down - up), LOOK_ANGLE * (to_left - to_right)


def within_lids(eyes: Float32[np.ndarray, "*t 3"]) -> Float32[np.ndarray, "*t 3"]:
    """Rotations of eyes with a softly limited pitch: small ones hardly change, and large ones keep the eye open.

    The face model's lids follow the gaze in proportion, as they do at 10 degrees. At 25 degrees up or down, the lids
    would cover the iris, which a person's lids do not.
    """
    limited, most = eyes.copy(), np.where(eyes[..., 0] < 0, MOST_UP, MOST_DOWN)
    limited[..., 0] = most * np.tanh(eyes[..., 0] / most)
    return limited


def turned_eyes(
    joints: Float32[np.ndarray, "*t j 3"], joint_names: Sequence[str], look: Mapping[str, float]
) -> Float32[np.ndarray, "*t j 3"]:
    """Free joints whose eyes look aside from where they look, by eyeLook coefficients. Eyes without one stay.

    Joints are axis-angle vectors in radians, in the order of their names.
    """
    turned = joints.copy()
    for side in sorted({_side(name) for name in look if is_gaze(name, joint_names)}):
        at = list(joint_names).index(EYES[side])
        aside = within_lids(np.array([*gaze_of(look, side), 0.0], np.float32))
        matrices = matrix_from_axis_angle(joints[..., at, :]) @ matrix_from_axis_angle(aside)
        turned[..., at, :] = axis_angle_from_matrix(matrices)
    return turned


def _side(name: str) -> str:
    return re.split(r"(Left|Right)$", name)[1]
