"""Time of training and of a frame, beside the paper's (Table 4 of the supplement)."""

from mien import _native
from mien.disk.files import file_digest
from mien.lab.analysis.context import Context
from mien.lab.analysis.drawing import measure_drawing
from mien.lab.analysis.result import PartResult, Table
from mien.lab.benchmarking.timing import format_machine, measure_machine
from mien.machine.terminal import counted

PAPER = {
    "NeRFace": (48.0, 2000.0),
    "IMavatar": (54.0, 38_000.0),
    "PointAvatar": (11.0, 50.0),
    "MonoGaussianAvatar": (9.0, 30.0),
}
"""Hours of training and milliseconds of a frame on one GPU, in the paper's Table 4."""
SIDE = 512


def times(context: Context) -> PartResult:
    """Minutes of this run's training, and milliseconds of a frame with the networks and with the baked avatar."""
    machine, avatar = format_machine(measure_machine()), context.avatar
    camera, digest = context.camera.fitted(SIDE, SIDE), file_digest(context.run_dir / "avatar" / "avatar.safetensors")
    rows = {}
    for name, training in (("networks", True), ("baked", False)):
        avatar.train(training)
        rows[name] = context.kept(
            f"times-{name}",
            [digest, context.options.seconds, _native.thread_count()],
            lambda: measure_drawing(avatar, camera, context.options.seconds),
        )
    avatar.eval()
    frames = {name: round(row["draw_ms"] + row["pose_ms"], 3) for name, row in rows.items()}
    hours, count = context.summary["seconds"] / 3600, len(avatar.gaussian_store())
    threads = counted(_native.thread_count(), "thread")
    cells = [
        (
            f"this run, {name}",
            round(hours, 3),
            round(frames[name], 1),
            round(row["pose_ms"], 1),
            round(row["draw_ms"], 1),
        )
        for name, row in rows.items()
    ]
    cells += [(f"paper: {name}", hour, frame, None, None) for name, (hour, frame) in PAPER.items()]
    return PartResult(
        {
            "machine": machine,
            "threads": _native.thread_count(),
            "gaussians": count,
            "training_hours": round(hours, 4),
            "frame_ms": frames,
            "rows": rows,
        },
        (
            f"{count:,} Gaussians, {threads} of a CPU: training took {60 * hours:.1f} min, and a frame of the baked "
            f"avatar takes {frames['baked']:.1f} ms at {SIDE}x{SIDE} (paper, on a GPU: 9 h and 30 ms).",
        ),
        (Table(("", "Training, h", "Frame, ms", "Posing, ms", "Drawing, ms"), tuple(cells), machine),),
        notes=(
            "A frame is the person at rest, posed and drawn from the camera of training over white. Times are medians.",
            "`mien evaluate`, `mien render` and `mien drive` pose the baked avatar; training runs the networks.",
        ),
    )
