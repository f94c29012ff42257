"""Advice on what to film again: what an avatar has seen too little of, and where it is least like the person."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path

import numpy as np

from mien.disk.files import read_arrays, read_json
from mien.errors import UserError
from mien.runtime.baked import PortableAvatar
from mien.runtime.file import read_portable
from mien.runtime.filmed import head_angles

_MOST, _SIDE, _UP_OR_DOWN = 3, np.radians(35.0), np.radians(12.0)
"""Number of things that are asked for at once, and how far a camera should have seen the head from each side, and from
above and below. Fills begin beyond it."""
_TURNS = {
    # A camera sees the person's right side when the head turns to the left.
    "Turn your head further to the left": (0, -_SIDE), "Turn your head further to the right": (0, _SIDE),
    "Lift your chin, and look up": (1, -_UP_OR_DOWN), "Lower your chin, and look down": (1, _UP_OR_DOWN),
}  # fmt: skip
"""Each has what to do, which of the camera's angles shows it, and how far that should go."""
_FACES = {
    "Smile, and show your teeth": (("mouthSmileLeft", "mouthSmileRight"), 0.4, "mouth"),
    "Say a long A, with your mouth wide open": (("jawOpen",), 0.4, "mouth"),
    "Say O and U, with round lips": (("mouthFunnel", "mouthPucker"), 0.3, "mouth"),
    "Raise your eyebrows": (("browInnerUp", "browOuterUpLeft", "browOuterUpRight"), 0.3, "head"),
    "Shut your eyes for a second": (("eyeBlinkLeft", "eyeBlinkRight"), 0.5, "eyes"),
}
"""Each has what to do, which expressions show it, how strong one of them should be, and the part whose error tells."""
_SHOWN, _LEAST_FRAMES, _CLEARLY = 0.5, 5, 2.0
"""Share of a turn or a face from which a held-out frame shows it, how many have to show it, and as many not to, and by
how many decibels they have to be worse before it is asked for again."""


def advice(portable: PortableAvatar, worst: str = "") -> list[str]:
    """Return up to three things to film, what lacks most first. `worst` is what `worst_shown` has found."""
    filmed, found = portable.filmed, []
    if filmed is not None:
        turned = {words: filmed.head_angles[axis, int(angle > 0)] / angle for words, (axis, angle) in _TURNS.items()}
        shares = turned | _shares(portable, filmed.highest[None, : len(portable.expression_names)])
        found = [words for share, words in sorted((share, words) for words, share in shares.items()) if share < 0.9]
    if not worst or worst in found[:_MOST]:
        return found[:_MOST]
    again = f"{worst.replace('further ', '')}, once more and slowly: the avatar is least like you there"
    return [*found[: _MOST - 1], again]


def worst_shown(
    portable: PortableAvatar, expression: np.ndarray, angles: np.ndarray, psnr: Mapping[str, Sequence[float | None]]
) -> str:
    """Return the turn or the face in whose held-out frames the avatar is clearly least like the person; "" without one.

    Expressions, angles of the camera, and `psnr` of the head and its parts have a row for each held-out frame.
    """
    errors = {part: 10 ** (-np.array(values, np.float64) / 10) for part, values in psnr.items()}
    shares = {words: angles[:, axis] / angle for words, (axis, angle) in _TURNS.items()}
    worst, most = "", _CLEARLY
    for words, share in (shares | _shares(portable, expression)).items():
        error = errors[_FACES[words][2] if words in _FACES else "head"]
        shows, others = (error[here & np.isfinite(error)] for here in (share > _SHOWN, share <= _SHOWN))
        if min(len(shows), len(others)) >= _LEAST_FRAMES:
            worse = float(10 * np.log10(shows.mean() / others.mean()))
            worst, most = (words, worse) if worse > most else (worst, most)
    return worst


def advice_for(path: Path, run: str) -> list[str]:
    """The same for the .mien file of a workspace, and its run; nothing if the file is missing or damaged."""
    try:
        return list(_remembered(path, path.stat().st_mtime_ns, path.parent / "runs" / run / "metrics.json"))
    except (OSError, UserError):
        return []


@lru_cache(maxsize=64)
def _remembered(path: Path, changed: int, scored: Path) -> tuple[str, ...]:
    portable, worst = read_portable(path), ""
    with suppress(OSError, UserError, LookupError, ValueError, TypeError):  # not scored, or the footage was not kept
        worst = _worst_of(portable, scored)
    return tuple(advice(portable, worst))


def _worst_of(portable: PortableAvatar, scored: Path) -> str:
    frames = next(iter(read_json(scored, "mien.metrics", 1)["protocols"].values()))["per_frame"]
    sequences, at = np.array(frames["sequence"]), np.array(frames["timestep"])
    expression, angles = np.zeros((len(at), len(portable.expression_names))), np.zeros((len(at), 2))
    for sequence in set(frames["sequence"]):
        tracked = read_arrays(scored.parents[2] / "sequences" / sequence / "tracking" / "tracking.safetensors")
        T_camera_world, rows = tracked["camera_viewmats"][0], sequences == sequence
        expression[rows] = tracked["expression"][at[rows]]
        rotation, translation = (tracked[f"head_{name}"][at[rows]] for name in ("rotation", "translation"))
        angles[rows] = head_angles(rotation, translation, -T_camera_world[:3, :3].T @ T_camera_world[:3, 3])
    psnr = {part: frames[f"{part}_psnr"] for part in ("head", "eyes", "mouth")}
    return worst_shown(portable, expression, angles, psnr)


def _shares(portable: PortableAvatar, expression: np.ndarray) -> dict[str, np.ndarray]:
    """How strong each face is in each row, 1 is enough; without faces that a face model does not know."""
    names, change = portable.expression_names, expression - portable.neutral.expression
    columns = {words: [names.index(each) for each in shown if each in names] for words, (shown, *_) in _FACES.items()}
    return {words: change[:, found].max(axis=1) / _FACES[words][1] for words, found in columns.items() if found}
