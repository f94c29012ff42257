"""Datasets that are videos, from the folder to a scored avatar: NeRSemble's raw recordings, takes of Live Link Face.
The videos show a synthetic person, in whom the detector finds a face, so that nothing of the path is replaced."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import color_charts
from dataset_writers import FRONTAL, write_nersemble, write_picture
from known import known
from mien.camera import Camera
from mien.capture import Capture, read_capture
from mien.capture.video import write_video
from mien.cli import main
from mien.lab.synthetic import RECIPES, Segment, SyntheticScene
from mien.training import read_curves, read_sequence

PERSON = replace(
    RECIPES["plain"], width=550, height=802, fps=25.0, turns=(25.0, 10.0), rotation=(14.0, 8.0, 4.0),
    script=(Segment("speech", 0.32),), texture_size=512,
)  # fmt: skip
SERIALS = (FRONTAL, "222200036", "222200046")
"""The cameras in the order of the drawn ring, whose first one is in front."""
STRIDE = 3
COLORS = {serial: color_charts.correction(seed) for seed, serial in enumerate(SERIALS)}
"""The correction of each camera's colours."""
FULL = 4
"""NeRSemble's pictures have so many times the side of those that are drawn here."""
LANDMARKS = ("--tracking.schedule", "landmarks", "--overlay", "none")
SMALL = ("--preset", "draft", "--training.resolution", "128")
PLAIN = ("--training.unseen", "trained", "--training.inside", "free", "--training.mesh", "tracked")
"""Options that leave out what closes the sides that no camera filmed."""


@pytest.fixture(scope="module")
def rig() -> SyntheticScene:
    turning = (Segment("turns", 0.6),)
    return SyntheticScene(replace(PERSON, cameras="ring", ring_size=3, fps=5.0, script=turning), 3)


def film(path: Path, pictures: list[np.ndarray], repeats: int = 1, fps: float = 73.0) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_video(path, (picture for picture in pictures for _ in range(repeats)), fps, crf=4)


def write_person(folder: Path, rig: SyntheticScene) -> list[np.ndarray]:
    """Write a person of NeRSemble's raw recordings, with one timestep in three pictures. Return the frontal mattes.
    The colours that the cameras film are others than those that were drawn, until they are corrected."""
    drawn = [list(rig.timestep_frames(timestep)) for timestep in range(rig.timesteps)]
    empty = (255 * known(rig.background)).astype(np.uint8)

    def video(path: Path, serial: str) -> None:
        own = (frames[SERIALS.index(serial)].image for frames in drawn)
        film(path, [color_charts.filmed(picture, COLORS[serial]) for picture in own], STRIDE)

    write_nersemble(folder, SERIALS, video, COLORS)
    for serial, matrix in COLORS.items():
        write_picture(folder / f"sequences/BACKGROUND/image_{serial}.jpg", color_charts.filmed(empty, matrix))
    full, cameras = np.diag([FULL, FULL, 1.0]), dict(zip(SERIALS, rig.cameras, strict=True))
    poses = {serial: camera.viewmat.double().tolist() for serial, camera in cameras.items()}
    intrinsics = {serial: (full @ camera.K.double().numpy()).tolist() for serial, camera in cameras.items()}
    content = {"world_2_cam": poses, "intrinsics": intrinsics}
    (folder / "calibration/camera_params.json").write_text(json.dumps(content))
    return [frames[SERIALS.index(FRONTAL)].matte for frames in drawn]


@pytest.mark.unchecked
def test_raw_recordings_of_nersemble_become_an_avatar(rig: SyntheticScene, tmp_path: Path) -> None:
    person, root = tmp_path / "017", tmp_path / "me"
    mattes = write_person(person, rig)
    assert main(["import", str(person), "--out", str(root)]) == 0
    assert main(["track", str(root), *LANDMARKS]) == 0
    folder = root / "sequences/EMO-1-shout+laugh"
    capture, tracking = read_capture(folder / "capture"), read_sequence(folder).tracking
    assert (capture.timesteps, capture.camera_ids) == (rig.timesteps, tuple(sorted(SERIALS)))
    check_cameras(rig, capture, tracking.cameras, mattes)
    check_colors(rig, capture)
    # The head is where it was drawn, in the dataset's world.
    off = tracking.face.head_translation - rig.tracking().face.head_translation
    assert float(off.norm(dim=1).median()) < 0.02
    assert (
        main(["train", str(root), "--run", "a", "--steps", "20", *SMALL, *PLAIN, "--training.record-every", "2"]) == 0
    )
    psnr = read_curves(root / "runs/a")["psnr"]
    assert psnr[-3:].mean() > psnr[:3].mean() + 1


def cropped(capture: Capture, serial: str, drawn: np.ndarray) -> np.ndarray:
    """Return the part of a drawn picture that a camera's captured pictures show."""
    crop = capture.source["cameras"][serial]["crop"]
    step = crop["width"] / capture.width
    to_drawn = np.array([[step, 0, crop["left"] + step / 2 - 0.5], [0, step, crop["top"] + step / 2 - 0.5]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(drawn, to_drawn, (capture.width, capture.height), flags=flags)


def check_colors(rig: SyntheticScene, capture: Capture) -> None:
    """Captured pictures have the drawn colours. tests/test_capture_lens.py has the terms in any order."""
    frames = list(rig.timestep_frames(0))
    for index, serial in enumerate(capture.camera_ids):
        drawn = cropped(capture, serial, frames[SERIALS.index(serial)].image)
        off = np.abs(capture.images[0, index].astype(float) - drawn).mean((0, 1))
        assert off.max() < 1, (serial, off)  # the video is lossy


def check_cameras(rig: SyntheticScene, capture, cameras: tuple[Camera, ...], mattes: list[np.ndarray]) -> None:
    """Check that cameras are the drawn ones, up to the crop, and that mattes are the person's."""
    places = {serial: index for index, serial in enumerate(capture.camera_ids)}
    for serial, drawn in zip(SERIALS, rig.cameras, strict=True):
        assert float((cameras[places[serial]].viewmat - drawn.viewmat).abs().max()) < 1e-5
    crop = capture.source["cameras"][FRONTAL]["crop"]
    step = crop["width"] / capture.width
    K, front = cameras[places[FRONTAL]].K.double().numpy(), rig.cameras[0].K.double().numpy()
    moved = np.array([[1, 0, crop["left"]], [0, 1, crop["top"]], [0, 0, 1]]) @ np.diag([step, step, 1.0]) @ K
    assert np.abs(moved - front).max() < 0.01
    for matte, found in zip(mattes, capture.mattes[:, places[FRONTAL]], strict=True):
        expected = cropped(capture, FRONTAL, matte)
        both, either = ((found > 127) & (expected > 127)).sum(), ((found > 127) | (expected > 127)).sum()
        assert both > 0.85 * either  # the network's mattes fade at the shirt
