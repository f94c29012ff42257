"""Write one whole file of each kind that mien writes or reads, to make faulty copies of."""

import contextlib
import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch

import train_toy
from fuzzing.archive_faults import npy_of, npz_of
from mien.avatar import METHODS, load_avatar
from mien.avatar.baking import make_portable
from mien.capture.video import write_video
from mien.evaluation import EvaluationSettings, evaluate
from mien.evaluation.partial import PartialScores
from mien.export import in_world, write_gaussian_avatars_folder, write_ply
from mien.face import Landmarks
from mien.face.cache import cache_folder
from mien.face.flame import flame_face_model, read_flame
from mien.face.listing import ADDED_RECIPE
from mien.face.loading import load_face_model, write_face_model, write_landmarks
from mien.lab.analysis import ANALYSES, AnalysisOptions, chosen_parts, run_analysis
from mien.runtime import write_portable
from mien.storage import write_json
from mien.training import read_face_track
from plain_settings import plain_config
from toy_scene import toy_camera, toy_face_model
from toy_workspace import write_toy_workspace
from what_users_give import write_what_users_give

RUN, SEQUENCE, ANALYSIS = "W/runs/toy", "W/sequences/clip", "W/analysis/toy"
GROWTH = replace(
    ANALYSES["gaussian-avatars"],
    parts=tuple(chosen_parts(ANALYSES["gaussian-avatars"], ("growth",), train=False)),
)
"""The part of an analysis that takes no time. The others draw large pictures or train."""
QUICK = EvaluationSettings(perceptual=False, video_frames=0)


def make_material(root: Path) -> None:
    """Write everything below `root`, with the same bytes every time on one machine."""
    root.mkdir(parents=True, exist_ok=True)
    write_toy_workspace(root / "W")
    _evaluate_and_keep_the_partial_file(root)
    avatar = load_avatar(root / RUN)
    write_portable(root / "head.mien", make_portable(avatar, toy_camera(32), "toy"))
    with torch.no_grad():
        write_ply(root / "head.ply", in_world(avatar.pose(avatar.subject).gaussians.timestep(0)))
    track = read_face_track(root / RUN, avatar.face_model)
    write_gaussian_avatars_folder(root / "gaussian_avatars", avatar, track)
    run_analysis(GROWTH, GROWTH.parts, root / RUN, [root / SEQUENCE], root / ANALYSIS, AnalysisOptions())
    _write_pictures(root / "pictures")
    write_what_users_give(root / "given", cv2.imread(str(root / "pictures/a.png")))  # type: ignore[arg-type]
    _write_face_models(root / "cache" / "face_models" / "added")
    load_face_model("anny")  # baked here once, since a command that bakes looks like one that hangs
    for file in (cache_folder() / "face_models").glob("*.*"):
        shutil.copy(file, root / "cache" / "face_models")
    (root / "flame").mkdir()
    (root / "flame/tiny.npz").write_bytes(npz_of({name: npy_of(array) for name, array in tiny_flame().items()}))
    from flame_like import write_pickle

    write_pickle(root / "flame/tiny.pkl", tiny_flame())
    _write_avatar_on_flame(root)
    _write_videos(root / "videos")
    from fuzzing.pieces import write_pieces

    write_pieces(root / "pieces")
    from fuzzing.exchange_material import write_exchanged

    write_exchanged(root, avatar, root / RUN)


def _evaluate_and_keep_the_partial_file(root: Path) -> None:
    removed, PartialScores.remove = PartialScores.remove, lambda self: None  # type: ignore[method-assign]
    try:
        evaluate(root / RUN, [root / SEQUENCE], QUICK)
    finally:
        PartialScores.remove = removed  # type: ignore[method-assign]


def _write_pictures(folder: Path) -> None:
    folder.mkdir()
    across = np.linspace(0, 255, 32).astype(np.uint8)
    picture = np.stack(
        [np.tile(across, (32, 1)), np.tile(across[:, None], (1, 32)), np.full((32, 32), 90, np.uint8)], axis=-1
    )
    for suffix in ("png", "jpg", "webp", "tif", "bmp"):
        assert cv2.imwrite(str(folder / f"a.{suffix}"), picture)


def _write_face_models(folder: Path) -> None:
    """Write a face model as `mien face-models --add` leaves it."""
    bare = toy_face_model()
    marks = Landmarks(torch.arange(478) % len(bare.faces), torch.full((478, 3), 1 / 3))
    model = replace(bare, name="mine", landmarks={"mediapipe": marks})
    write_face_model(folder / "mine", model)
    write_landmarks(folder / "mine.landmarks.json", model, "test")
    write_json(
        folder / "mine.source.json",
        "mien.face_model_source",
        1,
        {"path": "/x.npz", "sha256": "0", "recipe": ADDED_RECIPE},
    )


