"""Charts as png files, in the colours of the pages (`mien.pages.plots` draws the same charts as SVG)."""

from pathlib import Path

from mien.disk.files import write_atomically
from mien.lab.analysis.result import Chart

_COLORS = {"main": "#2563c9", "second": "#c2571a", "quiet": "#8c8b84"}
_INK, _GRID = "#6a6963", "#ecebe6"


def write_chart(path: Path, chart: Chart) -> None:
    """Write a chart as a png of about 1,100 pixels width."""
    from matplotlib.figure import Figure

    axes = chart.axes
    figure = Figure(figsize=(7.4, 7.4 * axes.height / axes.width), layout="constrained")
    plot = figure.subplots()
    for one in chart.series:
        (line,) = plot.plot(one.x, one.y, label=one.label, color=_COLORS[one.style])
        line.set_linewidth(1.0 if one.style == "quiet" else 2.0)
        if one.points:
            line.set(linestyle="none", marker="o", markersize=3)
    for left, right in axes.shaded:
        plot.axvspan(left, right, color=_COLORS["main"], alpha=0.1, linewidth=0)
    if axes.from_zero:
        plot.set_ylim(bottom=0)
    plot.set_title(chart.title, fontsize=11, loc="left")
    plot.set_xlabel(axes.x_label, color=_INK)
    plot.set_ylabel(axes.y_label, color=_INK)
    plot.grid(color=_GRID)
    plot.set_axisbelow(True)
    plot.tick_params(colors=_INK)
    plot.spines[["top", "right"]].set_visible(False)
    if len(chart.series) > 1:
        plot.legend(fontsize=8, frameon=False)
    write_atomically(path, lambda part: figure.savefig(part, format="png", dpi=150))
