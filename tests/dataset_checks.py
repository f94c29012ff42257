"""Checks of imported datasets: cameras, vertices, pictures and silhouettes against the writer's own."""

from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import torch
from av.video.reformatter import Interpolation

from dataset_layouts import Layout, View
from dataset_scene import Scene, draw, projected
from dataset_writers import MIRROR, rigid
from mien.camera import Camera
from mien.datasets.dataset import Findings, TrackedSequence
from mien.datasets.registry import recognised
from mien.render.mesh import rasterize_mesh

PIXELS = 1e-3
"""Largest error of a projected vertex, in pixels."""
METRES = 1e-5
"""Largest error of a vertex seen by its camera, in metres."""
CAMERA = 1e-6
"""Largest error of a camera: of rotations, of places in metres, and of intrinsics as a part of each.

Captures hold float32, whose neighbours at 150 pixels are 1.5e-5 apart, so no absolute bound of 1e-6 can hold there."""
LANDMARKS = 4e-5
"""Largest error of a landmark, as a part of the height of the picture."""
_SURE = 99
"""Per cent of an outline that have to be exact. A vertex between two pixels may fall to either on other processors."""


def check_intrinsics(camera: Camera, K: np.ndarray) -> None:
    """Check intrinsics in pixels. Entries that are 0 have to be 0."""
    np.testing.assert_allclose(camera.K.double().numpy(), K, rtol=CAMERA, atol=0)


def check_view(camera: Camera, rotation: np.ndarray, translation: np.ndarray) -> None:
    viewmat = camera.viewmat.double().numpy()
    assert np.abs(viewmat - rigid(rotation, translation)).max() < CAMERA
    assert np.array_equal(viewmat[3], [0, 0, 0, 1])


def filmed_camera(sequence: Any, camera: int = 0) -> Camera:
    calibration = sequence.capture.calibration
    assert calibration is not None
    return calibration[camera]


def _motion_between(points: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Return the rigid matrix that carries points onto others best (Kabsch 1976)."""
    middle, middle_moved = points.mean(0), moved.mean(0)
    u, _, vt = np.linalg.svd((points - middle).T @ (moved - middle_moved))
    rotation = vt.T @ np.diag([1.0, 1.0, np.linalg.det(vt.T @ u.T)]) @ u.T
    return rigid(rotation, middle_moved - rotation @ middle)


def check_projection(
    sequence: TrackedSequence, timestep: int, vertices: np.ndarray, view: View, camera: int = 0, scale: float = 1.0,
    which: np.ndarray | slice = slice(None),
) -> None:  # fmt: skip
    """Check the imported face and camera against some of the writer's vertices, and the writer's camera.
    Where a moving camera became a moving head, what is compared is the motion from the writer's world to the camera.
    The writer's world is `scale` times as large."""
    K, rotation, translation = view
    found = sequence.tracking.cameras[camera]
    stored = filmed_camera(sequence, camera)
    assert torch.equal(stored.K, found.K)
    assert torch.equal(stored.viewmat, found.viewmat)
    check_intrinsics(found, K)
    mesh = sequence.face_model(sequence.tracking.face[timestep])[0]
    viewmat = found.viewmat.double().numpy()
    seen = (mesh.double().numpy() @ viewmat[:3, :3].T + viewmat[:3, 3]) * scale
    assert np.abs(seen - (vertices @ rotation.T + translation))[which].max() < METRES
    assert np.abs(_motion_between(vertices[which], seen[which]) - rigid(rotation, translation)).max() < CAMERA
    pixels = found.project(mesh)[0].double().numpy()
    assert np.abs(pixels - projected(vertices, K, rotation, translation))[which].max() < PIXELS


def _outline(silhouette: np.ndarray) -> np.ndarray:
    """The pixels of a silhouette that touch its outside."""
    solid = silhouette.astype(np.uint8)
    return (solid > 0) & (cv2.erode(solid, np.ones((3, 3), np.uint8)) == 0)


def check_edges(one: np.ndarray, other: np.ndarray) -> None:
    """Check that the outlines of two silhouettes [h, w] are less than a pixel apart, both ways."""
    lines = [_outline(each) for each in (one, other)]
    assert all(line.any() for line in lines)
    far = [cv2.distanceTransform((~line).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE) for line in lines]
    apart = np.concatenate([far[1][lines[0]], far[0][lines[1]]])
    assert np.percentile(apart, _SURE) < 1
    assert apart.max() < 2


def check_silhouette(sequence: TrackedSequence) -> None:
    """Check the drawn mesh against the imported mattes: the pictures themselves, which no writer's formula explains."""
    for camera, view in enumerate(sequence.tracking.cameras):
        for timestep in range(sequence.capture.timesteps):
            mesh = sequence.face_model(sequence.tracking.face[timestep])[0]
            drawn = (rasterize_mesh(mesh, sequence.face_model.faces, view).face_index >= 0).numpy()
            check_edges(drawn, np.asarray(sequence.capture.mattes[timestep, camera]) > 127)


def check_pictures(sequence: Any, timestep: int, drawn: tuple[np.ndarray, np.ndarray], camera: int = 0) -> None:
    """Check that a picture and its matte are the drawn ones, exactly."""
    image, matte = drawn
    assert np.array_equal(sequence.capture.images[timestep, camera], image)
    assert np.array_equal(sequence.capture.mattes[timestep, camera], matte)


def read(path: Path, name: str, model: Any = None) -> list[Any]:
    """Return what the importer of this name reads, which has to recognise the folder by itself."""
    dataset, _ = recognised(path)
    assert dataset.name == name
    return list(dataset.read(path, model))  # type: ignore[arg-type]


def read_pictures(path: Path) -> Any:
    dataset, _ = recognised(path)
    assert dataset.read_pictures is not None
    (found,) = dataset.read_pictures(path)
    return found


def surveyed(path: Path) -> Findings:
    dataset, _ = recognised(path)
    assert dataset.survey is not None
    return dataset.survey(path)


def check_import(found: list[Any], layout: Layout, scene: Scene) -> None:
    shown = layout.shown(scene)
    for sequence, (name, timesteps), split in zip(found, layout.clips.items(), layout.splits, strict=True):
        assert isinstance(sequence, TrackedSequence)
        assert (sequence.capture.name, sequence.capture.camera_ids) == (name, layout.cameras)
        assert (sequence.own_split, sequence.capture.timesteps) == (split, len(timesteps))
        for row, timestep in enumerate(timesteps):
            vertices = layout.vertices(shown, timestep)
            for camera in range(len(layout.cameras)):
                view = layout.view(timestep, camera)
                check_projection(sequence, row, vertices, view, camera)
                # A rig stands still in the writer's world; before a single camera, the head moves.
                placed = view[1:] if layout.cameras[1:] else (MIRROR, np.zeros(3))
                check_view(filmed_camera(sequence, camera), *placed)
                check_pictures(sequence, row, draw(shown, vertices, *view, layout.size), camera)
                marks = sequence.capture.landmarks[row, camera]
                apart = np.abs(marks - projected(shown.marks(vertices), *view)).max()
                assert apart < LANDMARKS * sequence.capture.images.shape[2]
        check_silhouette(sequence)


def decoded(video: Path) -> np.ndarray:
    """Return the RGB pictures [t, h, w, 3] of a video, read by PyAV alone."""
    exact = Interpolation.BICUBIC | Interpolation.FULL_CHR_H_INT | Interpolation.ACCURATE_RND
    with av.open(str(video)) as container:
        frames = [frame.reformat(format="rgb24", interpolation=exact) for frame in container.decode(video=0)]
        return np.stack([frame.to_ndarray() for frame in frames])
