"""Readers of each kind of file. They take the folder with the copies, and the faulty file."""

import itertools
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fuzzing import pieces
from fuzzing.material import ANALYSIS, CONFIG, GROWTH, RUN, SEQUENCE, SETTINGS
from mien.avatar import load_avatar
from mien.capture import read_capture as read_whole_capture
from mien.capture.crop import whole_picture
from mien.capture.given import GivenMattes, read_landmarks
from mien.capture.source import FrameSelection, open_source, read_image
from mien.capture.video import count_frames, probe_video, read_video_frames
from mien.datasets import TrainedAvatar, datasets, recognised
from mien.driving import read_blendshape_json, read_live_link_face
from mien.errors import UserError
from mien.evaluation import read_metrics as read_figures
from mien.evaluation.image_folders import read_crops as read_boxes
from mien.evaluation.image_source import open_pictures, read_picture
from mien.evaluation.partial import PartialScores
from mien.export import read_gaussian_avatars_folder
from mien.export import read_ply as read_gaussians
from mien.face import FaceParams, available_face_models, load_face_model
from mien.face.flame import flame_face_model
from mien.face.flame import read_flame as read_flame_file
from mien.lab.analysis import AnalysisOptions, run_analysis
from mien.render.camera_paths import read_cameras as read_camera_path
from mien.runtime import read_portable as read_mien
from mien.storage import read_tensors
from mien.tracking import read_scoring as read_masks
from mien.tracking import read_tracking as read_track
from mien.training import read_curves as read_all_curves
from mien.training import read_run_config, read_sequence, read_training_summary
from mien.training.checkpoint import resume
from mien.training.run import run_camera
from mien.training.trainer import start
from mien.workspace import open_workspace
from toy_scene import toy_sequence

SEEN = 3
"""Number of pictures of a video that are read."""


def read_capture(root: Path, file: Path) -> Any:
    return read_whole_capture(root / SEQUENCE / "capture")


def read_tracking(root: Path, file: Path) -> Any:
    return read_track(root / SEQUENCE / "tracking")


def read_scoring(root: Path, file: Path) -> Any:
    return read_masks(root / SEQUENCE / "scoring")


def read_config(root: Path, file: Path) -> Any:
    return _known(read_run_config(root / RUN)), run_camera(root / RUN)


def read_summary(root: Path, file: Path) -> Any:
    return _known(read_training_summary(root / RUN))


def read_curves(root: Path, file: Path) -> Any:
    return read_all_curves(root / RUN)


def read_face_track(root: Path, file: Path) -> Any:
    tensors = read_tensors(file)
    try:
        return FaceParams(**tensors)
    except TypeError as error:  # as `mien.evaluation.load` does
        raise UserError(f"{file}: {error}") from None


def read_metrics(root: Path, file: Path) -> Any:
    return _known(read_figures(root / RUN))


def read_partial(root: Path, file: Path) -> Any:
    return PartialScores(file, "0").read()


def resume_run(root: Path, file: Path) -> Any:
    face_model, sequence = toy_sequence(timesteps=5, size=32)
    state = start([sequence], face_model, CONFIG, replace(SETTINGS, split="tail"))
    resume(root / RUN / "checkpoints", state, SETTINGS.record_every)
    return state.avatar


def go_on_tracking(root: Path, file: Path) -> Any:
    pieces.go_on(root / "pieces")


def read_avatar(root: Path, file: Path) -> Any:
    return load_avatar(root / RUN)


def read_added(root: Path, file: Path) -> Any:
    os.environ["MIEN_CACHE"] = str(root / "cache")
    available_face_models()
    return load_face_model("mine")


def read_portable(root: Path, file: Path) -> Any:
    return read_mien(file)


def read_ply(root: Path, file: Path) -> Any:
    return read_gaussians(file)


def read_pictures(root: Path, file: Path) -> Any:
    for each in (read_image(file), read_picture(file)):
        assert each.dtype == np.uint8, each.dtype
        assert each.ndim == 3, each.shape
        assert each.size > 0, each.shape
    source = open_source(file.parent, FrameSelection(), 25.0)
    assert source.expected_frames == len(list(source.frames(64)))
    open_pictures(file.parent)