def tiny_flame() -> dict[str, np.ndarray]:
    """Return a head of 200 vertices in FLAME's schema: an egg with two eyeballs, four identities, three expressions."""
    dice = np.random.default_rng(0)
    egg, egg_faces = _ball(14, 12)
    ball, ball_faces = _ball(6, 5)
    sides = [ball * 0.013 + np.array([x, 0.02, 0.08]) for x in (0.032, -0.032)]
    template = np.concatenate([egg * np.array([0.075, 0.12, 0.09]), *sides])
    faces = np.concatenate([egg_faces, ball_faces + len(egg), ball_faces + len(egg) + len(ball)])
    weights, v = np.zeros((len(template), 5)), len(template)
    low = template[: len(egg), 1]
    weights[: len(egg), 0] = low < -0.08
    weights[: len(egg), 2] = (low >= -0.08) & (low < -0.03) & (template[: len(egg), 2] > 0.04)
    weights[: len(egg), 1] = 1 - weights[: len(egg)].sum(1)
    weights[len(egg) : len(egg) + len(ball), 3] = 1
    weights[len(egg) + len(ball) :, 4] = 1
    regressor = np.zeros((5, v))
    for joint, chosen in enumerate((low < -0.1, low < -0.06, low < 0, *(weights[:, side] > 0 for side in (3, 4)))):
        regressor[joint, : len(chosen)] = chosen / chosen.sum()
    return {
        "v_template": template, "f": faces.astype(np.uint32),
        "shapedirs": dice.normal(0, 1e-3, (v, 3, 7)).astype(np.float32),
        "posedirs": dice.normal(0, 1e-4, (v, 3, 36)).astype(np.float32), "J_regressor": regressor, "weights": weights,
        "kintree_table": np.array([[2**32 - 1, 0, 1, 1, 1], [0, 1, 2, 3, 4]], np.int64), "identities": np.array(4),
    }  # fmt: skip


def _ball(around: int, rings: int) -> tuple[np.ndarray, np.ndarray]:
    polar, angle = np.meshgrid(
        np.linspace(0.1, np.pi - 0.1, rings), np.arange(around) * 2 * np.pi / around, indexing="ij"
    )
    points = np.stack([np.sin(polar) * np.sin(angle), np.cos(polar), np.sin(polar) * np.cos(angle)], axis=-1).reshape(
        -1, 3
    )
    ring, column = (axis.reshape(-1) for axis in np.meshgrid(np.arange(rings - 1), np.arange(around), indexing="ij"))
    first, second = ring * around + column, ring * around + (column + 1) % around
    return points, np.concatenate(
        [np.stack([first, first + around, second], 1), np.stack([second, first + around, second + around], 1)]
    )


def _write_avatar_on_flame(root: Path) -> None:
    """Write GaussianAvatars' folder of an avatar on a model in FLAME's schema, whose licence forbids copies."""
    model = flame_face_model(read_flame(root / "flame/tiny.npz"), "tiny")
    face = replace(model.neutral(3), head_translation=torch.tensor([0.0, 0.0, -0.6]).repeat(3, 1))
    method = METHODS["gaussian_avatars"]
    write_gaussian_avatars_folder(
        root / "flame_avatars", method.avatar(plain_config("gaussian_avatars"), model, face), face
    )


def _write_videos(folder: Path) -> None:
    """Write six small pictures into every container that the codecs here can fill."""
    folder.mkdir()
    noise = np.random.default_rng(0).integers(0, 255, (6, 48, 64, 3), dtype=np.uint8)
    for ending in ("mp4", "mov", "mkv", "avi", "ts", "flv", "webm"):
        with contextlib.suppress(Exception):  # webm does not take H.264
            write_video(folder / f"clip.{ending}", list(noise), 25.0, preset="ultrafast")
    assert (folder / "clip.mp4").is_file()


def copy_of(material: Path, parts: tuple[str, ...], root: Path) -> None:
    """Make fresh copies of some parts of the material."""
    root.mkdir(parents=True)
    for part in parts:
        source, target = material / part, root / part
        target.parent.mkdir(parents=True, exist_ok=True)
        if source.is_dir():
            shutil.copytree(source, target)
        else:
            shutil.copy2(source, target)


def summary(material: Path) -> str:
    """Count the files of each ending."""
    endings = [path.suffix or path.name for path in material.rglob("*") if path.is_file()]
    return json.dumps({ending: endings.count(ending) for ending in sorted(set(endings))})


CONFIG, SETTINGS = train_toy.CONFIG, train_toy.SETTINGS
