"""Random damage to every file that mien reads: a clear error or the right content, never a crash, a hang.

Json and safetensors files carry checksums, frames and masks carry hashes: what is read from them after damage equals
what was written, or it is refused. A .ply, pictures and videos of other programs have none: there, what is read after
damage must be a valid object (finite numbers, whole pictures).
"""

import json
import os
import random
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import safetensors.numpy
import torch
from torch import Tensor, nn

import train_toy
from damage import flip_or_cut
from mien.avatar import load_avatar
from mien.avatar.portable import make_portable
from mien.capture import read_capture, write_capture
from mien.capture.crop import whole_picture
from mien.capture.given import GivenMattes, read_landmarks
from mien.capture.source import read_image
from mien.capture.video import write_video
from mien.errors import UserError
from mien.evaluation import read_metrics
from mien.evaluation.cameras import read_cameras
from mien.evaluation.image_folders import read_crops, write_crops
from mien.export import in_world, read_ply, write_ply
from mien.face import FaceParams
from mien.face.loading import read_face_model, write_face_model
from mien.motion import ARKIT_NAMES, Motion, read_blendshape_json, read_live_link_face
from mien.runtime import read_portable, write_portable
from mien.storage import read_tensors, write_json
from mien.tracking import Scoring, read_scoring, read_tracking, write_scoring, write_tracking
from mien.training import read_curves, read_run_config, read_training_summary
from mien.training.checkpoint import resume
from mien.training.run import run_camera
from mien.training.trainer import start
from toy_scene import toy_camera, toy_sequence

CASES = 500
NEWEST = 28
"""Step of the last checkpoint of the toy run."""
SECONDS = 5.0
"""Of one reading; a busy machine needs a tenth of it."""
MEMORY = 2 << 30
"""Bytes that one reading may ask for."""
VIDEO_CASES = 12


@dataclass(frozen=True)
class Reader:
    """How to read what lies at some paths."""

    pattern: str
    """Of the files to damage, below the workspace."""
    read: Callable[[Path, Path], Any]
    """From the workspace and the damaged file."""
    exact: bool = True
    """Whether there is redundancy enough to demand the very content that was written."""


def resumed(root: Path, file: Path) -> Any:
    face_model, sequence = toy_sequence(timesteps=5, size=32)
    state = start([sequence], face_model, train_toy.CONFIG, train_toy.SETTINGS)
    resume(root / "run/checkpoints", state)
    return state.avatar if state.step == NEWEST else "older"


READERS = (
    Reader("capture/**/*", lambda root, file: read_capture(root / "capture")),
    Reader("tracking/*", lambda root, file: read_tracking(root / "tracking")),
    Reader("scoring/**/*", lambda root, file: read_scoring(root / "scoring")),
    Reader("run/config.json", lambda root, file: (known(read_run_config(root / "run")), run_camera(root / "run"))),
    Reader("run/training.json", lambda root, file: known(read_training_summary(root / "run"))),
    Reader("run/metrics.json", lambda root, file: known(read_metrics(root / "run"))),
    Reader("run/curves.safetensors", lambda root, file: read_curves(root / "run")),
    Reader("run/face_track.safetensors", lambda root, file: FaceParams(**read_tensors(file))),
    Reader("run/avatar/*", lambda root, file: load_avatar(root / "run")),
    Reader("run/checkpoints/*28*", resumed),
    Reader("run/checkpoints/*24*", resumed),
    Reader("face_model.*", lambda root, file: read_face_model(root / "face_model")),
    Reader("head.mien", lambda root, file: read_portable(file)),
    Reader("head.ply", lambda root, file: read_ply(file), exact=False),
    Reader("pictures/*", lambda root, file: read_image(file), exact=False),
    Reader("given/points.*", lambda root, file: read_landmarks(file, 3), exact=False),
    Reader("given/mattes/*", lambda root, file: read_mattes(root / "given/mattes"), exact=False),
    Reader("given/crops.json", lambda root, file: read_crops(file)),
    Reader("given/cameras.json", lambda root, file: read_cameras(file), exact=False),
    Reader("given/take.csv", lambda root, file: read_live_link_face(file), exact=False),
    Reader("given/*take.json", lambda root, file: read_blendshape_json(file), exact=False),
)


