"""Drawing speed and memory at the sizes of Table 3 of the supplement."""

import numpy as np
import torch

from mien import _native
from mien.disk.files import file_digest
from mien.lab.analysis.context import Context
from mien.lab.analysis.drawing import measure_drawing
from mien.lab.analysis.result import Chart, PartResult, Picture, Table
from mien.lab.benchmarking.timing import format_machine, measure_machine
from mien.machine.progress import track_progress
from mien.machine.terminal import counted
from mien.media.pictures import to_uint8
from mien.pages.plots import Axes, Series
from mien.render import rasterize

TABLE_3 = {(225, 401): 187, (550, 802): 187, (1100, 1604): 156, (2200, 3208): 95, (4400, 6416): 36}
"""Width and height in pixels (the paper writes height x width) -> frames per second, for subject 306."""


def speed(context: Context) -> PartResult:
    """Frames per second, at all threads, and memory at the five sizes of Table 3. Each row is measured once."""
    avatar = file_digest(context.run_dir / "avatar" / "avatar.safetensors")
    sizes = list(TABLE_3)
    machine = format_machine(measure_machine())
    rows = []
    for width, height in track_progress(sizes, "speed", len(sizes)):
        key = [avatar, width, height, context.options.seconds, _native.thread_count()]
        camera = context.camera.fitted(width, height)
        rows.append(
            context.kept(
                f"speed-{width}x{height}",
                key,
                lambda camera=camera: measure_drawing(context.avatar, camera, context.options.seconds),
            )
        )
    for row in rows:
        row["fps"] = round(1e3 / max(row["draw_ms"] + row["pose_ms"], 1e-6), 2)
        row["paper_fps"] = TABLE_3[row["width"], row["height"]]
    cells = tuple(
        (
            f"{row['width']}x{row['height']}", row["fps"], row["paper_fps"], round(row["draw_ms"], 1),
            round(row["pose_ms"], 1), row["pictures"], round(row["peak_mb"] - row["before_mb"]), round(row["peak_mb"]),
        )
        for row in rows
    )  # fmt: skip
    columns = (
        "Width x height", "Frames/s", "Paper", "Drawing, ms", "Posing, ms", "Pictures timed", "Memory added, MB",
        "Memory in all, MB",
    )  # fmt: skip
    count, threads = len(context.avatar.gaussian_store()), rows[0]["threads"]
    second = rows[1]
    slower = rows[0]["fps"] / max(rows[-1]["fps"], 1e-6)
    return PartResult(
        {"machine": machine, "gaussians": count, "threads": threads, "rows": rows},
        (
            f"{count:,} Gaussians at 550x802, with {counted(threads, 'thread')} of a CPU: {second['fps']:.1f} "
            f"frames/s; the paper reports {second['paper_fps']} on a GPU. From 225x401 to 4400x6416, pixels grow 313 "
            f"times and a frame takes {slower:.0f} times as long (paper: {187 / 36:.1f} times).",
        ),
        (Table(columns, cells, machine),),
        (_chart(rows),),
        (_picture(context),),
        notes=(
            "A frame is posed and drawn from the camera of training, fitted into the picture, over white. Times are "
            f"medians; each row took about {context.options.seconds:g} s.",
            "The paper does not name the GPU of Table 3. Its model has about 100,000 Gaussians.",
            "Memory added is the largest memory of the process while it draws, less its memory before.",
        ),
    )


def _chart(rows: list[dict]) -> Chart:
    pixels = np.log10(np.array([row["width"] * row["height"] for row in rows]) / 1e6)
    ours, paper = (np.log10(np.array([row[name] for row in rows], np.float64)) for name in ("fps", "paper_fps"))
    return Chart(
        "speed",
        "Table 3: frames per second over the size of the picture",
        (Series("this run, on a CPU", pixels, ours), Series("paper, on a GPU", pixels, paper, "second")),
        Axes("log10 of megapixels: -1 is 225x401, 1.4 is 4400x6416", "log10 of frames/s"),
        "Both axes are logarithmic: 0 is one frame per second (one megapixel), 1 is ten, 2 is a hundred.",
    )


@torch.no_grad()
def _picture(context: Context) -> Picture:
    gaussians = context.avatar.pose(context.avatar.subject).gaussians.timestep(0)
    image = rasterize(gaussians, context.camera.fitted(550, 802), torch.ones(3)).image
    return Picture("speed-picture", to_uint8(image), "What is drawn, at 550x802.")
