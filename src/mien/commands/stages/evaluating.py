"""Run -> metrics, as the command line runs it."""

from typing import Any

from mien.evaluation.evaluate import evaluate
from mien.progress import say
from mien.training import read_run_config
from mien.workspace import Workspace


def evaluation_stage(workspace: Workspace, run: str) -> dict[str, Any]:
    """Evaluate a run on what it held out; returns the content of metrics.json."""
    run_dir = workspace.run_dir(run)
    metrics = evaluate(
        run_dir, [workspace.sequence_dir(entry["sequence"]) for entry in read_run_config(run_dir)["data"]]
    )
    for name, entry in metrics["protocols"].items():
        baselines = ", ".join(f"{key} {value['psnr']:.2f}" for key, value in entry["baselines"].items())
        say(
            f"{name} ({entry['split']}, {entry['frames']} frames): PSNR {entry['psnr']:.2f} dB whole frame, "
            f"{entry['head']['psnr']:.2f} head crop; baselines: {baselines}"
        )
    say(f"Look at {run_dir / 'report.html'}")
    return metrics
