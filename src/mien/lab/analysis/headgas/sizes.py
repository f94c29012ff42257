"""Time of a frame against the size of the picture (Fig. 4 of the supplement)."""

import numpy as np

from mien import _native
from mien.disk.files import file_digest
from mien.lab.analysis.context import Context
from mien.lab.analysis.drawing import measure_drawing
from mien.lab.analysis.headgas.trained import busy_face
from mien.lab.analysis.result import Chart, PartResult, Table
from mien.lab.benchmarking.timing import format_machine, measure_machine
from mien.machine.progress import track_progress
from mien.machine.terminal import counted
from mien.pages.plots import Axes, Series

PAPER = {512: 4.0, 1024: 5.0, 2048: 8.6}
"""Side of a square picture in pixels -> mean milliseconds of a frame, for 21,000 to 37,000 Gaussians on a GPU."""


def sizes(context: Context) -> PartResult:
    """Milliseconds of a frame with a changed expression, at all threads. Each row is measured once."""
    avatar = file_digest(context.run_dir / "avatar" / "avatar.safetensors")
    face, machine, rows = busy_face(context), format_machine(measure_machine()), []
    for side in track_progress(list(PAPER), "sizes", len(PAPER)):
        key = [avatar, side, context.options.seconds, _native.thread_count()]
        camera = context.camera.fitted(side, side)
        rows.append(
            context.kept(
                f"sizes-{side}",
                key,
                lambda camera=camera: measure_drawing(context.avatar, camera, context.options.seconds, face),
            )
        )
    for row in rows:
        row["frame_ms"] = round(row["draw_ms"] + row["pose_ms"], 3)
        row["paper_ms"] = PAPER[row["width"]]
    cells = tuple(
        (
            f"{row['width']}x{row['height']}", round(row["frame_ms"], 1), row["paper_ms"], round(row["pose_ms"], 1),
            round(row["draw_ms"], 1), row["pictures"],
        )
        for row in rows
    )  # fmt: skip
    heading = ("Width x height", "Frame, ms", "Paper, ms", "Features and network, ms", "Drawing, ms", "Pictures timed")
    count, threads = len(context.avatar.gaussian_store()), rows[0]["threads"]
    slower = rows[-1]["frame_ms"] / max(rows[0]["frame_ms"], 1e-6)
    times, papers = list(PAPER.values())[-1] / next(iter(PAPER.values())), (max(PAPER) // min(PAPER)) ** 2
    return PartResult(
        {"machine": machine, "gaussians": count, "threads": threads, "rows": rows, "slower": round(slower, 3)},
        (
            f"{count:,} Gaussians, {counted(threads, 'thread')} of a CPU: {rows[0]['frame_ms']:.1f} ms at "
            f"{min(PAPER)}x{min(PAPER)}. With {papers} times the pixels, a frame takes {slower:.1f} times as long "
            f"(paper, on a GPU: {times:.1f} times).",
        ),
        (Table(heading, cells, machine),),
        (_chart(rows),),
        notes=(
            "A frame is posed at an expression in which no coefficient is 0, and drawn from the camera of training, "
            "fitted into the picture, over white. Times are medians; each row took about "
            f"{context.options.seconds:g} s.",
        ),
    )


def _chart(rows: list[dict]) -> Chart:
    side = np.array([row["width"] for row in rows], np.float64)
    ours, paper = (np.array([row[name] for row in rows], np.float64) for name in ("frame_ms", "paper_ms"))
    series = (
        Series("this run, on a CPU", side, ours / max(ours[0], 1e-6)),
        Series("paper, on a GPU", side, paper / paper[0], "second"),
    )
    axes = Axes("side of the picture, pixels", "times the smallest", from_zero=True)
    return Chart("sizes", "Fig. 4: time of a frame, relative to the smallest picture", series, axes)
