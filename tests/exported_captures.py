"""A drawn scene as a tracked sequence, and checks of what importers read of its exports."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dataset_checks import CAMERA, check_intrinsics, filmed_camera, motion_between
from dataset_scene import SIDE, Scene, draw, head_view, projected
from dataset_writers import UNEQUAL
from mien.camera import Camera
from mien.datasets import TrackedSequence, recognised
from mien.datasets.layouts import Filmed, filmed_frames, find_layout, write_layout
from mien.datasets.sequences import tracked_sequence
from mien.export import face_of_flame_params
from mien.training import Sequence, TrainSettings

TIMESTEPS, HELD_OUT = 12, (8, 9)
TRAINED = tuple(t for t in range(TIMESTEPS) if t not in HELD_OUT)
TOLERANCE = 1e-3
"""Largest error of a projected vertex, in pixels: less than 1e-5 m, as the head is 1 m away and a metre has 150."""
EXACT = 1e-5
"""Largest error of vertices seen by their camera, in metres."""
CAMERAS = ("222200037", "222200036")


def with_two_cameras(scene: Scene) -> Sequence:
    """Return the scene, filmed by two calibrated cameras and tracked exactly. It is scored in the upper part."""
    arrays = {
        "shape": scene.shape, "expr": scene.expr, "rotation": scene.pose[:, 0], "neck_pose": scene.pose[:, 1],
        "jaw_pose": scene.pose[:, 2], "eyes_pose": scene.pose[:, 3:].reshape(-1, 6), "translation": scene.translation,
    }  # fmt: skip
    face = face_of_flame_params(Path("drawn"), arrays, scene.model)
    drawn = [[draw(scene, scene.vertices(t), UNEQUAL, *view(c)) for c in range(2)] for t in range(TIMESTEPS)]
    images, mattes = (np.stack([[each[part] for each in row] for row in drawn]) for part in range(2))
    images[:, :, :5] = 17  # a background that is not white
    cameras = {}
    for index, name in enumerate(CAMERAS):
        viewmat = torch.eye(4)
        rotation, translation = view(index)
        viewmat[:3, :3], viewmat[:3, 3] = torch.from_numpy(rotation), torch.from_numpy(translation)
        cameras[name] = Camera(torch.from_numpy(UNEQUAL).float(), viewmat, SIDE, SIDE)
    found = tracked_sequence(Path("drawn"), "clip", images, mattes, cameras, scene.model, face, 25.0)
    scoring = mattes.copy()
    scoring[:, :, 86:] = 0
    return Sequence("clip", found.capture, found.tracking, scoring)


def with_one_camera(both: Sequence) -> Sequence:
    """Return the same, filmed by the first camera."""
    capture, tracking = both.capture, both.tracking
    assert capture.calibration is not None
    one = replace(
        capture, camera_ids=CAMERAS[:1], images=capture.images[:, :1], mattes=capture.mattes[:, :1],
        landmarks=capture.landmarks[:, :1], valid=capture.valid[:, :1], principal_point=capture.principal_point[:1],
        calibration=capture.calibration[:1],
    )  # fmt: skip
    seen = replace(
        tracking, cameras=tracking.cameras[:1], neck_lines=tracking.neck_lines[:, :1],
        residuals=tracking.residuals[:, :1],
    )  # fmt: skip
    return replace(both, capture=one, tracking=seen, scoring=both.scoring[:, :1])


def view(camera: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the rotation and translation of a camera."""
    return head_view(2 + camera, 1.0)


def filmed(sequence: Sequence, scene: Scene, **settings: Any) -> Filmed:
    """Return the sequence with its default split, as mattes of the head."""
    return filmed_frames(sequence, scene.model, replace(TrainSettings(split="blocks"), **settings), "head")


def export(folder: Path, name: str, content: Filmed) -> Path:
    """Write a layout, and return its folder."""
    layout = find_layout(name)
    assert layout is not None
    write_layout(folder, content, layout)
    return folder


def read(path: Path, name: str, scene: Scene) -> list[Any]:
    """Return what the importer of this name reads, which has to recognise the folder by itself."""
    dataset, _ = recognised(path)
    assert dataset.name == name
    return list(dataset.read(path, scene.model))  # type: ignore[arg-type]


def truth(scene: Scene, timestep: int, camera: int = 0) -> np.ndarray:
    """Return the pixels at which the writer of the pictures has drawn each vertex."""
    return projected(scene.vertices(timestep), UNEQUAL, *view(camera))


def on_head(scene: Scene) -> np.ndarray:
    """Vertices that the neck does not bend."""
    return scene.arrays["weights"][:, 0] == 0


def load(path: Path) -> dict[str, Any]:
    """Return the content of a json file."""
    return json.loads(path.read_text())


def check_frames(sequence: Any, single: Sequence, timesteps: tuple[int, ...], mattes: bool = True) -> None:
    """Check pictures, mattes and the intrinsics against what was exported."""
    assert np.array_equal(sequence.capture.images[:, 0], single.capture.images[list(timesteps), 0])
    if mattes:
        assert np.array_equal(sequence.capture.mattes[:, 0], single.scoring[list(timesteps), 0])
    check_intrinsics(filmed_camera(sequence), UNEQUAL)


def check_face(
    sequence: TrackedSequence, scene: Scene, timesteps: tuple[int, ...], which: np.ndarray | slice = slice(None)
) -> None:
    """Check the imported face and camera against the drawn person."""
    rotation, translation = view(0)
    viewmat = sequence.tracking.cameras[0].viewmat.double().numpy()
    for row, timestep in enumerate(timesteps):
        vertices = sequence.face_model(sequence.tracking.face[row])[0]
        found = vertices.double().numpy() @ viewmat[:3, :3].T + viewmat[:3, 3]
        expected = scene.vertices(timestep) @ rotation.T + translation
        assert np.abs(found - expected)[which].max() < EXACT
        turn, shift = motion_between(scene.vertices(timestep)[which], found[which])
        assert np.abs(turn - rotation).max() < CAMERA
        assert np.abs(shift - translation).max() < CAMERA
        pixels = sequence.tracking.cameras[0].project(vertices)[0].numpy()
        assert np.abs(pixels - truth(scene, timestep))[which].max() < TOLERANCE
    coefficients = torch.from_numpy(scene.expr[list(timesteps)]).float()
    expression = sequence.tracking.face.expression
    assert torch.allclose(expression, coefficients[:, : expression.shape[1]], atol=1e-6)
