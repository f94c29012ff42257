"""HTML from templates, names of the figures in tables, and line charts as inline SVG without scripts or fonts.

Each room keeps its templates in a folder `templates/`; `mien/templates` has what all pages share.

A page is one file that can be sent around. It needs no network and no scripts, and works in light, in dark and on
paper. The templates escape every text. Python code prepares what they show. The page's CSS gives charts their colours.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from jaxtyping import Float
from markupsafe import Markup, escape

from mien.disk.files import write_atomically

LIVING_PAGE = "me.html"
"""Name of the living avatar's page in a workspace."""
METRICS = ("psnr", "ssim", "l1", "perceptual")
"""Names of the figures of scored pictures."""
COLUMNS = (
    ("psnr", "PSNR, dB", 2, True), ("ssim", "SSIM", 3, True), ("l1", "L1", 4, False),
    ("perceptual", "ST-LPIPS", 3, False),
)  # fmt: skip
"""Metric, heading, number of digits, whether higher is better."""
_LEFT, _RIGHT, _TOP, _BOTTOM = 46, 12, 10, 34
_TITLE, _LEGEND = 26, 16
"""Heights of a title, and of a line of the legend below a chart, in files."""
_MAX_POINTS = 400


def render(template: str, **content: object) -> Markup:
    """HTML from a template, which is named by its path in `mien`. Text in `content` is escaped, `Markup` is not."""
    return Markup(_templates().get_template(template).render(content))


def with_code(text: str) -> Markup:
    """The text as HTML, with text between backticks as code. Templates know it as the filter `with_code`."""
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(escape(text))))


@cache
def _templates() -> jinja2.Environment:
    folder = files("mien")
    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(lambda name: folder.joinpath(name).read_text(encoding="utf-8")),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["with_code"] = with_code
    # The colours of `mien.media.pictures.heat_colors` from 0 to its limit, without OpenCV.
    environment.globals["heat_gradient"] = (
        "linear-gradient(90deg,rgb(0, 0, 4), rgb(66, 10, 104), rgb(147, 38, 103), rgb(221, 81, 58), rgb(252, 165, 10), "
        "rgb(252, 255, 164))"
    )
    return environment


@dataclass(frozen=True, eq=False)
class Series:
    """A line or a cloud of points."""

    label: str
    x: Float[np.ndarray, " n"]
    y: Float[np.ndarray, " n"]
    """NaN breaks the line."""
    style: str = "main"
    """CSS class that sets the colour: `main`, `second`, `third`, `fourth`, `quiet`."""
    points: bool = False
    """Whether to draw dots with tooltips instead of a line."""


@dataclass(frozen=True)
class Axes:
    """Labels, size and shading of a chart."""

    x_label: str
    y_label: str
    width: int = 420
    """Width in the drawing's own units, which the page scales."""
    height: int = 220
    from_zero: bool = False
    """Whether the y axis starts at 0."""
    shaded: tuple[tuple[float, float], ...] = ()
    """Spans of x with a tinted background."""
    logarithmic: bool = False
    """Whether both axes are logarithmic. All values are then positive."""


def line_chart(series: Sequence[Series], axes: Axes) -> Markup:
    """An <svg> of some series over common axes. Series without a finite value are left out."""
    drawn = _finite(series)
    if not drawn:
        return Markup('<p class="note">There are no values to draw.</p>')
    return render("templates/chart.html", **_content(drawn, axes))


def write_chart(path: Path, charts: Sequence[tuple[str, Sequence[Series], Axes]]) -> None:
    """Write charts (title, series, axes) as one .svg file, one below the other, in the colours of the pages."""
    rows, top = [], 0
    for title, series, axes in charts:
        content = _content(_finite(series), axes)
        legend = content["series"] if len(content["series"]) > 1 else []
        rows.append({**content, "title": title, "top": top, "legend": legend})
        top += axes.height + _TITLE + _LEGEND * len(legend) + 8
    width = max(axes.width for _, _, axes in charts)
    text = render("templates/chart.svg", rows=rows, width=width, height=top, title_height=_TITLE, line_height=_LEGEND)
    write_atomically(path, lambda aside: aside.write_text(text, encoding="utf-8"))


def _finite(series: Sequence[Series]) -> list[Series]:
    return [one for one in series if np.isfinite(one.y).any()]


def _content(series: Sequence[Series], axes: Axes) -> dict[str, Any]:
    """Charts that the templates draw of series that each have a finite value."""
    if axes.logarithmic:
        series = [replace(one, x=np.log10(one.x), y=np.log10(one.y)) for one in series]
    x_range = _range(np.concatenate([one.x for one in series]))
    y_range = _padded(_range(np.concatenate([one.y for one in series])), axes.from_zero)
    plot = _Plot(axes, x_range, y_range)
    ticks = _log_ticks if axes.logarithmic else _ticks
    return {
        "axes": axes,
        "about": f"{axes.y_label} over {axes.x_label}: " + ", ".join(one.label for one in series),
        "left": _LEFT,
        "bands": [plot.band(span) for span in axes.shaded],
        "grid": [plot.grid_line(tick) for tick in ticks(*y_range, 5)],
        "ticks": [plot.x_tick(tick) for tick in ticks(*x_range, 6)],
        "series": [plot.drawn(one) for one in series],
    }


