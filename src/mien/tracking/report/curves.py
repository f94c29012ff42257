"""The charts of the report page: residuals, head pose, depth and the distance of the irises over time."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from markupsafe import Markup

from mien.pages.plots import Axes, Series, line_chart

_WIDTH, _HEIGHT = 520, 200
_TURNS = (("pitch", "main"), ("yaw", "second"), ("roll", "third"))


@dataclass(frozen=True, eq=False)
class Curves:
    """What a tracking report draws over time. Values are NaN where there is none."""

    seconds: Float[np.ndarray, " t"]
    """Time of each timestep."""
    landmarks_px: Float[np.ndarray, " t"]
    """Median distance of landmarks, in pixels."""
    colors: Float[np.ndarray, " t"] | None
    """Median difference of colours, each channel 0..1. None if pixels were not used."""
    turns: Float[np.ndarray, "t 3"]
    """Pitch, yaw and roll of the head relative to the most frontal camera, in degrees."""
    depth_m: Float[np.ndarray, " t"]
    """Distance of the head from that camera."""
    iris_mm: Float[np.ndarray, " t"]
    """Distance of the irises."""
    flagged: Sequence[int]
    """Timesteps that stand out."""
    without_face: Sequence[int]
    """Timesteps without a face."""


@dataclass(frozen=True)
class Chart:
    """A chart with a title."""

    title: str
    chart: Markup


def charts(curves: Curves) -> list[Chart]:
    """The charts, in the order of the page. Flagged timesteps are dots; those without a face are shaded."""
    t = curves.seconds
    odd = list(curves.flagged)

    def residual(name: str, values: np.ndarray) -> list[Series]:
        return [Series(name, t, values), Series("flagged", t[odd], values[odd], "second", points=True)]

    drawn: list[tuple[str, str, list[Series]]] = [
        ("Distance of landmarks from the detected ones, pixels", "pixels", residual("landmarks", curves.landmarks_px)),
    ]
    if curves.colors is not None:
        values = 100 * curves.colors
        drawn.append(("Difference of colours, %", "%", residual("colours", values)))
    turns = [Series(name, t, curves.turns[:, axis], style) for axis, (name, style) in enumerate(_TURNS)]
    drawn += [
        ("Rotation of the head, degrees", "degrees", turns),
        ("Distance from the camera, m", "m", [Series("distance", t, curves.depth_m)]),
        ("Distance of the irises, mm", "mm", [Series("irises", t, curves.iris_mm)]),
    ]
    return [Chart(title, line_chart(series, _axes(unit, t, curves.without_face))) for title, unit, series in drawn]


def _axes(unit: str, seconds: np.ndarray, without_face: Sequence[int]) -> Axes:
    last = len(seconds) - 1
    spans = tuple((float(seconds[one]), float(seconds[min(one + 1, last)])) for one in without_face)
    return Axes("time, s", unit, _WIDTH, _HEIGHT, shaded=spans)
