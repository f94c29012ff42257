"""From workspaces and methods to one table, as the command line runs it."""

import json
from collections.abc import Sequence as Items
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

from mien.avatar.settings import MethodConfig
from mien.disk.files import file_digest, write_atomically, write_json
from mien.disk.locks import WAIT, hold
from mien.disk.workspace import COMPARED, Workspace
from mien.errors import UserError
from mien.evaluation.metrics_file import protocol_means
from mien.evaluation.protocols import EvaluationSettings
from mien.face.loading import load_face_model
from mien.lab.benchmarking.comparing import MethodRow, comparison_table
from mien.lab.benchmarking.timing import measure_machine
from mien.lab.synthetic.references import ReferenceCapture, reference_named
from mien.machine.devices import DeviceName
from mien.machine.progress import say
from mien.machine.terminal import show
from mien.pipeline.evaluate import run_evaluation_stage
from mien.pipeline.quality import draw_and_track, reference_settings, score_unseen_views
from mien.pipeline.stage_times import FILE_NAME, StageTimes
from mien.pipeline.train import fill_in_split, run_training_stage
from mien.training.footage.frames import training_frames
from mien.training.footage.sequence import Sequence, read_sequence
from mien.training.run import read_training_summary
from mien.training.settings import PRESETS, TrainSettings
from mien.training.settings.splits import Recordings
from mien.training.trainer import train

_FORMAT, _VERSION = "mien.bench_compare", 1
_PRESET = PRESETS["standard"]
Split = Literal["blocks", "tail"]
_SCORED = EvaluationSettings(video_frames=0)
FIRST_TRIAL_STEPS, _MOST_FIRST_STEPS = 100, 400
"""Least and largest number of steps of the first trial. Between them, it uses each training frame once."""
_TRIAL_SHARE = 0.1
"""Share of the budget that the second trial may take beside it. A shorter one grows fewer Gaussians than the run."""
_LEAST_MARGIN = 0.3
"""Smallest ratio of the seconds of a further step to the mean of all, because trials are noisy."""


@dataclass(frozen=True)
class Subject:
    """A capture on which all methods are trained."""

    name: str
    workspace: Workspace
    sequences: list[str]
    settings: TrainSettings
    """What is held out."""
    reference: ReferenceCapture | None = None
    drawn: Path | None = None
    """The folder of a reference capture's true pictures."""


def run_compare_stage(
    out: Path,
    workspaces: Items[Workspace],
    captures: Items[str],
    methods: Items[str],
    *,
    minutes: float,
    steps: int,
    split: Split,
    device: DeviceName,
    as_json: bool,
) -> None:
    """Train and score every method on every capture, and print the table. Writes OUT/compare.json and compare.md.

    The captures are tracked workspaces, and reference captures, which are drawn, captured and tracked in OUT first.
    Each method trains on `device` for `minutes`, or else `steps`, or else as long as its preset says. `split` is that
    of workspaces; reference captures have their own.
    """
    budget = f"{minutes:g}min" if minutes else f"{steps}" if steps else "full"
    references = [reference_named(name) for name in captures]
    chosen = {"methods": list(methods), "budget": {"minutes": minutes, "steps": steps}, "split": split}
    chosen |= {"device": device}
    rows: list[MethodRow] = []
    content: dict[str, Any] = {}
    with hold(out / "compare", remedy=f"{WAIT}, or choose another folder (--out DIR)"):
        subjects = [of_workspace(workspace, split) for workspace in workspaces]
        for subject in (*subjects, *(_of_reference(reference, out) for reference in references)):
            for method in methods:
                say(f"== {subject.name}: {method}")
                run = "-".join([COMPARED + method, budget, *([] if split == "blocks" else [split])])
                own = replace(subject.settings, steps=_PRESET.settings_of(method).steps, device=device)
                trials = out / "trials" / subject.name / run
                own = replace(own, steps=steps_for(subject, _PRESET.config(method), own, minutes, steps, trials))
                rows.append(_row(subject, method, run, own))
                content = {"settings": chosen, "machine": asdict(measure_machine()), "rows": list(map(asdict, rows))}
                content = json.loads(json.dumps(content))
                write_json(out / "compare.json", _FORMAT, _VERSION, content)
                write_atomically(out / "compare.md", lambda path: path.write_text(comparison_table(rows), "utf-8"))
    show(json.dumps({"format": _FORMAT, "version": _VERSION, **content}) if as_json else comparison_table(rows))
    say(f"The table is in {out / 'compare.md'}")


