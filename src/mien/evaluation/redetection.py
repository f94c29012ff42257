"""Motion of a detected face relative to a frame at rest, to judge driven avatars without true pictures.

The expression is the displacement of lips, lids and brows from the same face at rest, after pose, size and position of
the head are removed by a similarity fitted to nose and eye corners. Its unit is the distance between the outer eye
corners. Neither identity nor head pose count, only what moves. The same detector measures driver and avatar.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mien.rotation import align_centered
from mien.tracking.landmarks.groups import BROWS, EYE_CORNERS, LEFT_EYELIDS, LIPS, NOSE, RIGHT_EYELIDS

MEASURED_BY = "MediaPipe face mesh, 478 points in 3D, each picture by itself"
_RIGID = np.array(NOSE + EYE_CORNERS)
_MOVING = np.array(LIPS + LEFT_EYELIDS + RIGHT_EYELIDS + BROWS)
_OUTER_CORNERS = (33, 263)
_MOUTH = ((13, 14),)
_EYES = ((159, 145), (386, 374))


@dataclass(frozen=True, eq=False)
class MeasuredMotion:
    """Motion of one face relative to the same face at rest."""

    displacement: Float[np.ndarray, "m 3"]
    """Displacements of lips, lids and brows, in distances between the outer eye corners."""
    rotation: Float[np.ndarray, "3 3"]
    """Rotation of the head, in the camera's axes."""
    mouth: float
    """Opening of the lips, in distances between the outer eye corners."""
    eyes: float
    """Mean opening of the lids, in the same unit."""


def measure_motion(points: Float[np.ndarray, "l 3"], at_rest: Float[np.ndarray, "l 3"]) -> MeasuredMotion:
    """The motion of a face, from its landmarks and those of the same face at rest."""
    rotation, scale, shift = similarity(points[_RIGID], at_rest[_RIGID])
    aligned = scale * points @ rotation.T + shift
    unit = float(np.linalg.norm(at_rest[_OUTER_CORNERS[0]] - at_rest[_OUTER_CORNERS[1]]))
    displacement = (aligned - at_rest)[_MOVING] / unit
    # The fit takes the picture back to rest, so the head's own rotation is the inverse.
    return MeasuredMotion(displacement, rotation.T, _opening(aligned, _MOUTH) / unit, _opening(aligned, _EYES) / unit)


def similarity(
    source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "3 3"], float, Float[np.ndarray, " 3"]]:
    """Rotation, scale and shift with target ~ scale * rotation @ source + shift, by least squares (Umeyama 1991)."""
    source_mean, target_mean = source.mean(0), target.mean(0)
    rotation, scale = align_centered(source - source_mean, target - target_mean)
    return rotation, scale, target_mean - scale * rotation @ source_mean


def angle_degrees(rotation: Float[np.ndarray, "3 3"]) -> float:
    """The angle of a rotation in degrees."""
    return float(np.degrees(np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1))))


def transfer_figures(pairs: list[tuple[MeasuredMotion, MeasuredMotion]]) -> dict[str, float | None]:
    """How well (driver, avatar) motions agree, and the same for an avatar that never moves (`..._still`).

    Correlations are Pearson's, of an opening over the frames. They are None if an opening hardly changes, or for fewer
    than three frames.
    """
    driver, own = [pair[0] for pair in pairs], [pair[1] for pair in pairs]

    def mean_length(displacements: list[np.ndarray]) -> float:
        return float(np.mean([np.linalg.norm(one, axis=1).mean() for one in displacements]))

    return {
        "expression_error": mean_length([a.displacement - b.displacement for a, b in pairs]),
        "expression_error_still": mean_length([one.displacement for one in driver]),
        "head_rotation_error_degrees": float(np.mean([angle_degrees(a.rotation.T @ b.rotation) for a, b in pairs])),
        "head_rotation_error_still_degrees": float(np.mean([angle_degrees(one.rotation) for one in driver])),
        "mouth_correlation": _correlation([one.mouth for one in driver], [one.mouth for one in own]),
        "eyes_correlation": _correlation([one.eyes for one in driver], [one.eyes for one in own]),
    }


def _correlation(first: list[float], second: list[float]) -> float | None:
    if len(first) < 3 or min(np.std(first), np.std(second)) < 1e-6:
        return None
    return float(np.corrcoef(first, second)[0, 1])


def _opening(points: Float[np.ndarray, "l 3"], pairs: tuple[tuple[int, int], ...]) -> float:
    return float(np.mean([np.linalg.norm(points[a] - points[b]) for a, b in pairs]))
