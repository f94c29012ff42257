"""A tracked sequence of a workspace in the layout of another laboratory, as `mien export --format` writes it."""

from dataclasses import replace
from pathlib import Path

from mien.datasets.layouts.filmed import filmed_frames
from mien.datasets.layouts.layout import Layout, MatteKind
from mien.datasets.layouts.writing import write_layout
from mien.disk.config import decode
from mien.disk.workspace import Workspace
from mien.errors import UserError
from mien.machine.progress import say
from mien.pipeline.train import fill_in_own_split, read_together
from mien.training.run import read_run_config
from mien.training.settings import Split, TrainSettings
from mien.training.splits.own import OWN_SPLIT, read_own_split


def settings_of(workspace: Workspace, sequence: str, run: str | None, split: Split | None) -> TrainSettings:
    """Return what is held out: as a run holds it out, or by a split, or by the split of the dataset or the default."""
    if run is not None:
        folder = workspace.run_dir(run)
        config = read_run_config(folder)
        names = [entry["sequence"] for entry in config["data"]]
        if sequence not in names:
            raise UserError(f"--run {run}: was trained on {', '.join(names)}, not on {sequence}; give another --run")
        settings = decode(TrainSettings, config["settings"], str(folder / "config.json"), "train it again")
        if sequence in settings.held_out_sequences:
            raise UserError(
                f"--run {run}: holds out the whole sequence {sequence}, so nothing of it is trained on; give another "
                "--sequence"
            )
        return replace(settings, held_out_sequences=())
    own = read_own_split(workspace.sequence_dir(sequence))
    chosen = split or (OWN_SPLIT if own is not None else TrainSettings().split)
    settings = replace(TrainSettings(), split=chosen)
    return fill_in_own_split(workspace, settings, [sequence]) if chosen == OWN_SPLIT else settings


def export_capture(
    workspace: Workspace, sequence: str, layout: Layout, out: Path, settings: TrainSettings, mattes: MatteKind
) -> None:
    """Write a tracked sequence into a new folder, and report it."""
    (read,), face_model = read_together(workspace, [sequence])
    filmed = filmed_frames(read, face_model, settings, mattes)
    say(f"{out}: {write_layout(out, filmed, layout)}")
