"""Several calibrated cameras: one capture, cropped to the head in every picture, and calibrations that do not fit."""

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from capture_helpers import interrupt_at, scan_texture, tree_bytes, write_rig
from mien.camera import Camera, look_at
from mien.capture import from_cameras
from mien.capture.cameras.calibration import read_calibration
from mien.capture.cameras.head_path import choose_crops, find_head_path
from mien.capture.capture import Capture
from mien.capture.from_cameras import capture_cameras
from mien.capture.settings import CaptureSettings
from mien.errors import UserError
from refusals import complaint, refuses

WIDTH, HEIGHT, FRAMES = 400, 300, 3
SMALL = CaptureSettings(size=64)
FACE = 0.26
"""Side in metres of the flat face that the cameras see."""


def camera_at(x: float, y: float, z: float, focal: float) -> Camera:
    viewmat = look_at(torch.tensor([x, y, z]), torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]))
    return Camera(torch.tensor([[focal, 0, WIDTH / 2], [0, focal, HEIGHT / 2], [0, 0, 1]]), viewmat, WIDTH, HEIGHT)


CAMERAS = {
    "left": camera_at(-0.25, 0.05, 1.2, 520.0), "middle": camera_at(0.0, 0.0, 1.0, 430.0),
    "right": camera_at(0.3, -0.04, 1.1, 480.0), "top": camera_at(0.0, 0.3, 1.1, 480.0),
    "back": camera_at(0.1, 0.0, -1.2, 500.0),
}  # fmt: skip


def corners_at(timestep: int) -> torch.Tensor:
    """Corners of the flat face: top left, top right, bottom right, bottom left in pictures from the front."""
    half = FACE / 2
    square = torch.tensor([[-half, half, 0.0], [half, half, 0.0], [half, -half, 0.0], [-half, -half, 0.0]])
    return square + torch.tensor([0.01 * timestep, 0.0, 0.0])


@pytest.fixture(scope="module")
def rig(test_data, tmp_path_factory):
    """Pictures and calibration of all cameras; the back camera sees a plain board."""
    folder, side, entries = tmp_path_factory.mktemp("rig"), 512, []
    texture = cv2.resize(scan_texture(test_data), (side, side), interpolation=cv2.INTER_AREA)
    source = np.array([[0, 0], [side, 0], [side, side], [0, side]], np.float32)
    for camera_id, camera in CAMERAS.items():
        place = folder / "pictures" / camera_id
        place.mkdir(parents=True)
        board = np.full_like(texture, 90) if camera_id == "back" else texture
        for timestep in range(FRAMES):
            picture = np.full((HEIGHT, WIDTH, 3), 170, np.uint8)
            corners = camera.project(corners_at(timestep))[0].numpy().astype(np.float32) - 0.5
            warp, how = cv2.getPerspectiveTransform(source, corners), {"borderMode": cv2.BORDER_TRANSPARENT}
            cv2.warpPerspective(board, warp, (WIDTH, HEIGHT), picture, flags=cv2.INTER_AREA, **how)
            cv2.imwrite(str(place / f"{timestep}.png"), picture[..., ::-1])
        matrices = {"K": camera.K.tolist(), "viewmat": camera.viewmat.tolist()}
        entries.append({"id": camera_id, **matrices, "width": WIDTH, "height": HEIGHT})
    return folder / "pictures", write_rig(folder / "rig.json", *entries)


def capture_changed(rig, folder: Path, change: Callable[[list[dict]], list[dict]], **settings) -> Capture:
    write_rig(folder / "rig.json", *change(json.loads(rig[1].read_text())["cameras"]))
    out = folder / "out" / "capture"
    return capture_cameras([rig[0]], folder / "rig.json", out, "s", replace(SMALL, **settings))


