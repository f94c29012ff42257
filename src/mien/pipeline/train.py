"""From sequences to a run, as the command line runs it."""

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from mien.avatar.settings import MethodConfig, steps_of_passes
from mien.capture.store import read_capture
from mien.disk.locks import read_beside_writers
from mien.disk.workspace import Workspace
from mien.face.loading import load_face_model
from mien.face.model import FaceModel
from mien.machine.progress import say
from mien.pipeline.view_training import TrainingView
from mien.training.footage.frames import training_frames
from mien.training.footage.sequence import Sequence, read_sequence
from mien.training.run import check_untouched, is_finished, read_training_summary
from mien.training.settings import TrainSettings
from mien.training.settings.splits import SPLITS, Recorded, Recordings, fill_in, read_own_split
from mien.training.trainer import check_trackings, train


def fill_in_split(workspace: Workspace, settings: TrainSettings, given: Recordings) -> tuple[list[str], TrainSettings]:
    """The sequences that a run uses, and its settings with what the split holds out, after a message that says so."""
    rule = SPLITS[settings.split]
    names = rule.used(given)
    if rule.held_out is None:
        return names, settings
    recorded = {}
    for name in names:
        folder = workspace.sequence_dir(name)
        capture = read_capture(folder / "capture")
        recorded[name] = Recorded(capture.camera_ids, capture.timesteps, read_own_split(folder))
    settings = fill_in(settings, replace(given, sequences=recorded))
    parts = {"sequence": settings.held_out_sequences, "camera": settings.held_out_cameras}
    words = [f"the {kind}{'s' * (len(part) > 1)} {', '.join(part)}" for kind, part in parts.items() if part]
    left_out = [name for name in given.sequences if name not in names]
    not_used = f"; not used: {', '.join(left_out)}" if left_out else ""
    say(f"--split {settings.split}: held out are {' and '.join(words) or 'timesteps of each sequence'}{not_used}")
    return names, settings


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
    published: bool = False,
    growing: Path | None = None,
) -> None:
    """Train a run on some sequences of the workspace. An interrupted run continues; a finished run stays as it is.

    With `view`, browsers can watch it. `growing` is a .mien file that gets its state from time to time. `published`
    says that the settings are those of a paper.
    """
    run_dir = workspace.run_dir(run)
    check_untouched(run_dir)
    loaded, face_model = read_together(workspace, sequences)
    _tell_covered(loaded, settings)
    if published and (aligned := [sequence.name for sequence in loaded if sequence.tracking.aligned]):
        say(
            f"{', '.join(aligned)}: frames were aligned to a quick avatar, which no paper does; for a run without that,"
            f" track them again first: `mien track {workspace.root} --again`"
        )
    frames = len(training_frames(loaded, settings))
    if published and (steps_of_passes(method, frames) or settings.steps) != settings.steps:
        say(
            f"{run}: its epochs are not passes over the {frames} training frames, as in the paper; "
            f"--steps {steps_of_passes(method, frames)} makes them so"
        )
    with ExitStack() as closing:
        if not is_finished(run_dir):
            say(f"{run}: looks for what the pictures show of the head, before the first step")
        shown = view or growing is not None
        live = TrainingView(run, loaded[0].tracking.cameras[0], growing, view) if shown else None
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
