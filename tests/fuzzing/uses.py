"""Use what was read as people do, to check that accepted files do no harm later."""

import contextlib
import io
import os
import tempfile
from contextlib import suppress
from dataclasses import fields, replace
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import torch

from fuzzing import content
from fuzzing.material import CONFIG, QUICK, RUN, SEQUENCE, SETTINGS
from mien import cli
from mien.avatar import load_avatar
from mien.avatar.baking import make_portable
from mien.commands.stages.importing import front_camera
from mien.datasets import datasets, write_sequence
from mien.driving import Motion, drive
from mien.errors import UserError
from mien.evaluation import evaluate
from mien.evaluation import read_metrics as read_figures
from mien.evaluation.compare import compare_runs
from mien.evaluation.compare_report import comparison_html
from mien.evaluation.partial import PartialScores
from mien.evaluation.text import comparison_text
from mien.export import in_world, write_gaussian_avatars_folder, write_ply
from mien.export import read_ply as read_gaussians
from mien.face import FaceModel
from mien.face.flame import flame_face_model
from mien.render import rasterize
from mien.runtime import Avatar, write_portable
from mien.training import read_face_track, read_sequence, train, write_imported_run
from mien.training.run import run_camera
from mien.workspace import Workspace
from toy_scene import toy_camera, toy_face_model


class CommandError(Exception):
    """A command ended in a way that commands must not end."""


def nothing(root: Path, found: Any, dice: Random) -> None:
    """Do nothing else."""


def expect_finite(root: Path, found: Any, dice: Random) -> None:
    content.expect_finite(found)


def expect_rows(root: Path, found: np.ndarray, dice: Random) -> None:
    assert found.shape == (3, 478, 2), found.shape
    assert not np.isinf(found).any()


def expect_motion(root: Path, found: Motion, dice: Random) -> None:
    numbers = [getattr(found, field.name) for field in fields(found) if field.name != "notes"]
    assert all(np.isfinite(number).all() for number in numbers)
    assert all("\n" not in note for note in found.notes)
    assert 0 < found.fps <= 1e6, found.fps


def use_capture(root: Path, found: Any, dice: Random) -> None:
    content.expect_finite(found.calibration)
    assert found.images[0, 0].shape == (found.height, found.width, 3)
    np.asarray(found.mattes[-1, -1]).sum()
    found.usable  # noqa: B018
    if dice.random() < 0.3:
        use_run(root, None, dice)


def use_run(root: Path, found: Any, dice: Random) -> None:
    dice.choice((use_evaluation, use_training, use_rendering))(root, found, dice)


def use_evaluation(root: Path, found: Any, dice: Random) -> None:
    evaluate(root / RUN, [root / SEQUENCE], QUICK)
    read_figures(root / RUN)


def use_training(root: Path, found: Any, dice: Random) -> None:
    run = root / (RUN if dice.random() < 0.7 else "W/runs/new")
    if dice.random() < 0.7:
        with suppress(IsADirectoryError):
            (run / "training.json").unlink(missing_ok=True)
    settings = replace(SETTINGS, split="tail")
    settings = settings if run.name == "toy" else replace(settings, steps=2)
    train([read_sequence(root / SEQUENCE)], toy_face_model(), CONFIG, settings, run)


def use_rendering(root: Path, found: Any, dice: Random) -> None:
    avatar, sequence = load_avatar(root / RUN), read_sequence(root / SEQUENCE)
    camera = run_camera(root / RUN).fitted(32, 32)
    face = sequence.tracking.face
    driven = drive(face, face[0], avatar.subject, avatar.face_model.expression_bounds, who=str(root / SEQUENCE))
    with torch.no_grad():
        for each in (camera, sequence.tracking.cameras[0].fitted(32, 32)):
            image = rasterize(avatar.pose(driven[0]).gaussians.timestep(0), each, torch.ones(3)).image
            assert image.isfinite().all(), "a picture that is not finite"


def use_partial(root: Path, found: Any, dice: Random) -> None:
    """Add and forget scores, and evaluate with the faulty lines after the correct first one."""
    for file in (root / RUN).glob(".*.partial"):
        kept = PartialScores(file, "0")
        kept.read()
    use_evaluation(root, found, dice)


def use_comparison(root: Path, found: Any, dice: Random) -> None:
    comparison = compare_runs({"a": root / RUN})
    comparison_text(comparison, bold=False)
    comparison.content()
    comparison_html(comparison, [[]] * len(comparison.tables))


def use_avatar(root: Path, found: Any, dice: Random) -> None:
    content.expect_finite(found)
    with torch.no_grad():
        gaussians = found.pose(found.subject).gaussians.timestep(0)
        rasterize(gaussians, toy_camera(32), torch.ones(3))
        if dice.random() < 0.3:
            write_ply(root / "out.ply", in_world(gaussians))
            write_portable(root / "out.mien", make_portable(found, toy_camera(32), str(root)))


def use_face_model(root: Path, found: FaceModel, dice: Random) -> None:
    content.expect_finite(found)
    found(found.neutral(2))
    vertices = found.vertices_reference(found.neutral(1))
    for name in found.landmarks:
        assert found.landmark_positions(vertices, name).isfinite().all()


