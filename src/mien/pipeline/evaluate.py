"""From a run to metrics, as the command line runs it."""

from collections.abc import Callable
from collections.abc import Sequence as Items
from pathlib import Path
from typing import Any

from mien.disk.reading import check_tree, expect_whole
from mien.disk.workspace import Workspace, open_workspace
from mien.errors import UserError
from mien.evaluation.compare import Comparison, compare_runs
from mien.evaluation.compare_report import write_comparison
from mien.evaluation.evaluate import evaluate, is_evaluated
from mien.evaluation.metrics_file import REMEDY, read_metrics
from mien.evaluation.protocols import EvaluationSettings
from mien.evaluation.text import dataset_line, driven_line, protocol_lines
from mien.machine.progress import say
from mien.training.run import read_run_config
from mien.training.settings.splits import DRIVING, NAMED_SPLIT, driving_sequences


def run_evaluation_stage(
    workspace: Workspace,
    run: str,
    settings: EvaluationSettings | None = None,
    drivers: Items[Path] = (),
    *,
    again: bool = True,
) -> dict[str, Any]:
    """Evaluate a run on its held-out frames; return the content of metrics.json.

    Drivers are workspaces or folders of sequences, which drive the avatar as well. Without `again`, what was scored
    with the same settings is only read.
    """
    run_dir = workspace.run_dir(run)
    folders = run_sequences(workspace, run_dir)
    if not again and not drivers and is_evaluated(run_dir, folders, settings):
        metrics = read_metrics(run_dir)
    else:
        named = read_run_config(run_dir)["settings"]["split"] == NAMED_SPLIT
        metrics = evaluate(run_dir, folders, settings, driver_folders(drivers, driving_sequences if named else list))
    with expect_whole(run_dir / "metrics.json", REMEDY):
        for name, entry in metrics["protocols"].items():
            for line in [driven_line(entry)] if name == "cross_reenactment" else protocol_lines(name, entry):
                say(line)
            if "dataset_protocol" in entry:
                say(dataset_line(entry))
    say(f"Look at {run_dir / 'report.html'}")
    return metrics


def run_sequences(workspace: Workspace, run_dir: Path) -> list[Path]:
    """The folders of the sequences that a run was trained with, in its order."""
    return [workspace.sequence_dir(entry["sequence"]) for entry in read_run_config(run_dir)["data"]]


def run_comparison(workspaces: Items[Workspace], run: str | None, out: Path | None) -> Comparison:
    """Compare the runs of some workspaces and write the page to `out`, by default into the first workspace."""
    roots = [workspace.root.resolve() for workspace in workspaces]
    by_name = len({root.name for root in roots}) == len(roots)
    run_dirs: dict[str, Path] = {}
    sequence_dirs: dict[Path, list[Path]] = {}
    for workspace, root in zip(workspaces, roots, strict=True):
        names = workspace.run_names() if run is None else [workspace.pick_run(run)]
        for name in names:
            label = name if len(roots) == 1 else f"{root.name if by_name else root}/{name}"
            run_dirs[label] = workspace.run_dir(name)
            sequence_dirs[run_dirs[label]] = run_sequences(workspace, run_dirs[label])
    comparison = compare_runs(run_dirs)
    path = out or workspaces[0].root / "compare.html"
    write_comparison(path, comparison, sequence_dirs)
    say(f"Look at {path}")
    return comparison


def driver_folders(drivers: Items[Path], chosen: Callable[[list[str]], list[str]]) -> list[Path]:
    """The folders of the given sequences, and of the chosen sequences in the given workspaces."""
    folders: list[Path] = []
    for driver in drivers:
        if (driver / "tracking").is_dir():
            check_tree(driver)
            folders.append(driver)
            continue
        workspace = open_workspace(driver)
        names = chosen(workspace.sequence_names())
        if not names:
            raise UserError(
                f"--drivers {driver}: has no sequence {DRIVING}, which drives avatars under --split {NAMED_SPLIT}; "
                f"capture it, or give the folder of another one, {driver}/sequences/NAME"
            )
        folders += [workspace.sequence_dir(name) for name in names]
    return folders
