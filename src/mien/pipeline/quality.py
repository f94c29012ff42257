"""From reference captures to a table of figures, as the command line runs it."""

import json
import shutil
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch

from mien.avatar.files import load_avatar
from mien.capture.settings import CaptureSettings
from mien.capture.store import read_capture, read_capture_hash
from mien.disk.files import read_json, replace_folder, write_atomically, write_json
from mien.disk.locks import WAIT, hold
from mien.disk.reading import remove_tree
from mien.disk.workspace import Workspace
from mien.evaluation.experiment import Experiment, avatar_image, target_image
from mien.evaluation.load import load_experiments
from mien.evaluation.metrics import crop_to
from mien.evaluation.metrics_file import protocol_means
from mien.evaluation.protocols import EvaluationSettings
from mien.evaluation.scoring import ScoreSettings
from mien.face.loading import load_face_model
from mien.face.torso import has_torso
from mien.lab.benchmarking.quality import QualityRow, markdown_table, tracking_errors
from mien.lab.benchmarking.torso import outline_motion
from mien.lab.benchmarking.unfilmed import (
    PosedPictures,
    as_avatar_has_it,
    glasses_masks,
    score_unfilmed,
    unfilmed_table,
)
from mien.lab.benchmarking.unseen_views import (
    Figures,
    SidePictures,
    in_white_square,
    score_side_views,
    write_unseen_chart,
)
from mien.lab.synthetic.posed_faces import posed_faces
from mien.lab.synthetic.references import FACES, REFERENCES, TALK, ReferenceCapture, reference_named
from mien.lab.synthetic.truth import read_truth
from mien.machine.progress import say
from mien.machine.terminal import show
from mien.media.picture_files import write_png
from mien.pipeline.align import one_camera, run_alignment_stage
from mien.pipeline.capture import run_capture_stage
from mien.pipeline.evaluate import run_evaluation_stage, run_sequences
from mien.pipeline.face_models import face_model_of
from mien.pipeline.stage_times import FILE_NAME, StageTimes
from mien.pipeline.track import run_tracking_stage
from mien.pipeline.train import run_training_stage
from mien.tracking.files import write_tracking
from mien.tracking.scoring import make_scoring
from mien.tracking.scoring_files import write_scoring
from mien.tracking.settings import TrackingSettings
from mien.tracking.tracking import Tracking
from mien.training.footage.frames import Frame
from mien.training.run import read_training_summary
from mien.training.settings import PRESETS, AlignmentSettings, TrainSettings

_FORMAT, _VERSION = "mien.bench_quality", 1
_SCORED, _PRESET = EvaluationSettings(perceptual_frames=8, video_frames=0), PRESETS["standard"]


def run_quality_stage(
    out: Path, captures: tuple[str, ...], method: str, steps: int, face_model: str = "anny", *, as_json: bool
) -> None:
    """Run the reference captures and print their figures. Writes OUT/quality.json, quality.md and contact_sheet.png.

    References of unfilmed faces have tables and files of their own, in the workspaces of their runs.
    """
    usual = [name for name, reference in REFERENCES.items() if reference.by_default]
    references, rows, strips = [reference_named(name) for name in captures or usual], [], []
    with hold(out / "quality", remedy=f"{WAIT}, or choose another folder (--out DIR)"):
        for reference in [one for one in references if one.unfilmed]:
            table = run_unfilmed(reference, out, method, steps or reference.steps)
            if not as_json:
                show(table)
        for reference in [one for one in references if not one.unfilmed]:
            row, strip = _run_reference(reference, out, method, steps or reference.steps, face_model)
            rows.append(row)
            strips.append(strip)
            content = {"rows": [asdict(row) for row in rows]}
            write_json(out / "quality.json", _FORMAT, _VERSION, json.loads(json.dumps(content)))
            write_atomically(out / "quality.md", lambda path: path.write_text(markdown_table(rows), "utf-8"))
            write_png(out / "contact_sheet.png", np.concatenate(strips))
    if rows or as_json:
        show(json.dumps([asdict(row) for row in rows]) if as_json else markdown_table(rows))
    if rows:
        say(f"Look at {out / 'contact_sheet.png'}; the tables are in {out / 'quality.md'}")


