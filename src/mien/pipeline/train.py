"""From sequences to a run, as the command line runs it."""

from contextlib import ExitStack

from mien.avatar.settings import MethodConfig
from mien.capture.store import read_capture
from mien.disk.locks import read_beside_writers
from mien.disk.workspace import Workspace
from mien.face.loading import load_face_model
from mien.face.model import FaceModel
from mien.machine.progress import say
from mien.machine.terminal import counted
from mien.pipeline.live_view import LiveView
from mien.training.footage.sequence import Sequence, read_sequence
from mien.training.run import check_untouched, is_finished, read_training_summary
from mien.training.settings import TrainSettings
from mien.training.splits.benchmark import with_benchmark_split
from mien.training.splits.named import NamedSplit, with_named_split
from mien.training.splits.own import read_own_split, with_own_split
from mien.training.trainer import check_trackings, train


def fill_in_named_split(workspace: Workspace, settings: TrainSettings, split: NamedSplit) -> TrainSettings:
    """The settings with what a named split holds out, after a message that says so."""
    cameras = {name: read_capture(workspace.sequence_dir(name) / "capture").camera_ids for name in split.sequences}
    settings = with_named_split(settings, split, cameras)
    left_out = f"; not used: {', '.join(split.left_out)}" if split.left_out else ""
    say(
        f"subject {split.subject} of GaussianAvatars: held out are the sequence {split.held_out} and camera "
        f"{', '.join(settings.held_out_cameras)}{left_out}"
    )
    return settings


def fill_in_benchmark_split(workspace: Workspace, settings: TrainSettings, names: list[str]) -> TrainSettings:
    """The settings with what the NeRSemble benchmark holds out, after a message that says so."""
    cameras = {name: read_capture(workspace.sequence_dir(name) / "capture").camera_ids for name in names}
    settings = with_benchmark_split(settings, names, cameras)
    parts = {"sequences": settings.held_out_sequences, "cameras": settings.held_out_cameras}
    words = [f"the {kind} {', '.join(part)}" for kind, part in parts.items() if part]
    say(f"the benchmark's split: held out are {' and '.join(words)}")
    return settings


def fill_in_own_split(workspace: Workspace, settings: TrainSettings, names: list[str]) -> TrainSettings:
    """The settings with the sequences and cameras that the dataset's authors held out, after a message that says so."""
    splits = {name: read_own_split(workspace.sequence_dir(name)) for name in names}
    timesteps = {name: read_capture(workspace.sequence_dir(name) / "capture").timesteps for name in names}
    settings = with_own_split(settings, splits, timesteps)
    parts = [counted(len(settings.held_out_sequences), "sequence"), counted(len(settings.held_out_cameras), "camera")]
    frames = sum(
        split is not None and name not in settings.held_out_sequences and split.holds_out(timestep)
        for name, split in splits.items()
        for timestep in range(timesteps[name])
    )
    say(f"the dataset's own split: held out are {', '.join(parts)}, and {counted(frames, 'timestep')} of the others")
    return settings


def read_together(workspace: Workspace, names: list[str]) -> tuple[list[Sequence], FaceModel]:
    """Read sequences that were tracked together, and the face model that fits them."""
    folders = [workspace.sequence_dir(name) for name in names]

    def read() -> tuple[list[Sequence], FaceModel]:
        loaded = [read_sequence(folder) for folder in folders]
        face_model = load_face_model(loaded[0].tracking.face_model)
        check_trackings(loaded, face_model)
        return loaded, face_model

    return read_beside_writers(read, [folder / "tracking" for folder in folders], folders)


def run_training_stage(
    workspace: Workspace,
    sequences: list[str],
    run: str,
    method: MethodConfig,
    settings: TrainSettings,
    view: bool = False,
) -> None:
    """Train a run on some sequences of the workspace. An interrupted run continues; a finished run stays as it is.

    With `view`, browsers can watch it.
    """
    run_dir = workspace.run_dir(run)
    check_untouched(run_dir)
    loaded, face_model = read_together(workspace, sequences)
    _tell_covered(loaded, settings)
    with ExitStack() as closing:
        if not is_finished(run_dir):
            say(f"{run}: looks for what the pictures show of the head, before the first step")
        live = LiveView(run, loaded[0].tracking.cameras[0]) if view else None
        if live is not None:
            closing.callback(live.close)
        train(loaded, face_model, method, settings, run_dir, watch=live)
    summary = read_training_summary(run_dir)
    steps = "1 step" if summary["steps"] == 1 else f"{summary['steps']:,} steps"
    say(f"{run}: {summary['gaussians']:,} Gaussians after {steps} in {summary['seconds']:.0f} s")


def _tell_covered(sequences: list[Sequence], settings: TrainSettings) -> None:
    for sequence in sequences:
        covered = int((~sequence.clear() & sequence.usable()).sum())
        if covered and sequence.name not in settings.held_out_sequences:
            say(
                f"{sequence.name}: something (a hand?) covers a part of the face in {covered} of "
                f"{int(sequence.usable().sum())} pictures; training leaves them out, and scoring counts them"
            )
