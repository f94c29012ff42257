"""Faces for pictures of a drawn person that no clip shows: single expressions, the pages' buttons, and pairs."""

from collections.abc import Mapping

from mien.face.model import FaceModel
from mien.runtime.named import presets

_LEAST_MOTION = 2e-4  # of the vertex that moves most, in metres. Gaze turns joints, and moves nothing here
_BUTTONS = 8
"""Number of presets that a page has as buttons."""


def _both(name: str, value: float) -> dict[str, float]:
    return {f"{name}Left": value, f"{name}Right": value}


_PARTS: dict[str, Mapping[str, float]] = {
    "open mouth": {"jawOpen": 0.7}, "smile": _both("mouthSmile", 0.8), "pucker": {"mouthPucker": 0.9},
    "press": _both("mouthPress", 0.7), "puff": {"cheekPuff": 0.8},
    "brows up": {"browInnerUp": 0.8, **_both("browOuterUp", 0.8)}, "brows down": _both("browDown", 0.8),
    "blink": _both("eyeBlink", 1.0), "wide eyes": _both("eyeWide", 0.8), "sneer": _both("noseSneer", 0.7),
}  # fmt: skip
_PAIRS = (
    ("open mouth", "brows up"), ("open mouth", "brows down"), ("open mouth", "blink"), ("open mouth", "wide eyes"),
    ("smile", "brows up"), ("smile", "brows down"), ("smile", "blink"), ("pucker", "brows up"), ("press", "brows down"),
    ("puff", "brows up"), ("sneer", "open mouth"), ("sneer", "brows up"),
)  # fmt: skip


def posed_faces(model: FaceModel) -> dict[str, Mapping[str, float]]:
    """Coefficients of each face by its name, the face at rest first.

    The others are each expression that moves the mesh at 1 and at 0.5, the pages' buttons, and pairs of parts.
    """
    moved = model.expression_basis.norm(dim=-1).amax(-1) > _LEAST_MOTION
    singles = [name for name, moves in zip(model.expression_names, moved.tolist(), strict=True) if moves]
    return {
        "rest": {},
        **{name: {name: 1.0} for name in singles},
        **{f"{name} 0.5": {name: 0.5} for name in singles},
        **{name: values for name, values in [*presets().items()][:_BUTTONS]},
        **{f"{one}, {other}": {**_PARTS[one], **_PARTS[other]} for one, other in _PAIRS},
    }
