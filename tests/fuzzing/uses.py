"""Readers that take some lines, and uses of what was read, to see that accepted files do no harm later."""

import contextlib
import io
import itertools
import json
import os
import subprocess
import tempfile
from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from fuzzing.material import ANALYSIS, CONFIG, GROWTH, QUICK, RUN, SEQUENCE, SETTINGS
from mien import cli
from mien.avatar import load_avatar
from mien.avatar.baking import make_portable
from mien.avatar.methods import METHODS
from mien.capture.cameras.calibration import CalibratedCamera
from mien.capture.cameras.readings import readings_of
from mien.capture.person.crop import whole_picture
from mien.capture.person.given import GivenMattes
from mien.commands.train_options import ConfigFile, TrainOptions
from mien.datasets.dataset import TrainedAvatar
from mien.datasets.registry import datasets, recognised
from mien.datasets.writing import write_sequence
from mien.disk.files import read_tensors
from mien.disk.reading import is_one_line
from mien.disk.workspace import Workspace, open_workspace
from mien.driving import drive
from mien.driving.blendshape_json import read_blendshape_json
from mien.driving.live_link_face import read_live_link_face
from mien.driving.motion import Motion
from mien.errors import UserError
from mien.evaluation import evaluate
from mien.evaluation.image_folders import open_pictures, read_picture
from mien.evaluation.metrics_file import read_metrics
from mien.face import FaceModel, FaceParams, load_face_model
from mien.face.listing import available_face_models
from mien.face.models.flame import flame_face_model
from mien.formats import in_world, read_ply, write_ply
from mien.formats.gaussian_avatars import write_gaussian_avatars_folder
from mien.lab.analysis.registry import AnalysisOptions
from mien.lab.analysis.running import run_analysis
from mien.lab.analysis.study.files import read_all_answers, read_key, tally_content, tally_text
from mien.media.source import FrameSelection, open_source, read_image
from mien.media.video import count_frames, probe_video, read_video_frames
from mien.pipeline.import_dataset import front_camera
from mien.render import rasterize
from mien.runtime import write_portable
from mien.runtime.avatar import Avatar
from mien.training import read_sequence, train
from mien.training.checkpoint import resume
from mien.training.run import read_face_track, run_camera, write_imported_run
from mien.training.trainer import start
from toy_scene import toy_camera, toy_face_model, toy_sequence

SEEN = 3
"""Number of pictures of a video that are read."""
_READER = Path(__file__).parents[2] / "web" / "tests" / "read.mjs"
_WHITE = torch.ones(3)


class CommandError(Exception):
    """A command ended in a way that commands must not end."""


# Readers --------------------------------------------------------------------------------------------------------------


def known(found: dict[str, Any]) -> dict[str, Any]:
    """Return the entries except for the one that results from damage to the name `checksum`."""
    names = ("method", "settings", "data", "mien", "command_line", "protocols", "training", "fingerprints", "steps",
             "seconds")  # fmt: skip
    return {name: value for name, value in found.items() if name in names}


def read_track(root: Path, file: Path) -> FaceParams:
    with told_of(file, TypeError):  # as `mien.evaluation.load` does
        return FaceParams(**read_tensors(file))


@contextlib.contextmanager
def told_of(file: Path, kind: type[Exception]) -> Iterator[None]:
    """Make errors of a kind complaints about a file, as callers of the reader do."""
    try:
        yield
    except kind as error:
        raise UserError(f"{file}: {error}") from None


def resume_run(root: Path, file: Path) -> Any:
    face_model, sequence = toy_sequence(timesteps=5, size=32)
    state = start([sequence], face_model, CONFIG, replace(SETTINGS, split="tail"))
    resume(root / RUN / "checkpoints", state)
    return state.avatar


def read_added(root: Path, file: Path) -> FaceModel:
    os.environ["MIEN_CACHE"] = str(root / "cache")
    available_face_models()
    return load_face_model("mine")