def known(content: dict[str, Any]) -> dict[str, Any]:
    """Without the one entry that damage to the name `checksum` leaves."""
    names = {"method", "settings", "data", "mien", "command_line", "protocols", "training", "steps", "seconds"}
    return {name: value for name, value in content.items() if name in names}


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One file of each kind that mien writes or is given."""
    root = tmp_path_factory.mktemp("fuzz")
    face_model, sequence = toy_sequence(timesteps=5, size=32)
    write_capture(root / "capture", sequence.capture)
    write_tracking(root / "tracking", sequence.tracking)
    crops = np.tile(np.array([4, 4, 20, 20], np.int64), (5, 1, 1))
    write_scoring(root / "scoring", Scoring(sequence.scoring, crops))
    train_toy.main(root / "run", train_toy.SETTINGS.steps)
    entry = {"psnr": 31.25, "head": {"psnr": 27.5}}
    write_json(root / "run/metrics.json", "mien.metrics", 1, {"protocols": {"a": entry}, "training": {"steps": 30}})
    write_face_model(root / "face_model", face_model)
    avatar = load_avatar(root / "run")
    write_portable(root / "head.mien", make_portable(avatar, toy_camera(32), "toy"))
    with torch.no_grad():
        write_ply(root / "head.ply", in_world(avatar.pose(avatar.subject).gaussians.timestep(0)))
    (root / "pictures").mkdir()
    picture = sequence.capture.images[0, 0]
    for suffix in ("png", "jpg", "webp", "tif", "bmp"):
        assert cv2.imwrite(str(root / f"pictures/a.{suffix}"), picture)
    write_what_users_give(root / "given", picture)
    return root


def write_what_users_give(folder: Path, picture: np.ndarray) -> None:
    """Landmarks, mattes, crops, cameras and motion as other programs write them: without any redundancy."""
    points = np.random.default_rng(0).uniform(0, 32, (3, 478, 2)).astype(np.float32)
    points[1] = np.nan
    folder.mkdir()
    safetensors.numpy.save_file({"landmarks": points}, folder / "points.safetensors")
    rows = [",".join(f"{value:.3f}" for value in row) for row in points.reshape(3, -1)]
    (folder / "points.csv").write_text("\n".join(rows) + "\n")
    (folder / "mattes").mkdir()
    for index in range(3):
        assert cv2.imwrite(str(folder / f"mattes/{index}.png"), picture[..., 0])
    write_crops(folder / "crops.json", {f"{index}.png": (4, 4, 20, 20) for index in range(3)})
    camera = {"K": [[40, 0, 16], [0, 40, 16], [0, 0, 1]], "viewmat": np.eye(4).tolist(), "width": 32, "height": 32}
    cameras = {"format": "mien.cameras", "version": 1, "cameras": [camera, camera]}
    (folder / "cameras.json").write_text(json.dumps(cameras))
    columns = ["Timecode", "BlendshapeCount", *(name[0].upper() + name[1:] for name in ARKIT_NAMES), "HeadYaw"]
    takes = [[f"0:00:0{frame}:00.0", "61", *["0.25"] * 53] for frame in range(4)]
    (folder / "take.csv").write_text("\n".join(",".join(cells) for cells in (columns, *takes)) + "\n")
    plain = [{"timestamp_ms": 40 * frame, "blendshapes": {"jawOpen": 0.5}} for frame in range(3)]
    (folder / "take.json").write_text(json.dumps(plain))
    categories = [{"categoryName": "jawOpen", "score": 0.5}]
    matrix = {"rows": 4, "columns": 4, "data": np.eye(4).flatten().tolist()}
    result = {"faceBlendshapes": [{"categories": categories}], "facialTransformationMatrixes": [matrix]}
    (folder / "landmarker_take.json").write_text(json.dumps(result))


def read_mattes(folder: Path) -> np.ndarray:
    mattes, whole = GivenMattes(folder, (32, 32)), whole_picture(32, 32, 32)
    return np.stack([mattes.matte(number, whole) for number in range(3)], axis=-1)


@contextmanager
def limited_memory(amount: int) -> Iterator[None]:
    """Let this process ask for so many bytes more than it has."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + amount, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def content_of(value: Any) -> Any:
    """A value as something that can be compared."""
    if isinstance(value, nn.Module):
        return content_of(dict(value.state_dict()))
    if isinstance(value, Tensor):
        return content_of(value.detach().numpy())
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if is_dataclass(value):
        return {field.name: content_of(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, dict):
        return {name: content_of(item) for name, item in value.items()}
    return [content_of(item) for item in value] if isinstance(value, (tuple, list)) else value


def is_valid(value: Any) -> bool:
    """Whole and finite, for content without redundancy."""
    if isinstance(value, np.ndarray) and value.dtype == np.uint8:
        return value.ndim == 3 and value.size > 0
    if isinstance(value, np.ndarray):  # landmarks: whole rows are nan where there is no face
        return value.shape == (3, 478, 2) and not np.isinf(value).any()
    if isinstance(value, list):
        return all(bool(camera.K.isfinite().all() and camera.viewmat.isfinite().all()) for camera in value)
    if isinstance(value, Motion):
        return all(np.isfinite(getattr(value, field.name)).all() for field in fields(value)) and 0 < value.fps <= 1e6
    return all(bool(getattr(value, name).isfinite().all()) for name in ("means", "quats", "scales", "opacities", "sh"))


def targets(root: Path) -> list[tuple[Reader, Path]]:
    found = [(reader, file) for reader in READERS for file in sorted(root.glob(reader.pattern)) if file.is_file()]
    assert {reader.pattern for reader, _ in found} == {reader.pattern for reader in READERS}, (
        "a kind of file is missing"
    )
    return found


def attempt(reader: Reader, root: Path, file: Path, expected: Any) -> None:
    """Read something damaged, and judge what comes of it."""
    began = time.monotonic()
    try:
        with limited_memory(MEMORY):
            value = reader.read(root, file)
    except UserError as error:
        told = str(error)
    else:
        told = f"{root}: fine"
        if not reader.exact:
            assert is_valid(value)
        else:
            assert isinstance(value, str) or content_of(value) == expected, "read something else than what was written"
    assert "\n" not in told, told
    assert str(root) in told, f"names no file: {told}"
    assert time.monotonic() - began < SECONDS, "took too long"


def test_random_damage_to_every_file(workspace: Path) -> None:
    dice = random.Random(0)
    files = targets(workspace)
    expected = {reader.pattern: content_of(reader.read(workspace, file)) for reader, file in files if reader.exact}
    outputs_before = sorted(workspace.rglob("*"))
    for case in range(CASES):
        # Every file in turn first, then files at random.
        reader, file = files[case] if case < len(files) else dice.choice(files)
        if not file.exists():
            reader.read(workspace, file)  # the cache's stamp goes when a frame is found damaged, and comes back by this
        whole, status = file.read_bytes(), file.stat()
        damaged = flip_or_cut(whole, dice)
        file.write_bytes(damaged)
        try:
            attempt(reader, workspace, file, expected.get(reader.pattern))
        except Exception as error:
            raise AssertionError(f"case {case}, {file.relative_to(workspace)}: {error!r}") from error
        finally:
            file.write_bytes(whole)
            os.utime(file, ns=(status.st_atime_ns, status.st_mtime_ns))
    read_capture(workspace / "capture")
    assert sorted(workspace.rglob("*")) == outputs_before, "reading left something behind"


READ_VIDEO = """
import resource, sys
from pathlib import Path
from mien.capture.video import probe_video, read_video_frames
from mien.errors import UserError
resource.setrlimit(resource.RLIMIT_AS, (4 << 30, 4 << 30))
for path in map(Path, sys.argv[1:]):
    try:
        probe_video(path)
        count = sum(frame.shape == (48, 64, 3) and frame.dtype.name == "uint8" for _, frame in read_video_frames(path))
        print("frames", count)
    except UserError as error:
        assert str(path) in str(error) and "\\n" not in str(error), error
        print("refused")
"""


def test_random_damage_to_videos(tmp_path: Path) -> None:
    """In another process: a decoder that crashes would take the tests with it."""
    clip = tmp_path / "clip.mp4"
    noise = np.random.default_rng(0).integers(0, 255, (6, 48, 64, 3), dtype=np.uint8)
    write_video(clip, list(noise), 25.0)
    dice, paths = random.Random(1), []
    for case in range(VIDEO_CASES):
        paths.append(tmp_path / f"damaged{case}.mp4")
        paths[-1].write_bytes(flip_or_cut(clip.read_bytes(), dice))
    result = subprocess.run(
        [sys.executable, "-c", READ_VIDEO, *map(str, paths)], capture_output=True, text=True, timeout=120, check=False
    )
    assert result.returncode == 0, result.stderr
    outcomes = [line for line in result.stdout.splitlines() if line == "refused" or line.startswith("frames ")]
    assert len(outcomes) == VIDEO_CASES
    assert len(set(outcomes)) > 1, "no damage had any effect"
    shutil.rmtree(tmp_path)
