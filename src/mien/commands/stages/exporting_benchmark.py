"""A run as the submission folder of the NeRSemble benchmark (`mien export --format nersemble-benchmark`)."""

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
from mien.datasets.submission import (
    MONO_PEOPLE,
    VIEW_PEOPLE,
    Task,
    is_monocular,
    monocular_tasks,
    shortcomings,
    view_task,
)
from mien.disk.workspace import Workspace
from mien.errors import UserError
from mien.face.params import FaceParams
from mien.inside import remove_tree
from mien.machine.progress import say, track_progress
from mien.machine.terminal import counted
from mien.media.pictures import to_uint8
from mien.media.video import write_video
from mien.render import rasterize
from mien.render.closing import close_holes
from mien.render.validation import drawable
from mien.storage import replace_folder
from mien.tracking.files import read_tracking
from mien.training.run import check_data, read_face_track, read_run_config

_CRF = 14
"""Quality of the videos, as the benchmark asks for."""


def export_submission(workspace: Workspace, run: str, person: Path, out: Path) -> None:
    """Render a run for the benchmark into OUT/PERSON, and report what a submission still lacks.

    Args:
        workspace: The workspace of the run.
        run: Name of the run.
        person: The person's folder of the benchmark, with calibration and trackings. Its name is a number.
        out: The submission folder. Folders of other people may be in it.
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
    for serial, camera in task.cameras.items():
        path = folder / task.sequence / f"cam_{serial}.mp4"
        path.parent.mkdir(parents=True, exist_ok=True)
        title = f"{task.sequence}, camera {serial}"
        write_video(path, track_progress(_pictures(avatar, face, camera, title), title, len(face)), task.fps, _CRF)


@torch.no_grad()
def _pictures(avatar: Avatar, face: FaceParams, camera: Camera, what: str) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """The avatar at each timestep, over white."""
    for timestep in range(len(face)):
        gaussians = avatar.pose(face[timestep]).gaussians.timestep(0)
        with drawable(f"{what}, timestep {timestep}", "train again"):
            image = rasterize(gaussians, camera, torch.ones(3).to(gaussians.means)).image
        yield to_uint8(close_holes(image.clamp(0, 1), avatar.extras.closing))
