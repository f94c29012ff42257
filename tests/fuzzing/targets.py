"""List the targets of the fuzzer: the file that is made faulty, its reader, and the use of what was read."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

from fuzzing import exchange, faults, reads, uses
from fuzzing.faults import Place
from fuzzing.material import ANALYSIS, RUN, SEQUENCE

Read = Callable[[Path, Path], Any]
"""Reader that takes the folder with the copies and the faulty file."""
Use = Callable[[Path, Any, Random], None]
"""Use of what was read. It also takes the folder with the copies, and dice for its choices."""


@dataclass(frozen=True)
class Target:
    """A kind of file."""

    name: str
    format: str
    """Name of the format in the table of results."""
    files: str
    """Pattern of the files below the material."""
    parts: tuple[str, ...]
    """Parts of the material that the reader needs."""
    read: Read
    use: Use = uses.nothing
    exact: bool = False
    """Whether files with unrepaired damage must be refused or give exactly the same content."""
    fault: Callable[[Place, Random], str] = faults.faulty_file
    weight: float = 1.0
    """Relative frequency among the targets."""
    named: bool = True
    """Whether the message must name a file of the folder."""


def _in_workspaces() -> tuple[Target, ...]:
    run, clip, whole = RUN, SEQUENCE, ("W",)
    return (
        Target("capture.json", "capture", f"{clip}/capture/capture.json", whole, reads.read_capture,
               uses.use_capture, True, weight=2),
        Target("landmarks.safetensors", "capture", f"{clip}/capture/landmarks.safetensors", whole,
               reads.read_capture, uses.use_capture, True, weight=2),
        Target("frames", "capture", f"{clip}/capture/*/*/*.png", whole, reads.read_capture, uses.use_capture, True),
        Target("cache", "capture", f"{clip}/capture/cache/*", whole, reads.read_capture, uses.use_capture,
               fault=faults.faulty_without_damage),
        Target("tracking.json", "tracking", f"{clip}/tracking/tracking.json", whole, reads.read_tracking,
               uses.use_run, True, weight=2),
        Target("tracking.safetensors", "tracking", f"{clip}/tracking/tracking.safetensors", whole,
               reads.read_tracking, uses.use_run, True, weight=3),
        Target("scoring.json", "scoring", f"{clip}/scoring/scoring.json", whole, reads.read_scoring, uses.use_run,
               True, weight=1.5),
        Target("crops.safetensors", "scoring", f"{clip}/scoring/crops.safetensors", whole, reads.read_scoring,
               uses.use_run, True, weight=1.5),
        Target("masks", "scoring", f"{clip}/scoring/masks/*/*.png", whole, reads.read_scoring, uses.use_run, True),
        Target("config.json", "run", f"{run}/config.json", whole, reads.read_config, uses.use_run, True, weight=2),
        Target("training.json", "run", f"{run}/training.json", whole, reads.read_summary, uses.use_evaluation, True),
        Target("curves.safetensors", "run", f"{run}/curves.safetensors", whole, reads.read_curves,
               uses.use_evaluation, True),
        Target("face_track.safetensors", "run", f"{run}/face_track.safetensors", whole, reads.read_face_track,
               uses.use_evaluation, True),
        Target("checkpoints", "run", f"{run}/checkpoints/*.safetensors", whole, reads.resume_run, uses.use_training,
               weight=2),
        Target("metrics.json", "metrics", f"{run}/metrics.json", whole, reads.read_metrics, uses.use_comparison,
               True, weight=2),
        Target("analysis.json", "analysis", f"{ANALYSIS}/analysis.json", whole, reads.read_analysis,
               exact=True, weight=2),
        Target("charts of an analysis", "analysis", f"{ANALYSIS}/*.png", whole, reads.read_analysis, weight=0.3),
        Target("partial scores", "partial files", f"{run}/.*.partial", whole, reads.read_partial, uses.use_partial,
               fault=faults.faulty_lines),
        Target("tracking pieces", "partial files", "pieces/*.safetensors", ("pieces",), reads.go_on_tracking,
               weight=0.3, named=False),
    )  # fmt: skip


def _avatars_and_given_files() -> tuple[Target, ...]:
    run, whole, folder = RUN, ("W",), "GaussianAvatars' folder"
    return (
        Target("avatar.json", "avatar", f"{run}/avatar/avatar.json", whole, reads.read_avatar, uses.use_avatar,
               True, weight=2),
        Target("avatar.safetensors", "avatar", f"{run}/avatar/avatar.safetensors", whole, reads.read_avatar,
               uses.use_avatar, True, weight=2),
        Target("avatar's face_model.json", "avatar", f"{run}/avatar/face_model.json", whole, reads.read_avatar,
               uses.use_avatar, True, weight=1.5),
        Target("avatar's face_model.safetensors", "avatar", f"{run}/avatar/face_model.safetensors", whole,
               reads.read_avatar, uses.use_avatar, True, weight=2),
        Target("added face models", "face model", "cache/face_models/added/*", ("cache",), reads.read_added,
               uses.use_face_model, weight=2, named=False),
        Target("head.mien", ".mien", "head.mien", ("head.mien",), reads.read_portable, uses.use_portable, True,
               faults.faulty_portable, 4),
        Target("head.ply", ".ply", "head.ply", ("head.ply",), reads.read_ply, uses.use_gaussians, weight=2),
        Target("pictures", "pictures", "pictures/*", ("pictures",), reads.read_pictures, weight=5),
        Target("mattes", "pictures", "given/mattes/*", ("given",), reads.read_mattes, uses.expect_finite),
        Target("points", "landmarks", "given/points.*", ("given",), reads.read_points, uses.expect_rows, weight=2),
        Target("crops.json", "crops, cameras", "given/crops.json", ("given",), reads.read_crops, uses.expect_finite),
        Target("cameras.json", "crops, cameras", "given/cameras.json", ("given", "head.ply"), reads.read_cameras,
               uses.use_cameras, weight=1.5),
        Target("take.csv", "motion", "given/take.csv", ("given",), reads.read_motion, uses.expect_motion, weight=2),
        Target("take.json", "motion", "given/*take.json", ("given",), reads.read_motion, uses.expect_motion, weight=2),
        Target("tiny.npz", "FLAME's schema", "flame/tiny.npz", ("flame",), reads.read_flame, uses.use_flame, weight=2),
        Target("tiny.pkl", "FLAME's schema", "flame/tiny.pkl", ("flame",), reads.read_flame, uses.use_flame, weight=2),
        Target("point_cloud.ply", folder, "gaussian_avatars/point_cloud.ply", ("gaussian_avatars",),
               reads.read_dataset, uses.use_gaussian_avatars, weight=2),
        Target("flame_param.npz", folder, "gaussian_avatars/flame_param.npz", ("gaussian_avatars",),
               reads.read_dataset, uses.use_gaussian_avatars, weight=2),
        Target("folder's face model", folder, "gaussian_avatars/face_model.*", ("gaussian_avatars",),
               reads.read_dataset, uses.use_gaussian_avatars, True),
        Target("folder on FLAME", folder, "flame_avatars/*", ("flame_avatars", "flame"),
               reads.read_avatar_on_flame, uses.use_gaussian_avatars),
        Target("imports", folder, "gaussian_avatars/*", ("gaussian_avatars", "cache"), reads.nothing_read,
               uses.run_an_import, fault=faults.any_fault, weight=0.5, named=False),
        Target("videos", "videos", "videos/*", ("videos",), reads.read_video, weight=3),
        Target("playlists", "videos", "videos/clip.mp4", ("videos",), reads.read_no_playlist,
               fault=faults.write_playlist, weight=1),
        Target("names", "names", "[gpv]*/*.*", ("given", "pictures", "videos"), reads.read_by_ending,
               fault=faults.rename, named=False),
        Target("places", "workspace", "W/**/*", ("W",), reads.read_workspace, uses.use_run,
               fault=faults.faulty_place, weight=4),
        Target("commands", "workspace", "W/**/*", ("W", "cache"), reads.nothing_read, uses.run_a_line,
               fault=faults.any_fault, weight=1, named=False),
    )  # fmt: skip


def _exchanged_files() -> tuple[Target, ...]:
    exports, study, usd = ("exports",), ("study",), "USD"
    stages = (
        Target(f"head.{ending}", usd, f"exports/head.{ending}", exports, exchange.read_splats, uses.use_gaussians,
               fault=faults.faulty_new_name)
        for ending in ("usd", "usda", "usdc", "usdz")
    )  # fmt: skip
    return (
        Target("scene of a .glb", ".glb", "exports/head.glb", exports, exchange.read_scene, weight=2),
        Target("avatar of a .glb", ".glb", "exports/head.glb", exports, exchange.read_avatar_of_glb,
               uses.use_portable, weight=2),
        Target("head.spz", ".spz", "exports/head.spz", exports, exchange.read_splats, uses.use_gaussians, weight=3),
        Target("head.sog", ".sog", "exports/head.sog", exports, exchange.read_splats, uses.use_gaussians, weight=3),
        *stages,
        Target("head.packed", ".packed, in node", "packed/*.packed", ("packed", "web"), exchange.read_in_node,
               fault=faults.faulty_content, weight=3),
        Target("head.mien in node", ".packed, in node", "head.mien", ("head.mien", "web"), exchange.read_in_node,
               fault=faults.faulty_content),
        Target("sounds", "sounds", "sounds/*", ("sounds",), exchange.read_sound, uses.expect_motion, weight=4),
        Target("rig.json", "calibrations", "rig/rig.json", ("rig",), exchange.read_rig, exchange.use_rig, weight=2),
        Target("takes", "motion", "takes/*", ("takes",), reads.read_motion, uses.expect_motion, weight=4),
        Target("study.key.json", "study", "study/study.key.json", study, exchange.tally, exact=True),
        Target("answers.json", "study", "study/answers.json", study, exchange.tally),
        Target("config files", "--config", "configs/*.json", ("configs",), exchange.read_config, exchange.use_config,
               weight=2),
    )  # fmt: skip


TARGETS = {target.name: target for target in (*_in_workspaces(), *_avatars_and_given_files(), *_exchanged_files())}


def present(material: Path) -> list[str]:
    """Return the targets whose files could be written here. Some need node, or USD's library."""
    return [
        target.name
        for target in TARGETS.values()
        if all((material / part).exists() for part in target.parts) and any(material.glob(target.files))
    ]


def spread(total: int, names: list[str]) -> list[tuple[str, int]]:
    """Divide cases among the targets by their weights. They are mixed, so that any part of them holds all targets."""
    chosen = [TARGETS[name] for name in names]
    share = total / sum(target.weight for target in chosen)
    places = []
    for target in chosen:
        amount = max(1, math.ceil(share * target.weight))
        places += [((number + 0.5) / amount, target.name, number) for number in range(amount)]
    return [(name, number) for _, name, number in sorted(places)]