@pytest.mark.unchecked
def test_cameras_become_one_capture_with_the_head_at_one_scale(rig, tmp_path):
    half = read_calibration(rig[1])[0].for_pictures(WIDTH // 2, HEIGHT // 2)
    assert half.width == WIDTH // 2
    torch.testing.assert_close(half.K[:2], CAMERAS["left"].K[:2] / 2)
    capture = capture_cameras([rig[0]], rig[1], tmp_path / "s" / "capture", "s", CaptureSettings(size=128))
    assert (capture.camera_ids, capture.images.shape) == (tuple(CAMERAS), (FRAMES, 5, 128, 128, 3))
    assert capture.calibration is not None
    assert capture.valid[:, :4].all()
    assert not capture.valid[:, 4].any()
    sizes = []
    for index, camera in enumerate(capture.calibration):
        corners = camera.project(corners_at(0))[0]
        assert ((corners > 0) & (corners < 128)).all(), capture.camera_ids[index]
        sizes.append(float(corners[:, 1].max() - corners[:, 1].min()))
    assert max(sizes) < 1.15 * min(sizes)
    # The cropped cameras agree with the cropped pictures: the nose tip of all cameras is at the same place of the face.
    first: np.ndarray | None = None
    for index in range(4):
        corners = capture.calibration[index].project(corners_at(0))[0].numpy().astype(np.float32)
        unit = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
        to_face = cv2.getPerspectiveTransform(corners, unit)
        places = cv2.perspectiveTransform(capture.landmarks[0, index][None].astype(np.float32), to_face)[0]
        first = places if first is None else first
        assert np.median(np.linalg.norm(places - first, axis=-1)) < 0.02, capture.camera_ids[index]


@pytest.mark.unchecked
def test_same_command_reads_the_capture_back_and_an_interrupted_one_continues(rig, tmp_path, monkeypatch):
    settings = replace(SMALL, max_frames=2)
    capture_cameras([rig[0]], rig[1], tmp_path / "whole" / "capture", "s", settings)
    calls = interrupt_at(3, monkeypatch, from_cameras, "process_part")
    out = tmp_path / "stopped" / "capture"
    pytest.raises(KeyboardInterrupt, capture_cameras, [rig[0]], rig[1], out, "s", settings)
    capture_cameras([rig[0]], rig[1], out, "s", settings)
    assert tree_bytes(out) == tree_bytes(tmp_path / "whole" / "capture")
    done = len(calls)
    capture_cameras([rig[0]], rig[1], out, "s", settings)
    assert len(calls) == done


@pytest.mark.parametrize("camera", ["middle", "top"])
def test_unequal_lengths_are_refused_before_faces_are_searched(rig, tmp_path, monkeypatch, camera):
    """A camera has an offset, or lacks a picture. Fewer frames pair those of all cameras."""
    pictures, out = tmp_path / "pictures", tmp_path / "out" / "capture"
    shutil.copytree(rig[0], pictures)
    entries = json.loads(rig[1].read_text())["cameras"]
    if camera == "middle":
        entries[1]["offset"] = 1
    else:
        (pictures / camera / f"{FRAMES - 1}.png").unlink()
    calibration = write_rig(tmp_path / "rig.json", *entries)
    refusal = f"camera {camera} has 2 frames, but camera left has 3; .* --capture.max-frames 2"
    with monkeypatch.context() as patched:
        patched.setattr("mien.capture.from_cameras.survey_source", lambda *_: pytest.fail("faces were searched"))
        refuses(refusal, capture_cameras, [pictures], calibration, out, "s", SMALL)
    assert not (tmp_path / "out").exists()
    capture = capture_cameras([pictures], calibration, out, "s", replace(SMALL, max_frames=2))
    first_frames = [capture.source["cameras"][name]["first_frame"] for name in ("left", "middle")]
    assert (capture.timesteps, first_frames) == (2, [0, int(camera == "middle")])


def viewed(entry: dict, change: Callable[[np.ndarray], np.ndarray]) -> dict:
    return {**entry, "viewmat": change(np.array(entry["viewmat"])).tolist()}


def first(**changes: object) -> Callable[[list[dict]], list[dict]]:
    """Return a function that changes the entry of the first camera."""
    return lambda entries: [{**entries[0], **changes}, *entries[1:]]


THOUSAND = np.diag([1000.0, 1000, 1000, 1])
BACKWARDS = np.diag([-1.0, 1, -1, 1])
"""Turns a camera to the other side, as one with OpenGL's axes looks."""


@pytest.mark.parametrize(("change", "message"), [
    (first(id="other"), "no camera 'left', it has back, middle, other, right, top"),
    (lambda e: [*e, {**e[0], "id": "extra"}], "there is no video of the camera extra"),
    (lambda e: [e[0], *e], "two cameras have the id 'left'"),
    (first(width=300), "calibration is for pictures of 300x300, its video has 400x300"),
    (first(viewmat=np.zeros((4, 4)).tolist()), "viewmat is not a rotation and translation"),
    (first(K=np.zeros((3, 3)).tolist()), "focal lengths 0 and 0, which must be above 0"),
    (first(K=[1, 2]), "K must be 3x3"),
    (lambda e: [{"K": e[0]["K"]}, *e[1:]], "camera 0: has no `id`"),
    (lambda e: [{"id": "left"}, *e[1:]], r"camera 0 \(left\): has no K, viewmat, width, height"),
    (first(offset=-1), "offset -1 is not a number of frames"),
    (first(id="../x"), "cannot be an id"),
    (first(offset=FRAMES), f"its offset of {FRAMES} leaves no frame of .*left"),
    (lambda e: [e[0], viewed(e[1], lambda m: BACKWARDS @ m), *e[2:]],
     "middle finds a face, but the other cameras see the head behind"),
    (lambda e: [], "has no list `cameras`"),
    (lambda e: [viewed(entry, lambda m: THOUSAND @ m @ np.linalg.inv(THOUSAND)) for entry in e],
     r"the face is \d+ m wide, but it should be about 0.15; .* last column of every viewmat by 0.00\d+\)"),
])  # fmt: skip
def test_calibration_that_does_not_fit_is_refused(rig, tmp_path, change, message):
    refuses(message, capture_changed, rig, tmp_path, change, max_frames=1)
    assert not (tmp_path / "out").exists()


def test_camera_that_disagrees_is_reported(rig, tmp_path, capsys):
    wrong = CAMERAS["left"].viewmat.clone()
    wrong[0, 3] += 0.4
    capture_changed(rig, tmp_path, first(viewmat=wrong.tolist()), max_frames=2)
    assert "warning: camera left sees the face" in capsys.readouterr().err


def boxes_of(point: torch.Tensor, cameras: list[Camera]) -> np.ndarray:
    """Return boxes of 60 pixels around a point in two pictures of all cameras."""
    middles = np.stack([camera.project(point)[0].numpy() for camera in cameras])
    return np.concatenate([middles - 30, middles + 30], axis=-1)[None].repeat(2, axis=0)


def test_a_face_that_is_none_does_not_move_the_head_and_cameras_that_never_agree_check_their_names():
    cameras = list(CAMERAS.values())
    true = torch.tensor([0.02, 0.03, 0.05])
    boxes = boxes_of(true, cameras)
    boxes[0, 4] += 80  # the back camera mistakes something else
    boxes[1, :4] = np.nan
    path = find_head_path(boxes, cameras)
    np.testing.assert_allclose(path.centers[0], true.numpy(), atol=1e-4)
    assert path.agrees.tolist() == [[True] * 4 + [False], [False] * 5]
    assert not path.known[1]
    crops, size = choose_crops(path, cameras, 512, whole=False)
    assert size[0] == min(crop.crop_width for crop in crops)
    cameras = list(CAMERAS.values())[:4]
    boxes = boxes_of(torch.tensor([0.02, 0.03, 0.05]), cameras)
    boxes += np.array([0, 400, -400, 900])[:, None] * np.array([0, 1, 0, 1])
    refuses("check first that each video or folder has the name of its own camera's id", find_head_path, boxes, cameras)


def test_command_line_names_what_does_not_fit(rig, tmp_path, capsys):
    out = ["--out", str(tmp_path / "out")]
    for arguments, message in (
        (["capture", str(rig[0]), *out], "holds no images; .* add --calibration FILE"),
        (["capture", str(rig[0]), *out, "--calibration", str(rig[0])], "is a folder; give the json file"),
        (["capture", str(rig[0] / "left"), str(rig[0] / "top"), *out], "several videos become one capture only if"),
        (["create", str(rig[0]), *out, "--calibration", str(rig[1]), "--hold-out-cameras", "07"], "no such camera"),
        (["create", str(rig[0]), *out, "--calibration", str(rig[1]), "--name", "a", "b"], "give one name"),
    ):
        assert re.search(message, complaint(capsys, *arguments))
    assert not (tmp_path / "out" / "sequences").exists()


def test_a_reading_is_found_in_the_pictures(rig, tmp_path):
    """Matrices from camera to world with OpenGL's axes, in the world of the left camera."""
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    world = np.linalg.inv(CAMERAS["left"].viewmat.numpy()) @ flip
    message = "no two cameras ever .*; the matrices go from camera to world with OpenGL's"
    with pytest.raises(UserError, match=message) as error:
        capture_changed(rig, tmp_path, lambda e: [viewed(one, lambda m: np.linalg.inv(flip @ m @ world)) for one in e])
    assert "cannot tell" not in str(error.value)
