"""Captures in the layouts of INSTA, IMavatar, NeRFace and NeRSemble: importers read them, and others' formulas fit.

The checks of conventions form every matrix from the description of the layout, and call nothing of mien's writers.
"""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from dataset_checks import CAMERA, check_intrinsics, filmed_camera
from dataset_scene import SIDE, Scene, make_scene, projected
from dataset_writers import UNEQUAL, rotation_of
from exported_captures import (
    CAMERAS,
    HELD_OUT,
    TIMESTEPS,
    TOLERANCE,
    TRAINED,
    check_face,
    check_frames,
    export,
    filmed,
    load,
    on_head,
    read,
    truth,
    view,
    with_one_camera,
    with_two_cameras,
)
from flame_like import posed_as_flame
from mien.datasets import matting, sequences
from mien.training import Sequence


@pytest.fixture(scope="module")
def scene(anny, tmp_path_factory) -> Scene:
    return make_scene(anny, tmp_path_factory.mktemp("flame"), TIMESTEPS)


@pytest.fixture(scope="module")
def both(scene: Scene) -> Sequence:
    return with_two_cameras(scene)


@pytest.fixture(scope="module")
def single(both: Sequence) -> Sequence:
    return with_one_camera(both)


@pytest.fixture
def undetected(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace the detector and the network of mattes, which find nothing in drawings this small."""
    monkeypatch.setattr(sequences, "detected_landmarks", lambda images: np.full((*images.shape[:2], 478, 2), 5.0))
    monkeypatch.setattr(matting, "fill_mattes", lambda *_: None)


def test_insta_is_read_back(single: Sequence, scene: Scene, tmp_path: Path) -> None:
    folder = export(tmp_path / "out", "insta", filmed(single, scene))
    (sequence,) = read(folder, "insta", scene)
    check_frames(sequence, single, tuple(range(TIMESTEPS)))
    check_face(sequence, scene, tuple(range(TIMESTEPS)), on_head(scene))
    assert sequence.own_split.timesteps == ((8, 10),)
    assert len(load(folder / "transforms_train.json")["frames"]) == len(TRAINED)


def test_insta_by_its_own_conventions(single: Sequence, scene: Scene, tmp_path: Path) -> None:
    """Cameras are camera-to-world with OpenCV's axes, and meshes are seen by them as the person in the pictures is."""
    folder = export(tmp_path / "out", "insta", filmed(single, scene))
    content = load(folder / "transforms.json")
    K = np.array([[content["fl_x"], 0, content["cx"]], [0, content["fl_y"], content["cy"]], [0, 0, 1]])
    for timestep, frame in enumerate(content["frames"]):
        mesh = np.array([line.split()[1:] for line in (folder / frame["mesh_path"]).read_text().splitlines()
                         if line.startswith("v ")], float)  # fmt: skip
        seen = np.linalg.inv(np.array(frame["transform_matrix"]))
        assert np.abs(projected(mesh, K, seen[:3, :3], seen[:3, 3]) - truth(scene, timestep)).max() < TOLERANCE
        values = np.loadtxt(folder / frame["exp_path"])
        assert values.shape == (100,)
        assert np.abs(values - scene.expr[timestep]).max() < 1e-6
        depth = cv2.imread(str(folder / frame["depth_path"]), cv2.IMREAD_UNCHANGED)
        assert depth is not None
        assert ((depth > 0) == (single.capture.mattes[timestep, 0] > 127)).mean() > 0.99
        assert 0.7e3 < np.median(depth[depth > 0]) < 1.2e3


def test_checkpoints_are_files_of_torch_for_an_old_numpy(single: Sequence, scene: Scene, tmp_path: Path) -> None:
    """FLAME with root and neck at rest, posed from the checkpoint, lies on the head."""
    folder = export(tmp_path / "out", "insta", filmed(single, scene))
    file = folder / "checkpoint" / "00003.frame"
    assert b"numpy._core" not in file.read_bytes()
    frame = torch.load(file, weights_only=False)
    pose = np.zeros((5, 3))
    for joint, rows in ((2, frame["flame"]["jaw"][0]), (3, frame["flame"]["eyes"][0, :6]),
                        (4, frame["flame"]["eyes"][0, 6:])):  # fmt: skip
        matrix = np.stack([rows[:3], rows[3:], np.cross(rows[:3], rows[3:])])
        pose[joint] = cv2.Rodrigues(matrix.astype(np.float64))[0][:, 0]
    counts = int(scene.arrays["identities"]), scene.arrays["shapedirs"].shape[2] - int(scene.arrays["identities"])
    coefficients = np.concatenate([frame["flame"]["shape"][0, : counts[0]], frame["flame"]["exp"][0, : counts[1]]])
    vertices = posed_as_flame(scene.arrays, pose, coefficients, np.zeros(3))
    opencv = {name: array[0].astype(np.float64) for name, array in frame["opencv"].items()}
    pixels = projected(vertices, opencv["K"], opencv["R"], opencv["t"])
    assert np.abs(pixels - truth(scene, 3))[on_head(scene)].max() < TOLERANCE


def test_imavatar_is_read_back(single: Sequence, scene: Scene, tmp_path: Path) -> None:
    folder = export(tmp_path / "out", "imavatar", filmed(single, scene))
    test, train = sorted(read(folder, "imavatar", scene), key=lambda each: each.capture.name)
    assert (train.capture.name, test.capture.name) == ("train", "test")
    for sequence, timesteps in ((train, TRAINED), (test, HELD_OUT)):
        check_frames(sequence, single, timesteps)
        check_face(sequence, scene, timesteps)
    assert test.own_split.whole(len(HELD_OUT))
    assert not train.own_split.timesteps


def test_imavatar_by_its_own_conventions(single: Sequence, scene: Scene, tmp_path: Path) -> None:
    """FLAME times four, OpenGL-like axes, a negative first intrinsic, and rays through whole pixels."""
    folder = export(tmp_path / "out", "imavatar", filmed(single, scene))
    content = load(folder / "out/train/flame_params.json")
    fx, fy, cx, cy = content["intrinsics"]
    assert fx < 0 < fy
    counts = int(scene.arrays["identities"]), scene.arrays["shapedirs"].shape[2] - int(scene.arrays["identities"])
    for frame, timestep in zip(content["frames"], TRAINED, strict=True):
        coefficients = np.concatenate([content["shape_params"][: counts[0]], frame["expression"][: counts[1]]])
        pose = np.array(frame["pose"]).reshape(5, 3)
        world = np.array(frame["world_mat"])
        x, y, z = (4 * posed_as_flame(scene.arrays, pose, coefficients, np.zeros(3)) @ world[:, :3].T + world[:, 3]).T
        assert z.max() < 0
        pixels = np.stack([SIDE * (fx * x / z + cx), SIDE * (fy * y / z + cy)], axis=1) + 0.5
        assert np.abs(pixels - truth(scene, timestep)).max() < TOLERANCE


def unit_of(folder: Path) -> float:
    """Return the unit of NeRFace's world in metres, which README.txt names."""
    line = next(each for each in (folder / "README.txt").read_text().splitlines() if "unit is" in each)
    return float(line.split("unit is ")[1].split(" m.")[0])


def check_pose(matrix: np.ndarray, single: Sequence, timestep: int, folder: Path) -> None:
    """Check a pose of the head that was read back, in the unit that README.txt names."""
    face, (rotation, translation) = single.tracking.face[timestep], view(0)
    turn = rotation @ rotation_of(face.head_rotation[0].double().numpy())
    shift = rotation @ face.head_translation[0].double().numpy() + translation
    assert np.abs(matrix[:3, :3] - turn).max() < CAMERA
    assert np.abs(matrix[:3, 3] * unit_of(folder) - shift).max() < CAMERA


@pytest.mark.usefixtures("undetected")
def test_nerface_is_read_back(single: Sequence, scene: Scene, tmp_path: Path) -> None:
    content = filmed(single, scene)
    folder = export(tmp_path / "out", "nerface", content)
    train, test = read(folder, "nerface", scene)
    for sequence, timesteps in ((train, TRAINED), (test, HELD_OUT)):
        over_white = np.stack([content.over_white(timestep) for timestep in timesteps])
        assert np.array_equal(sequence.capture.images[:, 0], over_white)
        assert (over_white[:, :5] == 255).all(), "no filmed background is left"
        check_intrinsics(filmed_camera(sequence), UNEQUAL)
        for row, timestep in enumerate(timesteps):
            check_pose(sequence.foreign["head_to_camera"][row], single, timestep, folder)
        foreign = sequence.foreign["expression"]
        expressions = single.tracking.face.expression.shape[1]
        assert np.allclose(foreign[:, :expressions], scene.expr[list(timesteps), :expressions], atol=1e-6)
        jaw = 3 * [each for each in scene.model.free_joint_names if each != "neck"].index("jaw")
        joint = slice(expressions + jaw, expressions + jaw + 3)
        assert np.allclose(foreign[:, joint], scene.pose[list(timesteps), 2], atol=1e-6)
    assert test.own_split.whole(len(HELD_OUT))


def test_nerface_by_its_own_conventions(single: Sequence, scene: Scene, tmp_path: Path) -> None:
    """A ray through (u, v) is R ((u - cx) / fx, -(v - cy) / fy, -1) in a world whose mirrored unit is not a metre."""
    folder = export(tmp_path / "out", "nerface", filmed(single, scene))
    content = load(folder / "transforms_test.json")
    fx, fy, cx, cy = content["intrinsics"]
    assert fx < 0 < fy
    points = np.array([[0.0, 0, 0], [0.05, 0, 0.06], [0, 0.06, 0.05], [-0.04, -0.05, 0.08]])  # in the head frame
    unit = unit_of(folder)
    for frame, timestep in zip(content["frames"], HELD_OUT, strict=True):
        pose = np.array(frame["transform_matrix"])
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
        world = points @ np.diag([-1.0, 1, 1]) / unit
        x, y, z = ((world - pose[:3, 3]) @ pose[:3, :3]).T
        assert (z < 0).all()
        pixels = np.stack([fx * x / -z + SIDE * cx, -fy * y / -z + SIDE * cy], axis=1) + 0.5
        face = single.tracking.face[timestep]
        turn = rotation_of(face.head_rotation[0].double().numpy())
        expected = projected(points @ turn.T + face.head_translation[0].double().numpy(), UNEQUAL, *view(0))
        assert np.abs(pixels - expected).max() < TOLERANCE


def test_nersemble_is_read_back(single: Sequence, scene: Scene, tmp_path: Path) -> None:
    folder = export(tmp_path / "out", "nersemble", filmed(single, scene))
    train, test = read(folder, "nersemble-benchmark", scene)
    for sequence, timesteps in ((train, TRAINED), (test, HELD_OUT)):
        check_frames(sequence, single, timesteps)
        check_face(sequence, scene, timesteps)
    assert test.own_split.whole(len(HELD_OUT))
    assert not train.own_split.timesteps


def test_nersemble_by_its_own_conventions(single: Sequence, scene: Scene, tmp_path: Path) -> None:
    """FLAME with its root at rest, turned about its origin by rotations that are Rx Ry Rz of the Euler angles."""
    folder = export(tmp_path / "out", "nersemble", filmed(single, scene))
    arrays = np.load(folder / "sequences/clip-test/tracking/flame2023_tracking_v2.npz")
    calibration = load(folder / "calibration/camera_params.json")
    seen, K = np.array(calibration["world_2_cam"][CAMERAS[0]]), np.array(calibration["intrinsics"][CAMERAS[0]])
    for row, timestep in enumerate(HELD_OUT):
        pose = np.stack([np.zeros(3), arrays["neck"][row], arrays["jaw"][row], *np.split(arrays["eyes"][row], 2)])
        counts = int(scene.arrays["identities"]), scene.arrays["shapedirs"].shape[2] - int(scene.arrays["identities"])
        coefficients = np.concatenate([arrays["shape"][0, : counts[0]], arrays["expression"][row, : counts[1]]])
        posed = posed_as_flame(scene.arrays, pose.astype(np.float64), coefficients, np.zeros(3))
        turn = arrays["rotation_matrices"][row].astype(np.float64)
        x, y, z = (rotation_of(np.eye(3)[axis] * float(arrays["rotation"][row, axis])) for axis in range(3))
        assert np.abs(x @ y @ z - turn).max() < 1e-6
        world = float(arrays["scale"][0, 0]) * posed @ turn.T + arrays["translation"][row]
        assert np.abs(projected(world, K, seen[:3, :3], seen[:3, 3]) - truth(scene, timestep)).max() < TOLERANCE


@pytest.mark.usefixtures("undetected")
def test_nersemble_with_several_cameras(both: Sequence, scene: Scene, tmp_path: Path) -> None:
    folder = export(tmp_path / "out", "nersemble", filmed(both, scene))
    train, _ = read(folder, "nersemble-benchmark", scene)
    assert train.capture.camera_ids == CAMERAS
    assert np.array_equal(train.capture.images, both.capture.images[list(TRAINED)])
    assert np.array_equal(train.capture.mattes, both.scoring[list(TRAINED)])
    for ours, theirs in zip(both.tracking.cameras, train.capture.calibration, strict=True):
        assert torch.allclose(ours.viewmat, theirs.viewmat, rtol=1e-6, atol=1e-7)
        assert torch.allclose(ours.K, theirs.K, rtol=1e-6)
    hidden = export(tmp_path / "hidden", "nersemble", filmed(both, scene, held_out_cameras=CAMERAS[1:]))
    assert not list(hidden.glob(f"sequences/*/*/cam_{CAMERAS[1]}.mp4"))
    assert CAMERAS[1] in load(hidden / "calibration/camera_params.json")["world_2_cam"]
    assert len(list((hidden / "scoring/truth").glob("*.png"))) == 2 * len(HELD_OUT) + len(TRAINED)
