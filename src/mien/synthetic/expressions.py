"""A face's expressions over time: speech, smiles and frowns, posed expressions, blinks. Names are ARKit's."""

from collections.abc import Callable, Mapping

import numpy as np

from mien.synthetic.noise import smoothstep
from mien.synthetic.script import Span

Tracks = dict[str, np.ndarray]
"""Coefficients over time by name. A name without a side means both sides."""

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
_POSED: dict[str, Mapping[str, float]] = {
    "mouth wide open": {"jawOpen": 0.85},
    "broad smile": {"mouthSmile": 1.0, "cheekSquint": 0.8, "eyeSquint": 0.5, "mouthUpperUp": 0.5, "jawOpen": 0.12},
    "pucker": {"mouthPucker": 1.0},
    "brows up": {"browInnerUp": 1.0, "browOuterUp": 1.0, "eyeWide": 0.7},
    "anger": {"browDown": 1.0, "eyeSquint": 0.5, "noseSneer": 0.7, "mouthPress": 0.5},
    "mouth left": {"mouthLeft": 0.8, "jawLeft": 0.4},
    "mouth right": {"mouthRight": 0.8, "jawRight": 0.4},
    "puffed cheeks": {"cheekPuff": 1.0, "mouthPress": 0.4},
    "sadness": {"browInnerUp": 0.9, "mouthFrown": 1.0, "mouthShrugLower": 0.6},
    "funnel": {"mouthFunnel": 1.0, "jawOpen": 0.25},
    "half a smile": {"mouthSmileLeft": 0.9, "mouthDimpleLeft": 0.5},
    "wink": {"eyeBlinkRight": 1.0, "cheekSquintRight": 0.7, "mouthSmileRight": 0.4},
    "eyes shut tight": {"eyeBlink": 1.0, "eyeSquint": 0.9, "cheekSquint": 0.8, "browDown": 0.5},
    "rolled lips": {"mouthRollLower": 0.8, "mouthRollUpper": 0.8},
}


def expression_tracks(
    random: np.random.Generator, times: np.ndarray, scale: float, spans: tuple[Span, ...], *, blinks: bool
) -> Tracks:
    """Return every coefficient over time that is not always 0.

    Args:
        random: Decides timing and order.
        times: Times in seconds.
        scale: Scale of everything but blinks.
        spans: Spans of the script.
        blinks: Whether to add blinks.
    """
    tracks: Tracks = {}
    for span in spans:
        for add in _PARTS[span.kind]:
            part: Tracks = {}
            add(random, times, span, part)
            window = span.window(times)
            _add(tracks, dict.fromkeys(part, 1.0), scale * window, part)
    if blinks:
        _add_blinks(random, times, spans, tracks)
    return tracks


def _add(tracks: Tracks, shape: Mapping[str, float], weight: np.ndarray, factors: Tracks | None = None) -> None:
    for name, value in shape.items():
        tracks[name] = tracks.get(name, 0) + value * weight * (1 if factors is None else factors[name])


def _add_speech(random: np.random.Generator, times: np.ndarray, span: Span, tracks: Tracks) -> None:
    """Add phrases of one to two seconds: visemes every 0.12 to 0.24 s that blend into each other, then a pause."""
    names = [name for name in _VISEMES if name != "rest"]
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
        _add(tracks, _VISEMES[shape], loud * weight)


def _add_gestures(random: np.random.Generator, times: np.ndarray, span: Span, tracks: Tracks) -> None:
    """Add smiles, raised and lowered brows that rise, hold and fall. Every kind recurs."""
    order: list[str] = []
    clock = span.start + random.uniform(0.2, 0.8)
    while clock < span.end:
        if not order:
            order = [*random.permutation([*_GESTURES, "smile"])]
        rise, hold, fall = random.uniform(0.25, 0.45), random.uniform(0.3, 0.9), random.uniform(0.35, 0.6)
        weight = smoothstep(clock, clock + rise, times) - smoothstep(
            clock + rise + hold, clock + rise + hold + fall, times
        )
        _add(tracks, _GESTURES[order.pop()], random.uniform(0.7, 1.0) * weight)
        clock += rise + hold + 0.6 * fall + random.uniform(0.0, 0.5)


def _add_posed(random: np.random.Generator, times: np.ndarray, span: Span, tracks: Tracks) -> None:
    """Add one posed expression after the other: rise, hold, fall. All kinds occur before one recurs."""
    order: list[str] = []
    clock = span.start + 0.2
    while clock < span.end - 1.0:
        order = order or [*random.permutation([*_POSED])]
        rise, hold, fall = random.uniform(0.3, 0.5), random.uniform(0.4, 0.9), random.uniform(0.3, 0.5)
        down = clock + rise + hold
        weight = smoothstep(clock, clock + rise, times) - smoothstep(down, down + fall, times)
        _add(tracks, _POSED[order.pop()], random.uniform(0.8, 1.0) * weight)
        clock = down + fall + random.uniform(0.0, 0.25)


def _add_blinks(random: np.random.Generator, times: np.ndarray, spans: tuple[Span, ...], tracks: Tracks) -> None:
    """Add blinks every 1.2 to 3.5 s. They last 0.18 to 0.3 s and close in a third of that."""
    clock = random.uniform(0.5, 1.5)
    closed = np.zeros_like(times)
    while clock < times[-1]:
        length = random.uniform(0.18, 0.3)
        if not any(span.kind == "still" and span.start < clock + length and clock < span.end for span in spans):
            weight = smoothstep(clock, clock + 0.35 * length, times) - smoothstep(
                clock + 0.45 * length, clock + length, times
            )
            closed = np.maximum(closed, weight)
        clock += random.uniform(1.2, 3.5)
    tracks["eyeBlink"] = np.maximum(tracks.get("eyeBlink", 0), closed)


_Part = Callable[[np.random.Generator, np.ndarray, Span, Tracks], None]
_PARTS: dict[str, tuple[_Part, ...]] = {
    "still": (),
    "speech": (_add_speech,),
    "expressions": (_add_posed,),
    "turns": (),
    "free": (_add_speech, _add_gestures),
}