def read_mattes(root: Path, file: Path) -> Any:
    mattes, whole = GivenMattes(root / "given/mattes", (32, 32)), whole_picture(32, 32, 32)
    return [mattes.matte(number, whole) for number in range(3)]


def read_points(root: Path, file: Path) -> Any:
    return read_landmarks(file, 3)


def read_crops(root: Path, file: Path) -> Any:
    return read_boxes(file)


def read_cameras(root: Path, file: Path) -> Any:
    return read_camera_path(file)


def read_motion(root: Path, file: Path) -> Any:
    return read_live_link_face(file) if file.suffix == ".csv" else read_blendshape_json(file)


def read_flame(root: Path, file: Path) -> Any:
    return read_flame_file(file)


def read_video(root: Path, file: Path) -> Any:
    probe_video(file)
    count_frames(file)
    for seconds, frame in itertools.islice(read_video_frames(file, 512), SEEN):
        assert np.isfinite(seconds), seconds
        assert frame.dtype == np.uint8, frame.dtype
        assert frame.ndim == 3, frame.shape


def read_no_playlist(root: Path, file: Path) -> Any:
    shown = sum(1 for _ in itertools.islice(read_video_frames(file, 512), SEEN))
    assert shown == 0, "a list made mien read other files"


def read_by_ending(root: Path, file: Path) -> Any:
    """Read a file by its ending from its own folder, as people do."""
    before = Path.cwd()
    os.chdir(file.parent)
    try:
        _read_any(Path(file.name))
    finally:
        os.chdir(before)


def read_workspace(root: Path, file: Path) -> Any:
    workspace = open_workspace(root / "W")
    folder = workspace.sequence_dir(workspace.pick_sequence(None))
    read_sequence(folder)
    return load_avatar(workspace.run_dir(workspace.pick_run(None)))


def read_analysis(root: Path, file: Path) -> Any:
    """Return what an analysis keeps: the parts, without what depends on the command."""
    options = AnalysisOptions()
    return run_analysis(GROWTH, GROWTH.parts, root / RUN, [root / SEQUENCE], root / ANALYSIS, options)["parts"]


def read_dataset(root: Path, file: Path) -> Any:
    """Return what the dataset holds that a file belongs to: an avatar, or a list of sequences."""
    places = [path for path in (file, *file.parents) if root in path.parents]
    known = [path for path in places if any(each.recognises(path) is not None for each in datasets())]
    path = (known or places[-1:])[0]
    found = recognised(path)[0].read(path, None)
    return found if isinstance(found, TrainedAvatar) else list(found)


def read_avatar_on_flame(root: Path, file: Path) -> Any:
    model = flame_face_model(read_flame_file(root / "flame/tiny.npz"), "tiny")
    return read_gaussian_avatars_folder(root / "flame_avatars", model)


def nothing_read(root: Path, file: Path) -> Any:
    """Read nothing, because the command reads."""


def _read_any(file: Path) -> None:
    suffix = file.suffix
    if suffix in (".mp4", ".mov", ".mkv", ".avi", ".ts", ".flv", ".webm"):
        read_video(file.parent, file)
        open_source(file, FrameSelection(), 25.0)
    elif suffix in (".png", ".jpg", ".webp", ".tif", ".bmp"):
        read_pictures(file.parent, file)
    elif file.stem == "points" or suffix == ".safetensors":
        read_landmarks(file, 3)
    elif suffix in (".csv", ".json"):
        read_motion(file.parent, file)


def _known(found: dict[str, Any]) -> dict[str, Any]:
    """Return the entries except for the one that results from damage to the name `checksum`."""
    names = (
        "method",
        "settings",
        "data",
        "mien",
        "command_line",
        "protocols",
        "training",
        "fingerprints",
        "steps",
        "seconds",
    )
    return {name: value for name, value in found.items() if name in names}
