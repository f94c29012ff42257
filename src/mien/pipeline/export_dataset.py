"""A tracked sequence in the layout of another laboratory, and the videos of a benchmark: `mien export-dataset`."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8

from mien.avatar.avatar import Avatar
from mien.avatar.files import load_avatar
from mien.camera import Camera
from mien.capture.store import read_capture
from mien.datasets.layouts.filmed import filmed_frames
from mien.datasets.layouts.layout import Layout, MatteKind
from mien.datasets.layouts.writing import write_layout
from mien.datasets.submission import (
    MONO_PEOPLE,
    VIEW_PEOPLE,
    Task,
    is_monocular,
    monocular_tasks,
    shortcomings,
    view_task,
)
from mien.disk.config import decode
from mien.disk.files import replace_folder
from mien.disk.reading import remove_tree
from mien.disk.workspace import Workspace
from mien.errors import UserError
from mien.face.params import FaceParams
from mien.machine.progress import say, track_progress
from mien.machine.terminal import counted
from mien.media.pictures import to_uint8
from mien.media.video import write_video
from mien.pipeline.train import fill_in_split, read_together
from mien.render import rasterize
from mien.render.rasterize import close_holes
from mien.render.validation import drawable
from mien.tracking.files import read_tracking
from mien.training.run import check_data, read_face_track, read_run_config
from mien.training.settings import Split, TrainSettings
from mien.training.settings.splits import OWN_SPLIT, Recordings, read_own_split


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
    return fill_in_split(workspace, settings, Recordings({sequence: None}))[1]


def export_capture(
    workspace: Workspace, sequence: str, layout: Layout, out: Path, settings: TrainSettings, mattes: MatteKind
) -> None:
    """Write a tracked sequence into a new folder, and report it."""
    (read,), face_model = read_together(workspace, [sequence])
    filmed = filmed_frames(read, face_model, settings, mattes)
    say(f"{out}: {write_layout(out, filmed, layout)}")


def export_submission(workspace: Workspace, run: str, person: Path, out: Path) -> None:
    """Render a run for the benchmark into OUT/PERSON, and report what a submission still lacks.

    `person` is the person's folder of the benchmark, with calibration and trackings, whose name is a number. Folders of
    other people may be in `out`.
    """
    number, run_dir = person.resolve().name.zfill(3), workspace.run_dir(run)
    avatar = load_avatar(run_dir)
    monocular = is_monocular(person)
    if monocular:
        first = workspace.sequence_dir(read_run_config(run_dir)["data"][0]["sequence"])
        camera = read_tracking(first / "tracking").cameras[0]
        tasks = monocular_tasks(person, avatar.face_model, (camera.width, camera.height))
    else:
        tasks = [_trained(workspace, run_dir, avatar, person)]
    place = out / number
    aside = out / f".{number}.partial"
    remove_tree(aside)
    try:
        for task in tasks:
            _write(aside, task, avatar)
        replace_folder(place, aside)
    finally:
        remove_tree(aside)
    cameras, timesteps = counted(len(tasks[0].cameras), "camera"), sum(len(task.face) for task in tasks)
    say(f"{place}: {counted(len(tasks), 'sequence')} from {cameras}, {timesteps:,} timesteps")
    for words in shortcomings(number, tasks, monocular):
        say(f"warning: the benchmark refuses this: {words}")
    missing = [each for each in (MONO_PEOPLE if monocular else VIEW_PEOPLE) if not (out / each).is_dir()]
    if missing:
        say(f"{out}: a submission needs {', '.join(missing)} as well; export their runs into the same folder")
    else:
        say(f"{out}: all people are there; make a zip of the folders in it, without {out.name} itself")


def _trained(workspace: Workspace, run_dir: Path, avatar: Avatar, person: Path) -> Task:
    """The one sequence of a run, with the faces of its training, seen by the hidden cameras."""
    names = [entry["sequence"] for entry in read_run_config(run_dir)["data"]]
    if len(names) != 1:
        raise UserError(
            f"{run_dir}: was trained on {', '.join(names)}, and the task of novel views is one sequence; train on that "
            "alone"
        )
    folder = workspace.sequence_dir(names[0])
    tracking, ids = read_tracking(folder / "tracking"), read_capture(folder / "capture").camera_ids
    check_data(run_dir, {names[0]: tracking})
    face = read_face_track(run_dir, avatar.face_model)
    return view_task(person, names[0], face, dict(zip(ids, tracking.cameras, strict=True)))


def _write(folder: Path, task: Task, avatar: Avatar) -> None:
    subject = avatar.subject
    face = replace(task.face, identity=subject.identity, vertex_offsets=subject.vertex_offsets)
    (folder / task.sequence).mkdir(parents=True, exist_ok=True)
    for serial, camera in task.cameras.items():
        title = f"{task.sequence}, camera {serial}"
        pictures = track_progress(_pictures(avatar, face, camera, title), title, len(face))
        # The quality that the benchmark asks for.
        write_video(folder / task.sequence / f"cam_{serial}.mp4", pictures, task.fps, 14)


@torch.no_grad()
def _pictures(avatar: Avatar, face: FaceParams, camera: Camera, what: str) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """The avatar at each timestep, over white."""
    for timestep in range(len(face)):
        gaussians = avatar.pose(face[timestep]).gaussians.timestep(0)
        with drawable(f"{what}, timestep {timestep}", "train again"):
            image = rasterize(gaussians, camera, torch.ones(3).to(gaussians.means)).image
        yield to_uint8(close_holes(image.clamp(0, 1), avatar.extras.closing))