def read_pictures(root: Path, file: Path) -> None:
    for each in (read_image(file), read_picture(file)):
        assert (each.dtype, each.ndim, each.size > 0) == (np.uint8, 3, True), (each.dtype, each.shape)
    source = open_source(file.parent, FrameSelection(), 25.0)
    assert source.expected_frames == len(list(source.frames(64)))
    open_pictures(file.parent)


def read_mattes(root: Path, file: Path) -> list[np.ndarray]:
    mattes = GivenMattes(root / "given/mattes", (32, 32))
    return [mattes.matte(number, whole_picture(32, 32, 32)) for number in range(3)]


def read_motion(root: Path, file: Path) -> Motion:
    return {".csv": read_live_link_face}.get(file.suffix, read_blendshape_json)(file)


def read_video(root: Path, file: Path) -> None:
    probe_video(file)
    count_frames(file)
    for seconds, frame in itertools.islice(read_video_frames(file, 512), SEEN):
        assert np.isfinite(seconds), seconds
        assert (frame.dtype, frame.ndim) == (np.uint8, 3), (frame.dtype, frame.shape)


def read_workspace(root: Path, file: Path) -> Any:
    workspace = open_workspace(root / "W")
    read_sequence(workspace.sequence_dir(workspace.pick_sequence(None)))
    return load_avatar(workspace.run_dir(workspace.pick_run(None)))


def read_analysis(root: Path, file: Path) -> Any:
    """Return what an analysis keeps: the parts, without what depends on the command."""
    given = root / RUN, [root / SEQUENCE], root / ANALYSIS, AnalysisOptions()
    return run_analysis(GROWTH, GROWTH.parts, *given)["parts"]


def read_dataset(root: Path, file: Path) -> Any:
    """Return what the dataset holds that a file belongs to: an avatar, or a list of sequences."""
    places = [path for path in (file, *file.parents) if root in path.parents]
    path = [path for path in places if any(each.recognises(path) is not None for each in datasets())] or places[-1:]
    found = recognised(path[0])[0].read(path[0], None)
    return found if isinstance(found, TrainedAvatar) else list(found)


