"""`evaluate`: a trained run in, metrics.json and report.html out."""

from collections.abc import Sequence as Items
from pathlib import Path
from typing import Any

from mien.errors import UserError
from mien.evaluation.load import load_experiments
from mien.evaluation.protocols import EvaluationSettings, evaluate_frames, protocol_content
from mien.evaluation.report import RunRecord, write_report
from mien.storage import read_json, write_json
from mien.training import read_curves, read_run_config, read_training_summary

_FORMAT, _VERSION = "mien.metrics", 1


def evaluate(run_dir: Path, sequence_dirs: Items[Path], settings: EvaluationSettings | None = None) -> dict[str, Any]:
    """Score a run on its held-out frames; writes metrics.json and report.html into its folder.

    Args:
        run_dir: A finished run.
        sequence_dirs: The folders of the sequences it was trained on, in that order.
        settings: What to compute; None for the defaults.

    Returns:
        The content of metrics.json: `protocols` and `training`.

    Raises:
        UserError: the run is not finished, the sequences are others, or nothing was held out.
    """
    settings = settings or EvaluationSettings()
    summary = read_training_summary(run_dir)
    experiments = load_experiments(run_dir, sequence_dirs)
    if not experiments:
        raise UserError(f"{run_dir}: nothing was held out, so nothing can be scored; train with the split `blocks`")
    results = {name: (one, evaluate_frames(one, settings)) for name, one in experiments.items()}
    protocols = {name: protocol_content(*result, settings) for name, result in results.items()}
    content = {"protocols": protocols, "training": summary}
    run = RunRecord(run_dir.name, read_run_config(run_dir), summary, read_curves(run_dir))
    write_report(run_dir / "report.html", run, protocols, results)
    write_json(run_dir / "metrics.json", _FORMAT, _VERSION, content)
    return content


def read_metrics(run_dir: Path) -> dict[str, Any]:
    """What `evaluate` wrote.

    Raises:
        UserError: the run was not evaluated.
    """
    content = read_json(run_dir / "metrics.json", _FORMAT, _VERSION)
    return {name: value for name, value in content.items() if name not in ("format", "version")}
