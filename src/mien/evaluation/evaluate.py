"""`evaluate`: a trained run in, metrics.json and report.html out."""

import hashlib
import json
from collections.abc import Sequence as Items
from dataclasses import replace
from pathlib import Path
from typing import Any

from mien.disk.config import check_ranges
from mien.disk.files import file_digest, write_json
from mien.disk.locks import hold
from mien.disk.reading import check_tree
from mien.errors import UserError
from mien.evaluation.cross import cross_reenactment
from mien.evaluation.dataset_protocols import check_lpips, dataset_protocol
from mien.evaluation.experiment import Experiment
from mien.evaluation.living import FILM, living, write_film
from mien.evaluation.load import load_experiments
from mien.evaluation.metrics_file import FORMAT, VERSION, read_metrics
from mien.evaluation.page_parts import Video, video_of
from mien.evaluation.protocols import Evaluation, EvaluationSettings, PartialScores, evaluate_frames, protocol_content
from mien.evaluation.report_sections import cross_section
from mien.evaluation.run_report import RunRecord, write_report
from mien.evaluation.scoring import worker_threads
from mien.evaluation.videos import write_comparison_video, write_scored_pictures
from mien.machine.progress import say
from mien.perceptual.lpips import load_lpips
from mien.training.colors import GAINS
from mien.training.footage.filmed import read_coverage
from mien.training.run import read_curves, read_run_config, read_training_summary, run_camera

_RECIPE = 4  # version of the scoring. It is raised whenever the same frame would get other figures


def evaluate(
    run_dir: Path,
    sequence_dirs: Items[Path],
    settings: EvaluationSettings | None = None,
    driver_dirs: Items[Path] = (),
) -> dict[str, Any]:
    """Score a run on its held-out frames, write metrics.json and report.html into its folder, and return the former.

    `sequence_dirs` are the folders of the sequences it was trained on, in that order. Those of `driver_dirs`, also
    tracked sequences, drive the avatar as well.
    """
    settings = settings or EvaluationSettings()
    check_tree(run_dir)
    check_ranges(settings, lambda name: f"--{name.replace('_', '-')}")
    with hold(run_dir):
        return _evaluate(run_dir, sequence_dirs, settings, driver_dirs)


def _evaluate(
    run_dir: Path, sequence_dirs: Items[Path], settings: EvaluationSettings, driver_dirs: Items[Path]
) -> dict[str, Any]:
    summary = read_training_summary(run_dir)
    if settings.protocol is not None:
        check_lpips(dataset_protocol(settings.protocol), settings)
    experiments = load_experiments(run_dir, sequence_dirs, settings.edges, settings.protocol)
    if not experiments and not driver_dirs:
        raise UserError(
            f"{run_dir}: no frame was held out, so nothing can be scored; train with `--split blocks` or "
            "`--split tail`, on 5 frames or more"
        )
    if experiments:
        say(f"{run_dir.name}: scores its held-out frames; the first takes longest")
    partials = {
        name: PartialScores(run_dir / f".{name}.partial", _fingerprint(run_dir, name, experiment, settings))
        for name, experiment in experiments.items()
    }
    results = {
        name: (experiment, evaluate_frames(experiment, settings, partials[name], f"evaluate {name}"))
        for name, experiment in experiments.items()
    }
    protocols = {name: protocol_content(*result, settings) for name, result in results.items()}
    driven, driven_videos = {}, []
    if driver_dirs:
        entry, driven_videos = cross_reenactment(run_dir, sequence_dirs[0], driver_dirs, settings.video_frames)
        driven = {"cross_reenactment": entry}
    fingerprints = {name: partial.fingerprint for name, partial in partials.items()}
    content = {"protocols": {**protocols, **driven}, "training": summary, "fingerprints": fingerprints}
    videos = {name: _video(run_dir, name, *results[name], settings) for name in results if settings.video_frames}
    for name, experiment in experiments.items():
        if settings.pictures:
            write_scored_pictures(run_dir / "pictures" / name, experiment)
    avatars = [experiment.avatar for experiment in experiments.values()]
    covered = read_coverage(run_dir, avatars[0].face_model) if avatars else None
    alive = None
    if avatars and settings.video_frames:
        alive = living(avatars[0], run_camera(run_dir), run_dir.name, covered)
    if alive is not None:
        write_film(run_dir / FILM, alive)
    run = RunRecord(run_dir.name, read_run_config(run_dir), summary, read_curves(run_dir), covered)
    section = cross_section(driven["cross_reenactment"], driven_videos, run_dir) if driven else None
    write_report(run_dir / "report.html", run, protocols, results, videos, section, alive)
    write_json(run_dir / "metrics.json", FORMAT, VERSION, content)
    for partial in partials.values():
        partial.remove()
    return content


def is_evaluated(run_dir: Path, sequence_dirs: Items[Path], settings: EvaluationSettings | None = None) -> bool:
    """Whether metrics.json holds the figures that `evaluate` would write, or more: same avatar, data and settings."""
    settings = settings or EvaluationSettings()
    try:
        known = read_metrics(run_dir).get("fingerprints")
    except UserError:
        return False
    experiments = load_experiments(run_dir, sequence_dirs, settings.edges, settings.protocol)
    enough = (settings, replace(settings, perceptual_of="all"))
    expected = [{name: _fingerprint(run_dir, name, each, own) for name, each in experiments.items()} for own in enough]
    return bool(experiments) and known in expected and (run_dir / "report.html").is_file()


def _video(
    run_dir: Path, name: str, experiment: Experiment, evaluation: Evaluation, settings: EvaluationSettings
) -> Video:
    path = run_dir / "videos" / f"{name}.mp4"
    threads = worker_threads(settings.threads)
    count = write_comparison_video(path, experiment, evaluation, settings.video_frames, threads)
    part = "" if count == len(evaluation.frames) else f", {count} of {len(evaluation.frames)} frames"
    return video_of(path, run_dir, f"Truth, rendering, error{part}")


def _fingerprint(run_dir: Path, protocol: str, experiment: Experiment, settings: EvaluationSettings) -> str:
    """A hash of everything that the figures of a frame depend on, as hex digits."""
    content = [
        _RECIPE, protocol, file_digest(run_dir / "avatar" / "avatar.safetensors"),
        file_digest(run_dir / "face_track.safetensors"), experiment.digests, experiment.held_out_frames,
        settings.baselines, settings.perceptual, settings.perceptual_frames, settings.backbone, settings.edges,
    ]  # fmt: skip
    if experiment.gains:
        content.append(file_digest(run_dir / GAINS))
    if settings.perceptual_of != "all":
        content.append(settings.perceptual_of)
    if settings.protocol is not None:
        content += [settings.protocol, settings.opened]
    if settings.lpips_weights is not None:
        content.append(load_lpips(settings.lpips_weights).backbone)
    if settings.fit_faces:
        content.append(settings.fit_steps)
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:16]