def read_in_node(root: Path, file: Path) -> None:
    """Read an avatar with the web runtime, as pages do, and pose it."""
    command = ["node", str(_READER), str(root / "web/mien.js"), str(file)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, f"node ended with {done.returncode}: {done.stderr[-300:]}"
    found = json.loads(done.stdout)
    assert not found["message"].startswith("not told"), found["message"]
    if found["memory"] > 1 << 30:
        raise MemoryError(f"node took {found['memory'] >> 20} MiB")
    if found["message"]:
        raise UserError(f"{file}: {found['message']}")


def tally(root: Path, file: Path) -> str:
    key = read_key(root / "study/study.key.json")
    return tally_text(tally_content(key, read_all_answers([root / "study/answers.json"], key)))


# Uses -----------------------------------------------------------------------------------------------------------------


def nothing(root: Path, found: Any, dice: Random) -> None:
    pass


_MAY_BE_NAN = frozenset({"landmarks", "residuals", "pixel_residuals", "sharpness", "brightness", "clipped", "quality",
                         "timestamps", "source", "settings"})  # fmt: skip
"""Names of values that may be NaN, because a face was not found or the value is only shown."""


def expect_finite(root: Path, found: Any, dice: Random, name: str = "") -> None:
    """Check that all numbers in a value are finite, except for those where NaN means that something is unknown."""
    if isinstance(found, nn.Module):
        found = dict(found.state_dict())
    if isinstance(found, Tensor):
        found = found.detach().numpy()
    if is_dataclass(found) and not isinstance(found, type):
        found = {field.name: getattr(found, field.name) for field in fields(found)}
    if name not in _MAY_BE_NAN:
        if isinstance(found, (float, np.ndarray)):
            assert not isinstance(found, np.ndarray) or found.dtype.kind in "fiub", found.dtype
            assert np.isfinite(found).all(), f"{name} holds numbers that are not finite"
        named = found.items() if isinstance(found, dict) else ()
        listed = found if isinstance(found, (tuple, list)) else ()
        for key, item in (*named, *((name, item) for item in listed)):
            expect_finite(root, item, dice, str(key))


def expect_rows(root: Path, found: np.ndarray, dice: Random) -> None:
    assert found.shape == (3, 478, 2), found.shape
    assert not np.isinf(found).any()


def expect_motion(root: Path, found: Motion, dice: Random) -> None:
    assert all(np.isfinite(getattr(found, field.name)).all() for field in fields(found) if field.name != "notes")
    assert all("\n" not in note for note in found.notes)
    assert 0 < found.fps <= 1e6, found.fps


def use_capture(root: Path, found: Any, dice: Random) -> None:
    expect_finite(root, found.calibration, dice)
    assert found.images[0, 0].shape == (found.height, found.width, 3)
    np.asarray(found.mattes[-1, -1]).sum()
    found.usable  # noqa: B018
    if dice.random() < 0.3:
        use_run(root, None, dice)


def use_run(root: Path, found: Any, dice: Random) -> None:
    dice.choice((use_evaluation, use_training, use_rendering))(root, found, dice)


def use_evaluation(root: Path, found: Any, dice: Random) -> None:
    evaluate(root / RUN, [root / SEQUENCE], QUICK)
    read_metrics(root / RUN)


def use_training(root: Path, found: Any, dice: Random) -> None:
    run = root / (RUN if dice.random() < 0.7 else "W/runs/new")
    if dice.random() < 0.7:
        with contextlib.suppress(IsADirectoryError):
            (run / "training.json").unlink(missing_ok=True)
    settings = replace(SETTINGS, split="tail")
    settings = settings if run.name == "toy" else replace(settings, steps=2)
    train([read_sequence(root / SEQUENCE)], toy_face_model(), CONFIG, settings, run)


def use_rendering(root: Path, found: Any, dice: Random) -> None:
    avatar, sequence = load_avatar(root / RUN), read_sequence(root / SEQUENCE)
    face = sequence.tracking.face
    driven = drive(face, face[0], avatar.subject, avatar.face_model.expression_bounds, who=str(root / SEQUENCE))
    for each in (run_camera(root / RUN), sequence.tracking.cameras[0]):
        _draw(avatar.pose(driven[0]).gaussians.timestep(0), each.fitted(32, 32))


@torch.no_grad()
def _draw(gaussians: Any, camera: Any = None) -> None:
    image = rasterize(gaussians, toy_camera(32) if camera is None else camera, _WHITE).image
    assert image.isfinite().all(), "a picture that is not finite"


def use_comparison(root: Path, found: Any, dice: Random) -> None:
    for more in ("", " --json"):
        run_line(f"evaluate compare {{W}}{more}", root)


def use_avatar(root: Path, found: Any, dice: Random) -> None:
    expect_finite(root, found, dice)
    with torch.no_grad():
        gaussians = found.pose(found.subject).gaussians.timestep(0)
        _draw(gaussians)
        if dice.random() < 0.3:
            write_ply(root / "out.ply", in_world(gaussians))
            write_portable(root / "out.mien", make_portable(found, toy_camera(32), str(root)))


def use_face_model(root: Path, found: Any, dice: Random) -> None:
    """Use a model, or one in FLAME's schema."""
    expect_finite(root, found, dice)
    found = found if isinstance(found, FaceModel) else flame_face_model(found, "tiny")
    vertices = found.vertices_reference(found.neutral(1))
    assert all(found.landmark_positions(vertices, name).isfinite().all() for name in found.landmarks)


def use_portable(root: Path, found: Any, dice: Random) -> None:
    expect_finite(root, found, dice)
    avatar = Avatar(found)
    assert max(found.camera.width, found.camera.height) <= 1 << 15, "a camera of this size was let in"
    avatar.pose(dict.fromkeys(avatar.expression_names, 0.5))
    image, _ = avatar.render(avatar.pose(), found.camera.resized(32, 32))
    assert np.isfinite(image).all(), "a picture that is not finite"


def use_gaussians(root: Path, found: Any, dice: Random) -> None:
    expect_finite(root, found, dice)
    if len(found) < 100_000:
        _draw(found)


def use_cameras(root: Path, found: Any, dice: Random) -> None:
    expect_finite(root, found, dice)
    gaussians = read_ply(root / "head.ply")
    for camera in found[:2]:
        _draw(gaussians, camera.fitted(32, 32))
        _draw(gaussians, replace(camera, width=min(camera.width, 64), height=min(camera.height, 64)))


def use_gaussian_avatars(root: Path, found: Any, dice: Random) -> None:
    """Pose and draw what a folder holds, and write it as the run and the folder that a user would make of it."""
    expect_finite(root, (found.avatar, found.face), dice)
    camera, timestep = front_camera(found.avatar).fitted(32, 32), dice.randrange(len(found.face))
    _draw(found.avatar.pose(found.face[timestep]).gaussians.timestep(0), camera)
    if found.avatar.face_model.shareable and dice.random() < 0.3:  # the others need the user's own copy of the model
        write_imported_run(root / "I/runs/a", found.avatar, found.face, camera, root / "gaussian_avatars")
        again = load_avatar(root / "I/runs/a")
        write_gaussian_avatars_folder(root / "again", again, read_face_track(root / "I/runs/a", again.face_model))


def use_sequences(root: Path, found: Any, dice: Random) -> None:
    """Write the sequences of a dataset as an import does, and read them as training does."""
    for sequence in found:
        expect_finite(root, sequence.tracking, dice)
        folder = Workspace(root / "I").sequence_dir(sequence.capture.name)
        write_sequence(folder, sequence, datasets()[0], root)
        read_sequence(folder)


def use_rig(root: Path, found: list[CalibratedCamera], dice: Random) -> None:
    """Straighten a picture of every camera, and read the calibration in the other usual ways."""
    for one in found[:3]:
        expect_finite(root, one.camera, dice)
        if one.lens is not None:
            assert one.lens.straighten(np.zeros((32, 32, 3), np.uint8)).shape == (32, 32, 3)
            assert np.isfinite(one.lens.straighten_points(np.full((4, 2), 7.0), 32, 32)).all()
    for reading in readings_of([one.camera for one in found[:3]]):
        expect_finite(root, reading.cameras, dice)


def use_config(root: Path, found: ConfigFile, dice: Random) -> None:
    """Make the options of `mien train` of the file, as its command line does, and check them."""
    method = ["--method", dice.choice(list(METHODS))] if found.method is None else []
    TrainOptions.chosen(["--config", str(found.path), *method]).check()
    if dice.random() < 0.3:
        with contextlib.suppress(UserError):  # there is no such workspace
            run_line(f"train {{root}}/none --config {found.path}", root)


def run_line(line: str, root: Path) -> None:
    """Run a command in this process, with W, root in place of {W}, {root}. A refusal is raised as a `UserError`."""
    run_words([word.format(W=root / "W", root=root) for word in line.split()], root)


def run_words(words: list[str], root: Path) -> None:
    """Run a command in this process. A refusal is raised as a `UserError`, another end as a `CommandError`."""
    os.environ["MIEN_CACHE"] = str(root / "cache")
    told, shown = io.StringIO(), io.StringIO()
    with contextlib.redirect_stderr(told), contextlib.redirect_stdout(shown):
        try:
            code: Any = cli.main(words)
        except SystemExit as stop:
            code = stop.code
    assert all(map(is_one_line, shown.getvalue().split("\n"))), "control characters on standard output"
    lines = [line for line in told.getvalue().splitlines() if line.startswith("mien: ")]
    if code == cli.EXIT_USER_ERROR and len(lines) == 1:
        raise UserError(lines[0])
    if code == cli.EXIT_INTERRUPTED:
        raise UserError("stopped")
    if code != 0:
        logs = sorted(Path(tempfile.gettempdir()).glob("mien-crash-*.log"))
        text = logs[-1].read_text() if logs else told.getvalue()
        raise CommandError(f"{words[:1]}: exit code {code}, {len(lines)} lines; {text[-1500:]}")
