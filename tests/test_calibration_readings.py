"""Calibrations that are written in another way than mien reads them: each is named, by how well it fits the faces."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from mien.camera import Camera, look_at
from mien.capture.calibration import CalibratedCamera
from mien.capture.calibration_check import advise_on, warn_of_misfit
from mien.capture.head_path import consensus, find_head_path
from mien.capture.reading_fit import Ranked, advice_of, is_wrong, rank_readings, ties_of
from mien.capture.readings import Reading, readings_of
from mien.errors import UserError
from mien.face import load_face_model
from mien.rotation import invert_rigid

FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
WIDTH, HEIGHT, FRAMES = 640, 512, 5
HEAD = torch.tensor([0.0, 0.0, -0.9])


def camera_at(yaw: float, pitch: float = 0.0) -> Camera:
    a, b = math.radians(yaw), math.radians(pitch)
    place = HEAD + 0.9 * torch.tensor([math.sin(a) * math.cos(b), math.sin(b), math.cos(a) * math.cos(b)])
    K = torch.tensor([[768.0, 0, WIDTH / 2 + 8], [0, 768.0, HEIGHT / 2 - 60], [0, 0, 1]])
    return Camera(K, look_at(place, HEAD, torch.tensor([0.0, 1.0, 0.0])), WIDTH, HEIGHT)


RIGS = {
    "ring": [camera_at(yaw) for yaw in (-80, -30, 0, 30, 80)],
    "pair": [camera_at(-15), camera_at(15)],
    "line": [camera_at(-20), camera_at(0), camera_at(20)],
    "mixed": [camera_at(-30, 5), camera_at(0, -10), camera_at(25, 15), camera_at(50)],
}
WORLDS = {"room": None, "one camera": torch.eye(4), "one camera, OpenGL": FLIP}
POSES: dict[str, tuple[Callable[[Tensor], Tensor], str]] = {
    "world to camera": (lambda viewmat: viewmat, ""),
    "camera to world": (invert_rigid, "the matrices go from camera to world, so write the inverse of each viewmat"),
    "OpenGL": (lambda viewmat: FLIP @ viewmat, "the axes are OpenGL's, so change the signs of rows 2 and 3"),
    "camera to world, OpenGL": (lambda viewmat: invert_rigid(FLIP @ viewmat),
        "go from camera to world with OpenGL's axes, so change the signs of columns 2 and 3 of each, and write"),
}  # fmt: skip
INTRINSICS: dict[str, tuple[Callable[[Tensor], Tensor], str]] = {
    "pixels": (lambda K: K, ""),
    "parts": (lambda K: K * torch.tensor([[1 / WIDTH], [1 / HEIGHT], [1.0]]),
        "K is in parts of the picture, so multiply its row 1 by the width and row 2 by"),
    "half size": (lambda K: K * torch.tensor([[0.5], [0.5], [1.0]]),
        "K is for pictures of another size, so multiply its rows 1 and 2 by 2"),
    "from below": (lambda K: torch.stack([K[0], torch.stack([K[1, 0], K[1, 1], HEIGHT - K[1, 2]]), K[2]]),
        "y of K counts from below, so write K[1][2] as height - K[1][2]"),
}  # fmt: skip


@pytest.fixture(scope="module")
def marks() -> Tensor:
    """Landmarks of a head that turns, [t, 478, 3]."""
    model = load_face_model("anny")
    time = torch.arange(FRAMES) / 3
    turns = torch.stack([0.15 * (2 * time).sin(), 0.25 * (1.3 * time).sin(), 0 * time], dim=1)
    face = replace(model.neutral(FRAMES), head_rotation=turns, head_translation=HEAD.repeat(FRAMES, 1))
    return model.landmark_positions(model(face), "mediapipe")


def seen_by(cameras: list[Camera], marks: Tensor) -> np.ndarray:
    """Return landmarks as a detector finds them: noise in each picture, and slides that stay."""
    random = np.random.default_rng(0)
    shape = marks.shape[1], 2
    pixels = [
        camera.project(marks)[0].numpy() + random.normal(0, 0.5, (FRAMES, *shape)) + random.normal(0, 1.5, shape)
        for camera in cameras
    ]
    return np.stack(pixels, axis=1)


def written(cameras: list[Camera], world: str, pose: str = "world to camera", K: str = "pixels") -> list[Camera]:
    """Return cameras as a file has them: in a world of its own, with matrices and intrinsics in another form."""
    axes = WORLDS[world]
    T_world_new = torch.eye(4) if axes is None else invert_rigid(cameras[0].viewmat) @ axes
    return [
        replace(camera, viewmat=POSES[pose][0](camera.viewmat @ T_world_new), K=INTRINSICS[K][0](camera.K))
        for camera in cameras
    ]


PLACES = (("ring", "room"), ("pair", "one camera"), ("line", "one camera, OpenGL"), ("mixed", "one camera"))
READINGS = [
    *((*place, pose, "pixels") for place in PLACES for pose in POSES),
    *(("ring", "one camera, OpenGL", "camera to world, OpenGL", K) for K in list(INTRINSICS)[1:]),
    *(("ring", "one camera, OpenGL", pose, "half size") for pose in list(POSES)[:-1]),
]


@pytest.mark.parametrize(("rig", "world", "pose", "K"), READINGS)
def test_every_reading_is_named_in_any_world(marks: Tensor, rig: str, world: str, pose: str, K: str) -> None:
    found = rank_readings(seen_by(RIGS[rig], marks), readings_of(written(RIGS[rig], world, pose, K)))
    tied = ties_of(found)
    assert len(tied) == 1
    assert POSES[pose][1] in tied[0].reading.remedy
    assert INTRINSICS[K][1] in tied[0].reading.remedy
    assert tied[0].share < 0.02
    assert is_wrong(found) == bool(POSES[pose][1] + INTRINSICS[K][1])


def told_of(cameras: list[Camera], pixels: np.ndarray, capsys) -> str:
    """Return the warning about a calibration."""
    calibrated = [CalibratedCamera(str(index), camera) for index, camera in enumerate(cameras)]
    warn_of_misfit(calibrated, lambda _, camera: camera.camera, pixels)
    return capsys.readouterr().err


def boxes_of(pixels: np.ndarray) -> np.ndarray:
    return np.concatenate([pixels.min(axis=2), pixels.max(axis=2)], axis=-1)


def test_a_reading_that_agrees_on_a_face_inside_out_is_warned_of(marks: Tensor, capsys) -> None:
    """Two readings place faces alike in depth; what is left then is a nose that points away. What fits is no matter."""
    assert not any(told_of(cameras, seen_by(cameras, marks), capsys) for cameras in RIGS.values())
    given = written(RIGS["line"], "one camera, OpenGL", "camera to world, OpenGL")
    turned, pixels = [replace(camera, viewmat=FLIP @ camera.viewmat) for camera in given], seen_by(RIGS["line"], marks)
    assert consensus(boxes_of(pixels), turned).agrees.mean() > 0.5, "boxes do not tell them apart"
    told = told_of(turned, pixels, capsys)
    assert "warning: --calibration" in told
    assert "agree within" in told


def test_ties_are_said_and_advice_is_part_of_the_refusal(marks: Tensor) -> None:
    entries = [Ranked(Reading((text,) if text else (), ()), pixels, pixels / 100) for text, pixels in
               (("write A", 0.7), ("write B", 0.8), ("write C", 4.0), ("", float("inf")))]  # fmt: skip
    advice = advice_of(entries)
    assert "cannot tell 2 readings apart" in advice
    assert "(1) write A, which leaves 0.7 px; or (2) write B, which leaves 0.8 px" in advice
    assert "write C" not in advice
    assert advice_of(entries[1:]) == "write B (points of the face then agree within 0.8 px)"
    assert advice_of(entries[3:]) == ""
    given, pixels = written(RIGS["ring"], "room", "camera to world"), seen_by(RIGS["ring"], marks)
    calibrated = [CalibratedCamera(str(index), camera) for index, camera in enumerate(given)]
    refusal = "no two cameras ever .*; the matrices go from camera to world, .* agree within"
    with pytest.raises(UserError, match=refusal):
        find_head_path(boxes_of(pixels), given, lambda: advise_on(calibrated, lambda _, camera: camera.camera, pixels))