def _run_reference(
    reference: ReferenceCapture, out: Path, method: str, steps: int, face_model: str
) -> tuple[QualityRow, np.ndarray]:
    """Run all stages on one reference capture and skip those with current results; return its row and its pictures.

    Frames of one camera are aligned as `mien create` does.
    """
    drawn, workspace = out / "drawn" / reference.name, Workspace(out / reference.name)
    times = StageTimes(workspace.root / FILE_NAME)
    say(f"== {reference.name}: {reference.description}")
    key, trackings = draw_and_track(reference, drawn, workspace, times, face_model)
    names, run = list(trackings), f"{method}-{steps}"
    settings = reference_settings(reference, replace(_PRESET.settings_of(method), steps=steps))
    alignment = AlignmentSettings()
    if steps >= alignment.template_steps and one_camera(workspace, names):
        with times.measured("align"):
            run_alignment_stage(workspace, names, alignment, settings, keep=True)
    with times.measured("train"):
        run_training_stage(workspace, names, run, _PRESET.config(method), settings)
    with times.measured("evaluate"):
        metrics = run_evaluation_stage(workspace, run, _SCORED, again=False)
    errors = {
        name: tracking_errors(
            tracking, read_capture(workspace.sequence_dir(name) / "capture"), read_truth(drawn / name / "truth"),
            load_face_model(tracking.face_model),
        )
        for name, tracking in trackings.items()
    }  # fmt: skip
    with times.measured("views"):
        unseen = score_unseen_views(reference, drawn, workspace, run)
    by_truth: Figures = {}
    if reference.views is not None:
        with times.measured("views by true tracking"):
            true = _workspace_of_truth(drawn, workspace, Workspace(out / f"{reference.name}-true"), names)
            run_training_stage(true, names, run, _PRESET.config(method), settings)
            by_truth = score_unseen_views(reference, drawn, true, run)
    outline = None
    if has_torso(face_model_of(face_model)):
        experiment = _experiment(workspace, run)
        frame = experiment.held_out_frames[0]
        outline = outline_motion(experiment.avatar, experiment.face(frame), experiment.camera(frame))
    gaussians = read_training_summary(workspace.run_dir(run))["gaussians"]
    seconds, means = times.seconds(), protocol_means(metrics)
    row = QualityRow(reference.name, key, method, steps, gaussians, means, errors, seconds, unseen, by_truth, outline)
    return row, _strip(workspace, run)


def draw_and_track(
    reference: ReferenceCapture, drawn: Path, workspace: Workspace, times: StageTimes, face_model: str = "anny"
) -> tuple[str, dict[str, Tracking]]:
    """Draw, capture and track a reference capture, and skip stages with current results.

    Returns its key, and the tracking of each sequence by name.
    """
    with times.measured("draw"):
        key = reference.write(drawn)
    with times.measured("capture"):
        _capture(reference, drawn, workspace)
    with times.measured("track"):
        return key, run_tracking_stage(workspace, face_model, TrackingSettings(), overlay="none")


def _capture(reference: ReferenceCapture, drawn: Path, workspace: Workspace) -> None:
    for name in (recipe.name for recipe in reference.sequences):
        if (video := drawn / name / "video.mp4").is_file():
            run_capture_stage(workspace, [video], [name], None, CaptureSettings(cuts=False), replace=True)
        else:
            _copy_capture(drawn / name / "capture", workspace.sequence_dir(name))


def run_unfilmed(reference: ReferenceCapture, out: Path, method: str, steps: int) -> str:
    """Train on the true tracking of talk, and of all clips, and on talk as tracked, and score other faces.

    Returns a table. Writes unfilmed.json and a sheet into each run's folder, in OUT/NAME-true and OUT/NAME-tracked.
    """
    drawn, workspace = out / "drawn" / reference.name, Workspace(out / reference.name)
    say(f"== {reference.name}: {reference.description}")
    key, names = reference.write(drawn), [recipe.name for recipe in reference.sequences]
    _capture(reference, drawn, workspace)
    true = _workspace_of_truth(drawn, workspace, Workspace(out / f"{reference.name}-true"), names)
    settings = replace(_PRESET.settings_of(method), steps=steps, split="none")
    scene = reference.scenes()[-1]
    capture, truth = read_capture(drawn / FACES / "capture"), read_truth(drawn / FACES / "truth")
    pictures = PosedPictures(tuple(posed_faces(scene.model)), capture.images, truth, glasses_masks(scene))
    tracked, run, figures = Workspace(out / f"{reference.name}-tracked"), f"{method}-{steps}", {}
    _copy_capture(workspace.sequence_dir(TALK) / "capture", tracked.sequence_dir(TALK))
    run_tracking_stage(tracked, "anny", TrackingSettings(), overlay="none")
    run_alignment_stage(tracked, [TALK], AlignmentSettings(), settings, keep=True)
    runs = (("talk", true, [TALK], ""), ("everything", true, names, "-everything"), ("as tracked", tracked, [TALK], ""))
    for kind, of, filmed, suffix in runs:
        folder = of.run_dir(f"{run}{suffix}")
        run_training_stage(of, filmed, folder.name, _PRESET.config(method), settings)
        avatar = load_avatar(folder)
        own = as_avatar_has_it(avatar, pictures) if of is tracked else pictures
        figures[kind], sheet = score_unfilmed(avatar, own, ScoreSettings(perceptual_frames=0))
        write_png(folder / "unfilmed.png", sheet)
        write_json(folder / "unfilmed.json", "mien.unfilmed", 1, {"key": key, "regions": figures[kind]})
    say(f"Look at unfilmed.png in the runs of {true.root} and {tracked.root}")
    return unfilmed_table(reference.name, key, figures)


