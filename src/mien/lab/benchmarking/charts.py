"""Charts of benchmark rows."""

from collections.abc import Sequence
from pathlib import Path

from mien.disk.files import write_atomically
from mien.lab.benchmarking.timing import BenchmarkRow, Machine, format_machine


def write_scaling_chart(path: Path, rows: Sequence[BenchmarkRow], machine: Machine) -> None:
    """Write a log-log chart of milliseconds over the number of Gaussians: a line per size, a panel per kind of row.

    The file's ending (.png, .svg, .pdf) decides its format.
    """
    from matplotlib.figure import Figure

    names = list(dict.fromkeys(row.name for row in rows))
    figure = Figure(figsize=(5.2 * len(names), 4.2), layout="constrained")
    for panel, name in zip(figure.subplots(1, len(names), squeeze=False)[0], names, strict=True):
        own = [row for row in rows if row.name == name]
        styles = dict(zip(sorted({row.threads for row in own}), ("--", "-"), strict=False))
        for index, size in enumerate(dict.fromkeys((row.width, row.height) for row in own)):
            for threads, style in styles.items():
                line = [row for row in own if (row.width, row.height, row.threads) == (*size, threads)]
                label = f"{size[0]}x{size[1]}, {threads} thread{'s' if threads > 1 else ''}"
                counts, times = [row.gaussians for row in line], [row.min_ms for row in line]
                panel.loglog(counts, times, style + "o", color=f"C{index}", markersize=3, label=label)
        panel.set(title=name.replace("_", " "), xlabel="Gaussians", ylabel="milliseconds (minimum)")
        panel.grid(alpha=0.3, which="both")
        panel.legend(fontsize=7)
    figure.suptitle(format_machine(machine), fontsize=8)
    write_atomically(path, lambda part: figure.savefig(part, format=path.suffix.lstrip("."), dpi=130))
