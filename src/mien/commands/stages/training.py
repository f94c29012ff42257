"""Sequences -> a run, as the command line runs it."""

from mien.avatar import MethodConfig
from mien.face import load_face_model
from mien.progress import say
from mien.training import TrainSettings, read_sequence, read_training_summary, train
from mien.workspace import Workspace


def training_stage(
    workspace: Workspace, sequences: list[str], run: str, method: MethodConfig, settings: TrainSettings
) -> None:
    """Train a run on some sequences of the workspace; a finished or interrupted one goes on where it was."""
    run_dir = workspace.run_dir(run)
    loaded = [read_sequence(workspace.sequence_dir(name)) for name in sequences]
    train(loaded, load_face_model(loaded[0].tracking.face_model), method, settings, run_dir)
    summary = read_training_summary(run_dir)
    say(f"{run}: {summary['gaussians']:,} Gaussians after {summary['steps']:,} steps in {summary['seconds']:.0f} s")