def reference_settings(reference: ReferenceCapture, settings: TrainSettings) -> TrainSettings:
    """The settings with what a reference capture holds out."""
    return replace(
        settings,
        split="none" if reference.held_out_sequences else "blocks",
        held_out_sequences=reference.held_out_sequences,
        held_out_cameras=reference.held_out_cameras,
    )


def _workspace_of_truth(drawn: Path, workspace: Workspace, true: Workspace, names: list[str]) -> Workspace:
    """Make a workspace with the same captures and the true tracking, unless it exists, and return it."""
    for name in names:
        own, folder = workspace.sequence_dir(name) / "capture", true.sequence_dir(name)
        pictures, truth = read_capture_hash(own), read_truth(drawn / name / "truth").tracking
        if (folder / "capture").is_dir() and read_capture_hash(folder / "capture") == pictures:
            continue
        with hold(folder):
            remove_tree(folder / "capture")
            write_tracking(folder / "tracking", truth)
            scoring = make_scoring(read_capture(own), truth, load_face_model(truth.face_model), scratch=folder)
            write_scoring(folder / "scoring", scoring, pictures)
        _copy_capture(own, folder)  # it comes last: it says that the rest is there
    return true


def score_unseen_views(reference: ReferenceCapture, drawn: Path, workspace: Workspace, run: str) -> Figures:
    """Score a run on true pictures from all sides, if there are any. Writes a sheet and a chart beside its report.

    What was scored is read.
    """
    views, run_dir = reference.views, workspace.run_dir(run)
    if views is None:
        return {}
    file = run_dir / "unseen_view.json"
    if file.is_file():
        return read_json(file, "mien.unseen_view", 1, remedy=f"delete {file} and run the same command again")["angles"]
    experiment = _experiment(workspace, run)
    capture, truth = read_capture(drawn / views.name / "capture"), read_truth(drawn / views.name / "truth")
    moments = tuple(views.first + views.every * index for index in range(capture.timesteps))
    figures, sheet = score_side_views(
        experiment, views.sequence, SidePictures(capture, truth, moments), ScoreSettings(perceptual_frames=2)
    )
    write_png(run_dir / "unseen_view.png", sheet)
    write_unseen_chart(run_dir / "unseen_view_chart.svg", figures)
    write_json(file, "mien.unseen_view", 1, {"angles": figures})
    return figures


def _experiment(workspace: Workspace, run: str) -> Experiment:
    """The first experiment of a run."""
    run_dir = workspace.run_dir(run)
    return next(iter(load_experiments(run_dir, run_sequences(workspace, run_dir)).values()))


def _copy_capture(source: Path, folder: Path) -> None:
    """Copy the capture of calibrated cameras into the folder of a sequence, unless it is there."""
    aside, target = folder / ".capture.partial", folder / "capture"
    if target.is_dir() and read_capture_hash(target) == read_capture_hash(source):
        return
    with hold(folder):
        remove_tree(aside)
        shutil.copytree(source, aside)
        replace_folder(target, aside)


@torch.no_grad()
def _strip(workspace: Workspace, run: str) -> np.ndarray:
    """Head crops of held-out pictures in a row, above those of the avatar."""
    experiment = _experiment(workspace, run)
    frames, count = experiment.held_out_frames, 6
    # Choose at random: evenly spread frames of several cameras could show one camera again and again.
    places = np.random.default_rng(0).choice(len(frames), count, replace=len(frames) < count)
    chosen = [frames[index] for index in np.sort(places)]

    def tile(picture: torch.Tensor, frame: Frame) -> np.ndarray:
        return in_white_square(crop_to(picture, experiment.crop(frame)), 192)

    return np.concatenate([
        np.concatenate([tile(draw(experiment, frame), frame) for frame in chosen], 1)
        for draw in (target_image, avatar_image)
    ])  # fmt: skip