def thin(x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"]) -> tuple[np.ndarray, np.ndarray]:
    """A long curve as the means of a limited number of bins, for a small file and a smooth line."""
    if len(x) <= _MAX_POINTS:
        return x, y
    bins = np.array_split(np.arange(len(x)), _MAX_POINTS)
    return np.array([x[b].mean() for b in bins]), np.array([y[b].mean() for b in bins])


class _Plot:
    """Maps values to positions in the drawing."""

    def __init__(self, axes: Axes, x_range: tuple[float, float], y_range: tuple[float, float]) -> None:
        self._axes, self._x_range, self._y_range = axes, x_range, y_range

    def _x(self, value: float) -> float:
        low, high = self._x_range
        return _LEFT + (value - low) / (high - low) * (self._axes.width - _LEFT - _RIGHT)

    def _y(self, value: float) -> float:
        low, high = self._y_range
        return self._axes.height - _BOTTOM - (value - low) / (high - low) * (self._axes.height - _TOP - _BOTTOM)

    def band(self, span: tuple[float, float]) -> dict[str, Any]:
        left, right = (self._x(min(max(value, self._x_range[0]), self._x_range[1])) for value in span)
        height = self._axes.height - _TOP - _BOTTOM
        return {"x": f"{left:.1f}", "y": _TOP, "width": f"{max(right - left, 1):.1f}", "height": height}

    def grid_line(self, value: float) -> dict[str, Any]:
        y, right = self._y(value), self._axes.width - _RIGHT
        return {"left": _LEFT, "right": right, "y": f"{y:.1f}", "text_y": f"{y + 3.5:.1f}", "text": self._text(value)}

    def x_tick(self, value: float) -> dict[str, Any]:
        return {"x": f"{self._x(value):.1f}", "y": self._axes.height - _BOTTOM + 14, "text": self._text(value)}

    def _text(self, value: float) -> str:
        return _number(10**value if self._axes.logarithmic else value)

    def drawn(self, series: Series) -> dict[str, Any]:
        shape = {"dots": self._dots(series)} if series.points else {"path": self._path(series)}
        return {"label": series.label, "style": series.style, **shape}

    def _path(self, series: Series) -> str:
        x, y = thin(series.x, series.y)
        parts, pen = [], "M"
        for a, b in zip(x.tolist(), y.tolist(), strict=True):
            if not math.isfinite(b):
                pen = "M"
                continue
            parts.append(f"{pen}{self._x(a):.1f} {self._y(b):.1f}")
            pen = "L"
        return "".join(parts)

    def _dots(self, series: Series) -> list[tuple[str, str, str]]:
        """Position and text of each point."""
        return [
            (f"{self._x(a):.1f}", f"{self._y(b):.1f}", f"{_number(a)}: {b:.2f}")
            for a, b in zip(series.x.tolist(), series.y.tolist(), strict=True)
            if math.isfinite(b)
        ]


def _range(values: np.ndarray) -> tuple[float, float]:
    finite = values[np.isfinite(values)]
    low, high = float(finite.min()), float(finite.max())
    return (low, high) if high > low else (low - 0.5, high + 0.5)


def _padded(limits: tuple[float, float], from_zero: bool) -> tuple[float, float]:
    low, high = limits
    margin = 0.06 * (high - low)
    return (min(0.0, low), high + margin) if from_zero else (low - margin, high + margin)


def _ticks(low: float, high: float, about: int) -> list[float]:
    """Round numbers between two limits, in steps of 1, 2 or 5 times a power of ten."""
    rough = (high - low) / about
    power = 10.0 ** math.floor(math.log10(rough))
    step = min((factor * power for factor in (1, 2, 5, 10)), key=lambda size: abs(size - rough))
    return [index * step for index in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)]


def _log_ticks(low: float, high: float, about: int) -> list[float]:
    """Logarithms of 1, 2 and 5 times powers of ten between two limits, or of the powers alone if those are enough."""
    powers = range(math.floor(low), math.ceil(high) + 1)
    factors = (1,) if high - low >= about else (1, 2, 5)
    every = [power + math.log10(factor) for power in powers for factor in factors]
    return [tick for tick in every if low - 1e-9 <= tick <= high + 1e-9]


def _number(value: float) -> str:
    """The short text of a tick: 1200 becomes 1.2k, and there are no trailing zeros."""
    if abs(value) >= 1000:
        return f"{value / 1000:g}k"
    return f"{value:.4g}"