def use_portable(root: Path, found: Any, dice: Random) -> None:
    content.expect_finite(found)
    avatar = Avatar(found)
    assert max(found.camera.width, found.camera.height) <= 1 << 15, "a camera of this size was let in"
    posed = avatar.pose()
    avatar.pose(dict.fromkeys(avatar.expression_names, 0.5))
    image, _ = avatar.render(posed, found.camera.resized(32, 32))
    assert np.isfinite(image).all(), "a picture that is not finite"


def use_gaussians(root: Path, found: Any, dice: Random) -> None:
    content.expect_finite(found)
    if len(found) < 100_000:
        image = rasterize(found, toy_camera(32), torch.ones(3)).image
        assert image.isfinite().all(), "a picture that is not finite"


def use_cameras(root: Path, found: Any, dice: Random) -> None:
    content.expect_finite(found)
    gaussians = read_gaussians(root / "head.ply")
    for camera in found[:2]:
        for each in (
            camera.fitted(32, 32),
            replace(camera, width=min(camera.width, 64), height=min(camera.height, 64)),
        ):
            assert rasterize(gaussians, each, torch.ones(3)).image.isfinite().all(), "a picture that is not finite"


def use_flame(root: Path, found: Any, dice: Random) -> None:
    content.expect_finite(found)
    model = flame_face_model(found, "tiny")
    content.expect_finite(model)
    model(model.neutral(1))


def use_gaussian_avatars(root: Path, found: Any, dice: Random) -> None:
    """Pose and draw what a folder holds, and write it as the run and the folder that a user would make of it."""
    content.expect_finite(found.avatar)
    content.expect_finite(found.face)
    timestep = dice.randrange(len(found.face))
    camera = front_camera(found.avatar).fitted(32, 32)
    with torch.no_grad():
        gaussians = found.avatar.pose(found.face[timestep]).gaussians.timestep(0)
        assert rasterize(gaussians, camera, torch.ones(3)).image.isfinite().all(), "a picture that is not finite"
    if found.avatar.face_model.shareable and dice.random() < 0.3:  # the others need the user's own copy of the model
        write_imported_run(root / "I/runs/a", found.avatar, found.face, camera, root / "gaussian_avatars")
        again = load_avatar(root / "I/runs/a")
        write_gaussian_avatars_folder(root / "again", again, read_face_track(root / "I/runs/a", again.face_model))


def use_sequences(root: Path, found: Any, dice: Random) -> None:
    """Write the sequences of a dataset as an import does, and read them as training does."""
    workspace = Workspace(root / "I")
    for sequence in found:
        content.expect_finite(sequence.tracking)
        folder = workspace.sequence_dir(sequence.capture.name)
        write_sequence(folder, sequence, datasets()[0], root)
        read_sequence(folder)


LINES = (
    "render {W} --out {root}/o.png --width 16 --height 16", "render {W} --out {root}/o.png --size 16 --path captured",
    "render {W} --out {root}/o.png --size 16 --sequence clip",
    "render {W} --out {root}/o_%03d.png --size 16 --frames 2", "drive {W} --by {W} --out {root}/o.mp4 --size 16",
    "export {W} --out {root}/o.ply",
    "export {W} --out {root}/o.mien", "export {W} --out {root}/o.ply --series clip", "evaluate {W} --no-perceptual",
    "evaluate {W} --compare", "evaluate {W} --compare --json",
    "train {W} --steps 1 --run other", "train {W} --steps 1 --run toy", "track {W} --again", "track {W}",
    "face-models", "face-models --json", "analyze gaussian-avatars {W} --parts growth",
    "analyze gaussian-avatars {W} --parts growth --json", "export {W} --out {root}/o --format gaussian-avatars",
    "track {W} --hold-out clip",
)  # fmt: skip
IMPORTS = (
    "import {root}/gaussian_avatars --out {root}/new", "import {root}/gaussian_avatars --out {root}/new --run other",
)  # fmt: skip


def run_a_line(root: Path, found: Any, dice: Random) -> None:
    """Run one command on the faulty workspace, in this process."""
    run_line(dice.choice(LINES), root)


def run_an_import(root: Path, found: Any, dice: Random) -> None:
    """Import the faulty folder, in this process, and draw what was made of it."""
    run_line(dice.choice(IMPORTS), root)
    run_line("render {root}/new --out {root}/o.png --size 16 --timestep 1", root)


def run_line(line: str, root: Path) -> None:
    """Run a command in this process. A refusal is raised as a `UserError`."""
    os.environ["MIEN_CACHE"] = str(root / "cache")
    words = [word.format(W=root / "W", root=root) for word in line.split()]
    told = io.StringIO()
    with contextlib.redirect_stderr(told), contextlib.redirect_stdout(io.StringIO()):
        try:
            code: Any = cli.main(words)
        except SystemExit as stop:
            code = stop.code
    lines = [line for line in told.getvalue().splitlines() if line.startswith("mien: ")]
    if code == cli.EXIT_USER_ERROR and len(lines) == 1:
        raise UserError(lines[0])
    if code != 0:
        raise CommandError(f"{words[0]}: exit code {code}, {len(lines)} lines; {_crash()}")


def _crash() -> str:
    logs = sorted(Path(tempfile.gettempdir()).glob("mien-crash-*.log"))
    text = logs[-1].read_text() if logs else ""
    for log in logs:
        log.unlink()
    return text[-1500:]
