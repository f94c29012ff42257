"""From sequences to a run, as the command line runs it."""

from mien.avatar import MethodConfig
from mien.face import FaceModel, load_face_model
from mien.locks import read_beside_writers
from mien.progress import say
from mien.training import (
    Sequence,
    TrainSettings,
    check_untouched,
    read_sequence,
    read_training_summary,
    train,
)
from mien.training.trainer import check_trackings
from mien.workspace import Workspace


def run_training_stage(
    workspace: Workspace, sequences: list[str], run: str, method: MethodConfig, settings: TrainSettings
) -> None:
    """Train a run on some sequences of the workspace. An interrupted run continues; a finished run stays as it is."""
    run_dir = workspace.run_dir(run)
    check_untouched(run_dir)
    folders = [workspace.sequence_dir(name) for name in sequences]

    def read_together() -> tuple[list[Sequence], FaceModel]:
        read = [read_sequence(folder) for folder in folders]
        face_model = load_face_model(read[0].tracking.face_model)
        check_trackings(read, face_model)
        return read, face_model

    loaded, face_model = read_beside_writers(read_together, [folder / "tracking" for folder in folders], folders)
    train(loaded, face_model, method, settings, run_dir)
    summary = read_training_summary(run_dir)
    say(f"{run}: {summary['gaussians']:,} Gaussians after {summary['steps']:,} steps in {summary['seconds']:.0f} s")