def of_workspace(workspace: Workspace, split: Split) -> Subject:
    """The tracked workspace as something to compare on."""
    given = dict.fromkeys(workspace.tracked_names())
    if not given:
        raise UserError(f"{workspace.root}: no tracked sequences; run `mien track {workspace.root}`")
    settings = replace(_PRESET.settings, split=split)
    return Subject(workspace.root.resolve().name, workspace, *fill_in_split(workspace, settings, Recordings(given)))


def _of_reference(reference: ReferenceCapture, out: Path) -> Subject:
    drawn, workspace = out / "drawn" / reference.name, Workspace(out / reference.name)
    _, trackings = draw_and_track(reference, drawn, workspace, StageTimes(workspace.root / FILE_NAME))
    held = reference_settings(reference, _PRESET.settings)
    return Subject(reference.name, workspace, list(trackings), held, reference, drawn)


def _row(subject: Subject, method: str, run: str, settings: TrainSettings) -> MethodRow:
    """Train and score a method on a capture, unless that is done."""
    workspace, run_dir = subject.workspace, subject.workspace.run_dir(run)
    run_training_stage(workspace, subject.sequences, run, _PRESET.config(method), settings)
    metrics = run_evaluation_stage(workspace, run, _SCORED, again=False)
    summary, unseen = read_training_summary(run_dir), {}
    if subject.reference is not None and subject.drawn is not None:
        unseen = score_unseen_views(subject.reference, subject.drawn, workspace, run)
    size = sum(path.stat().st_size for path in (run_dir / "avatar").rglob("*") if path.is_file())
    return MethodRow(
        subject.name, method, run, summary["steps"], summary["seconds"], summary["gaussians"], size,
        protocol_means(metrics), unseen,
    )  # fmt: skip


def steps_for(
    subject: Subject, config: MethodConfig, settings: TrainSettings, minutes: float, steps: int, folder: Path
) -> int:
    """The number of steps of a run. Minutes are turned into steps by two trials, which are kept in a folder.

    The run is expected to need as much time beside its steps as the trials, and for each step the time that a step of
    the longer trial takes after the length of the shorter one. By then each frame was used once, which takes longest.
    """
    if not minutes:
        return steps or settings.steps
    finished = subject.workspace.run_dir(folder.name) / "training.json"
    if finished.is_file():
        return read_training_summary(finished.parent)["steps"]
    folders = [subject.workspace.sequence_dir(name) for name in subject.sequences]
    tracked = "".join(file_digest(one / "tracking/tracking.safetensors")[:8] for one in folders)[:32]
    sequences = [read_sequence(one) for one in folders]
    pictures = len(training_frames(sequences, settings))
    count = max(FIRST_TRIAL_STEPS, min(pictures, _MOST_FIRST_STEPS))
    took = trial_seconds(sequences, config, replace(settings, steps=count), folder / f"first-{count}-{tracked}")
    rate, began = took / count, 0.0
    longer = max(2 * count, round(_TRIAL_SHARE * 60 * minutes / rate))
    if longer * rate < 60 * minutes:
        both = trial_seconds(sequences, config, replace(settings, steps=longer), folder / f"second-{longer}-{tracked}")
        rate = min(max((both - took) / (longer - count), _LEAST_MARGIN * both / longer), both / longer)
        began = both - longer * rate
    steps = max(1, round((60 * minutes - began) / rate))
    say(
        f"{folder.name}: {1e3 * rate:.1f} ms a step and {began:.1f} s beside the steps in trials, "
        f"so {steps:,} steps in {minutes:g} minutes"
    )
    if steps < pictures:
        say(
            f"{folder.name}: {minutes:g} minutes are too few steps to see each of {pictures} pictures once, so "
            "the figures say little; give more --minutes"
        )
    return steps


def trial_seconds(sequences: list[Sequence], config: MethodConfig, settings: TrainSettings, run_dir: Path) -> float:
    """Seconds of a short run, whose schedules are as short. A trial that was done is only read."""
    if not (run_dir / "training.json").is_file():
        say(f"{run_dir.parent.name}: a trial of {settings.steps} steps")
        train(sequences, load_face_model(sequences[0].tracking.face_model), config, settings, run_dir)
    return max(read_training_summary(run_dir)["seconds"], 0.05)
