"""The readers of mien: the file that is made faulty, how it is read, and the use of what was read."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

from fuzzing import commands, faults, lines, uses
from fuzzing.faults import Place
from fuzzing.material import ANALYSIS, PIECES, RUN, SEQUENCE, go_on
from mien.avatar import load_avatar
from mien.capture import read_capture
from mien.capture.cameras.calibration import read_calibration
from mien.capture.person.given import read_landmarks
from mien.commands.batch_table import read_table
from mien.commands.train_options import read_config_file
from mien.driving.speech import motion_of_sound
from mien.evaluation.image_folders import read_crops
from mien.evaluation.load import load_experiments
from mien.evaluation.metrics_file import read_metrics
from mien.evaluation.protocols import PartialScores
from mien.face.models.flame import flame_face_model, read_flame
from mien.formats import read_ply
from mien.formats.gaussian_avatars import read_gaussian_avatars_folder
from mien.formats.glb import read_glb_avatar
from mien.media.video import read_sound
from mien.render.camera_paths import read_cameras
from mien.runtime import read_portable
from mien.tracking import read_tracking
from mien.tracking.scoring_files import read_scoring
from mien.training.colors import read_gains
from mien.training.run import read_curves, read_run_config, read_training_summary, run_camera

Read = Callable[[Path, Path], Any]
"""Reader that takes the folder with the copies and the faulty file."""
Use = Callable[[Path, Any, Random], None]
"""Use of what was read. It also takes the folder with the copies, and dice for its choices."""


@dataclass(frozen=True)
class Target:
    """A kind of file."""

    name: str
    files: str
    """Pattern of the files below the material. Its first part is what the reader needs, besides `parts`."""
    read: Read
    use: Use = uses.nothing
    weight: float = 1.0
    """Relative frequency among the targets."""
    exact: bool = False
    """Whether files with unrepaired damage must be refused or give exactly the same content."""
    fault: Callable[[Place, Random], str] = faults.faulty_file
    parts: tuple[str, ...] = ()
    """Further parts of the material that the reader needs."""
    named: bool = True
    """Whether the message must name a file of the folder."""

    @property
    def needs(self) -> tuple[str, ...]:
        """The parts of the material that are copied for a case."""
        return tuple(
            dict.fromkeys((*self.parts, *([] if "*" in self.files.split("/")[0] else self.files.split("/")[:1])))
        )


def _of(read: Callable[[Path], Any], place: str = "") -> Read:
    """Return a reader of the file itself, or of a folder of the material."""
    return lambda root, file: read(root / place if place else file)


_CAPTURE, _TRACKING, _SCORING = f"{SEQUENCE}/capture", f"{SEQUENCE}/tracking", f"{SEQUENCE}/scoring"
_READ_CAPTURE, _READ_TRACKING = _of(read_capture, _CAPTURE), _of(read_tracking, _TRACKING)
_READ_SCORING, _READ_AVATAR = _of(read_scoring, _SCORING), _of(load_avatar, RUN)
_FOLDER = {"read": uses.read_dataset, "use": uses.use_gaussian_avatars}


def _config(root: Path, file: Path) -> Any:
    return uses.known(read_run_config(root / RUN)), run_camera(root / RUN)


def _on_flame(root: Path, file: Path) -> Any:
    model = flame_face_model(read_flame(root / "flame/tiny.npz"), "tiny")
    return read_gaussian_avatars_folder(root / "flame_avatars", model)


_TARGETS = (
    Target("capture.json", f"{_CAPTURE}/capture.json", _READ_CAPTURE, uses.use_capture, 2, True),
    Target("landmarks.safetensors", f"{_CAPTURE}/landmarks.safetensors", _READ_CAPTURE, uses.use_capture, 2, True),
    Target("frames", f"{_CAPTURE}/*/*/*.png", _READ_CAPTURE, uses.use_capture, 1, True),
    Target("cache", f"{_CAPTURE}/cache/*", _READ_CAPTURE, uses.use_capture, fault=faults.any_fault),
    Target("tracking.json", f"{_TRACKING}/tracking.json", _READ_TRACKING, uses.use_run, 2, True),
    Target("tracking.safetensors", f"{_TRACKING}/tracking.safetensors", _READ_TRACKING, uses.use_run, 3, True),
    Target("scoring.json", f"{_SCORING}/scoring.json", _READ_SCORING, uses.use_run, 1.5, True),
    Target("crops.safetensors", f"{_SCORING}/crops.safetensors", _READ_SCORING, uses.use_run, 1.5, True),
    Target("masks", f"{_SCORING}/masks/*/*.png", _READ_SCORING, uses.use_run, 1, True),
    Target("config.json", f"{RUN}/config.json", _config, uses.use_run, 2, True),
    Target("training.json", f"{RUN}/training.json", lambda root, file: uses.known(read_training_summary(root / RUN)),
           uses.use_evaluation, 1, True),
    Target("curves.safetensors", f"{RUN}/curves.safetensors", _of(read_curves, RUN), uses.use_evaluation, 1, True),
    Target("face_track.safetensors", f"{RUN}/face_track.safetensors", uses.read_track, uses.use_evaluation, 1, True),
    Target("checkpoints", f"{RUN}/checkpoints/*.safetensors", uses.resume_run, uses.use_training, 2),
    Target("faces of a run", f"{RUN}/face_track.safetensors",
           lambda root, file: load_experiments(root / RUN, [root / SEQUENCE]), weight=0.3),
    Target("gains", f"{RUN}/gains.safetensors", lambda root, file: read_gains(root / RUN, [5]), uses.use_evaluation,
           1.5, True),
    Target("metrics.json", f"{RUN}/metrics.json", lambda root, file: uses.known(read_metrics(root / RUN)),
           uses.use_comparison, 2, True),
    Target("analysis.json", f"{ANALYSIS}/analysis.json", uses.read_analysis, weight=2, exact=True),
    Target("charts", f"{ANALYSIS}/*.svg", uses.read_analysis, weight=0.3),
    Target("partial scores", f"{RUN}/.*.partial", lambda root, file: PartialScores(file, "0").read(),
           uses.use_evaluation, fault=faults.any_fault),
    Target("pieces", f"{PIECES}/*.safetensors", lambda root, file: go_on(root / PIECES), weight=0.3, named=False),
    Target("avatar.json", f"{RUN}/avatar/avatar.json", _READ_AVATAR, uses.use_avatar, 2, True),
    Target("avatar.safetensors", f"{RUN}/avatar/avatar.safetensors", _READ_AVATAR, uses.use_avatar, 2, True),
    Target("face_model.json", f"{RUN}/avatar/face_model.json", _READ_AVATAR, uses.use_avatar, 1.5, True),
    Target("face_model.safetensors", f"{RUN}/avatar/face_model.safetensors", _READ_AVATAR, uses.use_avatar, 2, True),
    Target("avatars", "avatars/*/avatar.*", lambda root, file: load_avatar(file.parent), uses.use_avatar, 3),
    Target("names in avatars", "avatars/*/avatar.json", lambda root, file: load_avatar(file.parent), weight=0.2,
           named=False),
    Target("added face models", "cache/face_models/added/*", uses.read_added, uses.use_face_model, 2, named=False),
    Target("head.mien", "head.mien", _of(read_portable), uses.use_portable, 2, True),
    Target("miens", "miens/*", _of(read_portable), uses.use_portable, 3),
    Target("head.ply", "head.ply", _of(read_ply), uses.use_gaussians, 2),
    Target("pictures", "pictures/*", uses.read_pictures, weight=5),
    Target("mattes", "given/mattes/*", uses.read_mattes, uses.expect_finite),
    Target("points", "given/points.*", lambda root, file: read_landmarks(file, 3), uses.expect_rows, 2),
    Target("films", "films/*", commands.read_film, commands.capture_film, 3),
    Target("alphas", "alphas/*", lambda root, file: commands.read_film(root, file.parent), commands.capture_film, 2),
    Target("driving pictures", "alphas/*", lambda root, file: None, commands.drive_by_pictures, named=False,
           fault=faults.any_fault, parts=("W", "cache")),
    Target("crops.json", "given/crops.json", _of(read_crops), uses.expect_finite),
    Target("cameras.json", "given/cameras.json", _of(read_cameras), uses.use_cameras, 1.5, parts=("head.ply",)),
    Target("rig.json", "rig/rig.json", _of(read_calibration), uses.use_rig, 2),
    Target("transforms.json", "nerfstudio/transforms.json", _of(read_calibration), uses.use_rig, 0.5),
    Target("take.csv", "given/take.csv", uses.read_motion, uses.expect_motion, 2),
    Target("take.json", "given/*take.json", uses.read_motion, uses.expect_motion, 2),
    Target("takes", "takes/*", uses.read_motion, uses.expect_motion, 4),
    Target("sounds", "sounds/*", _of(lambda path: motion_of_sound(read_sound(path))), uses.expect_motion, 3),
    Target("tables", "tables/people*", _of(read_table), commands.run_batch, 3),
    Target("states of a batch", "batch/states/*", commands.read_batch, commands.run_batch, 2, named=False,
           parts=("tables",)),
    Target("plan.json", "batch/plan.json", commands.read_batch, commands.run_batch, named=False, parts=("tables",)),
    Target("tiny.npz", "flame/tiny.npz", _of(read_flame), uses.use_face_model, 2),
    Target("tiny.pkl", "flame/tiny.pkl", _of(read_flame), uses.use_face_model, 2),
    Target("point_cloud.ply", "gaussian_avatars/point_cloud.ply", **_FOLDER, weight=2),
    Target("flame_param.npz", "gaussian_avatars/flame_param.npz", **_FOLDER, weight=2),
    Target("folder's face model", "gaussian_avatars/face_model.*", **_FOLDER, exact=True),
    Target("folder on FLAME", "flame_avatars/*", _on_flame, uses.use_gaussian_avatars, parts=("flame",)),
    Target("videos", "videos/*", uses.read_video, weight=3),
    Target("places", "W/**/*", uses.read_workspace, uses.use_run, 4, fault=faults.faulty_place),
    Target("lines", "W/**/*", lambda root, file: None, lines.run_an_odd_line, 3, fault=lines.faulty_or_not, named=False,
           parts=lines.PARTS),
    Target("avatar of a .glb", "exports/head.glb", _of(read_glb_avatar), uses.use_portable, 2),
    Target("splats", "splats/*", _of(read_ply), uses.use_gaussians, 4),
    Target("head.packed", "packed/*.packed", uses.read_in_node, weight=3, parts=("web",)),
    Target("head.mien in node", "head.mien", uses.read_in_node, parts=("web",)),
    Target("study.key.json", "study/study.key.json", uses.tally, exact=True),
    Target("answers.json", "study/answers.json", uses.tally),
    Target("config files", "configs/*.json", _of(read_config_file), uses.use_config, 2),
)  # fmt: skip
TARGETS = {target.name: target for target in _TARGETS}
"""The table of readers. That of damage has several parts: `formats.FORMATS` has random faults by the format of a file,
`faults.PLACES` what may lie in the place of a file, and `values.VALUES` single values that a reader must refuse."""


def present(material: Path) -> list[str]:
    """Return the targets whose files could be written here. Some need node."""
    return [
        target.name
        for target in TARGETS.values()
        if all((material / part).exists() for part in target.needs) and any(material.glob(target.files))
    ]


def spread(total: int, names: list[str]) -> list[str]:
    """Divide cases among the targets by their weights. They are mixed, so that any part of them holds all targets."""
    chosen = [TARGETS[name] for name in names]
    share = total / sum(target.weight for target in chosen)
    places = []
    for target in chosen:
        amount = max(1, math.ceil(share * target.weight))
        places += [((number + 0.5) / amount, target.name, number) for number in range(amount)]
    return [f"{name}:{{seed}}:{number}" for _, name, number in sorted(places)]
