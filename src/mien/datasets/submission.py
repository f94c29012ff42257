"""The submission of the NeRSemble benchmark (version 2): what is to be rendered of a person, and where it is written.

A submission is a zip of PERSON/SEQUENCE/cam_SERIAL.mp4. The monocular task asks for four test sequences, whose tracking
the benchmark publishes, from four cameras. The task of novel views asks for the trained sequence from three cameras.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from mien.camera import Camera
from mien.datasets.content import REMEDY, check_file_inside, is_file_inside
from mien.datasets.flame_poses import FRONT, carried, face_of_flame, in_front, needed_flame
from mien.datasets.nersemble import CALIBRATION, read_cameras
from mien.datasets.nersemble_benchmark import FPS_MONO, FPS_VIEWS, TRACKING, VERSION, flame_from_benchmark
from mien.errors import UserError
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.training.settings.splits import HIDDEN_CAMERAS, TEST_CAMERAS, TEST_SEQUENCES, TRAINING_CAMERA

MONO_PEOPLE = ("393", "404", "461", "477", "486")
VIEW_PEOPLE = ("388", "422", "443", "445", "475")
"""People of each task, all of whom a submission needs."""
_MONO_SIZE, _VIEW_SIZE = (512, 512), (1100, 1604)


@dataclass(frozen=True, eq=False)
class Task:
    """A sequence that is to be rendered from some cameras."""

    sequence: str
    face: FaceParams
    """The person at all timesteps, in the world of the cameras. Its identity is that of the benchmark's tracking."""
    cameras: dict[str, Camera]
    fps: float


def is_monocular(path: Path) -> bool:
    """Whether a person's folder is of the monocular task: a test sequence has a tracking."""
    return any(_tracking(path, name).is_file() for name in TEST_SEQUENCES)


def monocular_tasks(path: Path, face_model: FaceModel, size: tuple[int, int]) -> list[Task]:
    """Return the test sequences of a person, in the world of the trained avatar: the training camera looks ahead.

    `size` is the width and height of the pictures that the avatar was trained on.
    """
    file = path / CALIBRATION
    check_file_inside(path, file)
    known = read_cameras(file, size)
    for serial in TEST_CAMERAS:
        if serial not in known:
            raise UserError(f"{file}: has no camera {serial}, from which test sequences are rendered; {REMEDY}")
    model, tasks = needed_flame(path, face_model, VERSION), []
    for name in TEST_SEQUENCES:
        tracking = _tracking(path, name)
        if not is_file_inside(path, tracking):
            continue
        flame, turns, shifts, scale = flame_from_benchmark(tracking)
        views = {serial: known[serial].viewmat.double().numpy().copy() for serial in TEST_CAMERAS}
        for view in views.values():  # of a world in which the face model has its own size
            view[:3, 3] /= scale
        ahead = views[TRAINING_CAMERA]
        face = in_front(carried(face_of_flame(tracking, model, flame), turns, shifts / scale), ahead)
        placed = {serial: view @ np.linalg.inv(ahead) @ FRONT for serial, view in views.items()}
        tasks.append(Task(name, face, _cameras(known, placed), FPS_MONO))
    return tasks


def view_task(path: Path, sequence: str, face: FaceParams, trained: dict[str, Camera]) -> Task:
    """Return the trained sequence, seen by the hidden cameras.

    `face` is the person at all timesteps, in the world of the trained cameras.
    """
    file = path / CALIBRATION
    check_file_inside(path, file)
    first = next(iter(trained.values()))
    known = read_cameras(file, (first.width, first.height))
    shared = next((name for name in trained if name in known), None)
    missing = [serial for serial in HIDDEN_CAMERAS if serial not in known]
    if shared is None or missing:
        wanted = f"camera {missing[0]}, whose view is to be rendered" if missing else f"camera {next(iter(trained))}"
        raise UserError(f"{file}: has no {wanted}; {REMEDY}")
    # The world of the tracking may be another one than that of the calibration.
    here = trained[shared].viewmat.double().numpy()
    there = np.linalg.inv(known[shared].viewmat.double().numpy())
    placed = {serial: known[serial].viewmat.double().numpy() @ there @ here for serial in HIDDEN_CAMERAS}
    return Task(sequence, face, _cameras(known, placed), FPS_VIEWS)


def shortcomings(person: str, tasks: list[Task], monocular: bool) -> list[str]:
    """Return why the benchmark would refuse these videos, each in words. Empty if it would not."""
    people, size = (MONO_PEOPLE, _MONO_SIZE) if monocular else (VIEW_PEOPLE, _VIEW_SIZE)
    told = []
    if person not in people:
        told.append(f"{person} is not a person of this task ({', '.join(people)})")
    found = {(camera.width, camera.height) for task in tasks for camera in task.cameras.values()}
    told += [f"pictures are {w}x{h}, not {size[0]}x{size[1]}" for w, h in sorted(found - {size})]
    if monocular and (missing := [name for name in TEST_SEQUENCES if all(task.sequence != name for task in tasks)]):
        told.append(f"no tracking of {', '.join(missing)}")
    return told


def _tracking(path: Path, name: str) -> Path:
    return path / "sequences" / name / "tracking" / TRACKING


def _cameras(known: dict[str, Camera], placed: dict[str, np.ndarray]) -> dict[str, Camera]:
    return {serial: replace(known[serial], viewmat=torch.from_numpy(view).float()) for serial, view in placed.items()}
