"""Captures in the layouts of INSTA, IMavatar, NeRFace and NeRSemble: importers read them, and others' formulas fit.

The importers are tested with writers that call nothing of mien. What they do not read, or read in several ways, is
checked by matrices from the description of the layout."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from dataset_checks import CAMERA, PIXELS, check_intrinsics, check_projection, filmed_camera, read
from dataset_scene import SIDE, NoDetector, Scene, draw, drawn_person, head_view, projected
from dataset_writers import UNEQUAL, rotation_of, tracker_frame
from known import known
from mien.camera import Camera
from mien.capture import write_capture
from mien.capture.store import read_capture_hash
from mien.cli import main
from mien.datasets import overlay, pictures, sequences
from mien.datasets.layouts.filmed import Filmed, filmed_frames, vectors
from mien.datasets.layouts.layout import find_layout
from mien.datasets.layouts.writing import write_layout
from mien.datasets.pictures import read_picture
from mien.datasets.sequences import tracked_sequence
from mien.disk.workspace import Workspace
from mien.errors import UserError
from mien.evaluation.image_folders import ImageFolders, score_folders
from mien.face import FaceModel
from mien.face.models.flame_params import face_of_flame_params
from mien.pipeline import train as training
from mien.pipeline.export_dataset import settings_of
from mien.tracking import write_tracking
from mien.tracking.scoring import Scoring
from mien.tracking.scoring_files import write_scoring
from mien.training import TrainSettings
from mien.training.footage.sequence import Sequence
from refusals import complaint, refuses
from shared_things import write_toy_workspace

pytestmark = pytest.mark.unchecked

TIMESTEPS, HELD_OUT = 12, (8, 9)
ALL = tuple(range(TIMESTEPS))
TRAINED = tuple(t for t in ALL if t not in HELD_OUT)
CAMERAS = ("222200037", "222200036")
LAYOUTS = {
    "insta": ["00008", "00009"], "imavatar": ["1", "2"], "nerface": ["f_0000", "f_0001"],
    "nerf-blendshape": ["10", "11"], "avatar-mav": ["img_00000", "img_00001"],
    "nersemble": [f"clip-test_cam_{CAMERAS[0]}_0000{n}" for n in range(2)],
}  # fmt: skip
"""Layouts, with the names of their held-out pictures."""


def view(camera: int) -> tuple[np.ndarray, np.ndarray]:
    return head_view(2 + camera, 1.0)


def filmed_by(count: int, scene: Scene) -> Sequence:
    """Return the scene, filmed by so many calibrated cameras and tracked exactly. It is scored in the upper part."""
    arrays = {
        "shape": scene.shape, "expr": scene.expr, "rotation": scene.pose[:, 0], "neck_pose": scene.pose[:, 1],
        "jaw_pose": scene.pose[:, 2], "eyes_pose": scene.pose[:, 3:].reshape(-1, 6), "translation": scene.translation,
    }  # fmt: skip
    face = face_of_flame_params(Path("drawn"), arrays, scene.model)
    drawn = [[draw(scene, scene.vertices(t), UNEQUAL, *view(c)) for c in range(count)] for t in ALL]
    images, mattes = (np.stack([[each[part] for each in row] for row in drawn]) for part in range(2))
    images[:, :, :5] = 17  # a background that is not white
    cameras = {}
    for index, name in enumerate(CAMERAS[:count]):
        viewmat = np.eye(4, dtype=np.float32)
        viewmat[:3, :3], viewmat[:3, 3] = view(index)
        cameras[name] = Camera(torch.from_numpy(UNEQUAL).float(), torch.from_numpy(viewmat), SIDE, SIDE)
    found = tracked_sequence(Path("drawn"), "clip", images, mattes, cameras, scene.model, face, 25.0)
    scoring = mattes.copy()
    scoring[:, :, 86:] = 0
    return Sequence("clip", found.capture, found.tracking, scoring)


scene = pytest.fixture(scope="module")(lambda: drawn_person(TIMESTEPS))
both = pytest.fixture(scope="module")(lambda scene: filmed_by(2, scene))
single = pytest.fixture(scope="module")(lambda scene: filmed_by(1, scene))


@pytest.fixture(scope="module")
def folders(single: Sequence, scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    content, root = filmed(single, scene), tmp_path_factory.mktemp("exports")
    return {name: export(root / name / "out", name, content) for name in LAYOUTS}


@pytest.fixture(autouse=True)
def _undetected(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace the detector and the network of mattes, which find nothing in drawings this small."""
    monkeypatch.setattr(overlay, "LandmarkDetector", NoDetector)
    monkeypatch.setattr(sequences, "detected_landmarks", lambda images: np.full((*images.shape[:2], 478, 2), 5.0))
    monkeypatch.setattr(pictures, "fill_mattes", lambda *_: None)


def filmed(sequence: Sequence, scene: Scene, **settings: Any) -> Filmed:
    return filmed_frames(sequence, scene.model, replace(TrainSettings(split="blocks"), **settings), "head")


def export(folder: Path, name: str, content: Filmed) -> Path:
    write_layout(folder, content, known(find_layout(name)))
    return folder


def check_back(sequence: Any, single: Sequence, scene: Scene, timesteps: tuple[int, ...], bends: bool = True) -> None:
    which = slice(None) if bends else scene.arrays["weights"][:, 0] == 0
    assert np.array_equal(sequence.capture.images[:, 0], single.capture.images[list(timesteps), 0])
    assert np.array_equal(sequence.capture.mattes[:, 0], single.scoring[list(timesteps), 0])
    for row, timestep in enumerate(timesteps):
        check_projection(sequence, row, scene.vertices(timestep), (UNEQUAL, *view(0)), which=which)
    expression = sequence.tracking.face.expression
    wanted = torch.from_numpy(scene.expr[list(timesteps), : expression.shape[1]]).float()
    assert torch.allclose(expression, wanted, atol=1e-6)


def test_insta_is_read_back(folders: dict[str, Path], single: Sequence, scene: Scene) -> None:
    (sequence,) = read(folders["insta"], "insta", scene.model)
    check_back(sequence, single, scene, ALL, bends=False)
    assert sequence.own_split.timesteps == ((8, 10),)
    assert len(json.loads((folders["insta"] / "transforms_train.json").read_text())["frames"]) == len(TRAINED)
    # Checkpoints are files of torch for an old numpy.
    file, wanted = folders["insta"] / "checkpoint/00003.frame", tracker_frame(scene, 3, UNEQUAL)
    assert b"numpy._core" not in file.read_bytes()
    frame = torch.load(file, weights_only=False)
    for part in ("flame", "opencv"):
        shapes = [{name: (array.shape, array.dtype) for name, array in each[part].items()} for each in (frame, wanted)]
        assert shapes[0] == {name: shapes[1][name] for name in shapes[0]}
    # Cameras are camera-to-world with OpenCV's axes, and meshes are seen by them as the person in the pictures is.
    folder = folders["insta"]
    content = json.loads((folder / "transforms.json").read_text())
    K = np.array([[content["fl_x"], 0, content["cx"]], [0, content["fl_y"], content["cy"]], [0, 0, 1]])
    for timestep, frame in enumerate(content["frames"]):
        lines = (folder / frame["mesh_path"]).read_text().splitlines()
        mesh = np.array([line.split()[1:] for line in lines if line.startswith("v ")], float)
        seen = np.linalg.inv(np.array(frame["transform_matrix"]))
        drawn = projected(scene.vertices(timestep), UNEQUAL, *view(0))
        assert np.abs(projected(mesh, K, seen[:3, :3], seen[:3, 3]) - drawn).max() < PIXELS
        np.testing.assert_allclose(np.loadtxt(folder / frame["exp_path"]), scene.expr[timestep], rtol=0, atol=1e-6)
        depth = known(cv2.imread(str(folder / frame["depth_path"]), cv2.IMREAD_UNCHANGED))
        assert ((depth > 0) == (single.capture.mattes[timestep, 0] > 127)).mean() > 0.99
        assert 0.7e3 < np.median(depth[depth > 0]) < 1.2e3


def test_imavatar_is_read_back(folders: dict[str, Path], single: Sequence, scene: Scene) -> None:
    test, train = sorted(read(folders["imavatar"], "imavatar", scene.model), key=lambda each: each.capture.name)
    assert (train.capture.name, test.capture.name) == ("train", "test")
    fx, fy, cx, cy = json.loads((folders["imavatar"] / "out/train/flame_params.json").read_text())["intrinsics"]
    assert fx < 0 < fy
    assert max(cx, cy) < 1
    check_halves(train, test, single, scene)


def check_halves(train: Any, test: Any, single: Sequence, scene: Scene) -> None:
    for sequence, timesteps in ((train, TRAINED), (test, HELD_OUT)):
        check_back(sequence, single, scene, timesteps)
    assert test.own_split.whole(len(HELD_OUT))
    assert not train.own_split.timesteps


def check_vectors(sequence: Any, timesteps: tuple[int, ...], single: Sequence, scene: Scene, unit: float) -> None:
    """Check intrinsics, the head's poses in metres, and the numbers in place of expressions."""
    check_intrinsics(filmed_camera(sequence), UNEQUAL)
    for row, timestep in enumerate(timesteps):
        matrix = sequence.foreign["head_to_camera"][row]
        face, (rotation, translation) = single.tracking.face[timestep], view(0)
        turn = rotation @ rotation_of(face.head_rotation[0].double().numpy())
        shift = rotation @ face.head_translation[0].double().numpy() + translation
        np.testing.assert_allclose(matrix[:3, :3], turn, rtol=0, atol=CAMERA)
        np.testing.assert_allclose(matrix[:3, 3] * unit, shift, rtol=0, atol=CAMERA)
    check_numbers(sequence.foreign["expression"], timesteps, single, scene)


def check_numbers(numbers: np.ndarray, timesteps: tuple[int, ...], single: Sequence, scene: Scene) -> None:
    moved = [each for each in scene.model.free_joint_names if each != "neck"]
    whole = scene.expr[:, : single.tracking.face.expression.shape[1]]
    kept = np.sort(np.argsort(-whole.std(0))[: numbers.shape[1] - 3 * len(moved)])
    expressions = len(kept)
    assert np.allclose(numbers[:, :expressions], whole[list(timesteps)][:, kept], atol=1e-6)
    joint = slice(expressions + 3 * moved.index("jaw"), expressions + 3 * moved.index("jaw") + 3)
    assert np.allclose(numbers[:, joint], scene.pose[list(timesteps), 2], atol=1e-6)


def test_nerface_is_read_back(folders: dict[str, Path], single: Sequence, scene: Scene) -> None:
    train, test = read(folders["nerface"], "nerface", scene.model)
    fx, fy, *_ = json.loads((folders["nerface"] / "transforms_test.json").read_text())["intrinsics"]
    assert fx < 0 < fy, "the world is mirrored, as in the published files"
    unit = known(re.search(r"unit is (\S+) m\.", (folders["nerface"] / "README.txt").read_text()))
    for sequence, timesteps in ((train, TRAINED), (test, HELD_OUT)):
        over_white = np.stack([filmed(single, scene).over_white(timestep) for timestep in timesteps])
        assert np.array_equal(sequence.capture.images[:, 0], over_white)
        assert (over_white[:, :5] == 255).all(), "no filmed background is left"
        check_vectors(sequence, timesteps, single, scene, float(unit[1]))
    assert test.own_split.whole(len(HELD_OUT))


def near(folder: Path, name: str, picture: np.ndarray) -> bool:
    """Whether a file holds a picture, but for the loss of a .jpg."""
    return np.abs(read_picture(folder / name)[0].astype(int) - picture).mean() < 1


def test_nerf_blendshape_is_read_back(folders: dict[str, Path], single: Sequence, scene: Scene) -> None:
    """Held-out frames come last; a picture has its head, its parsing and its landmarks by its number."""
    folder, order, content = folders["nerf-blendshape"], (*TRAINED, *HELD_OUT), filmed(single, scene)
    (sequence,) = read(folder, "nerf-blendshape", scene.model)
    for number, timestep in enumerate(order):
        assert near(folder, f"ori_imgs/{number}.jpg", content.image(timestep))
        assert near(folder, f"head_imgs/{number}.jpg", content.over_white(timestep))
        assert np.array_equal(sequence.capture.mattes[number, 0], (content.matte(timestep) > 127) * np.uint8(255))
        marks = single.capture.landmarks[timestep, 0]
        assert np.allclose(sequence.capture.landmarks[number, 0], marks, atol=1e-3)
    check_vectors(sequence, order, single, scene, 1.0)
    own = np.array([frame["exp_ori"] for frame in json.loads((folder / "transforms.json").read_text())["frames"]])
    assert np.allclose(np.loadtxt(folder / "max_46.txt"), own[: len(TRAINED)].max(0)), "held-out frames do not count"
    assert np.allclose(np.loadtxt(folder / "min_46.txt"), own[: len(TRAINED)].min(0))
    assert near(folder, "bc.jpg", np.full((SIDE, SIDE, 3), 255))
    assert "--test_start 10." in (folder / "README.txt").read_text()


def test_avatar_mav_is_read_back(folders: dict[str, Path], single: Sequence, scene: Scene, tmp_path: Path) -> None:
    """By the formulas of its camera: heads look as they were filmed. Filmed by a camera as far away, exactly."""
    camera, content, focal = single.tracking.cameras[0], filmed(single, scene), 2500 / 256 * SIDE
    mav = np.array([[focal, 0, SIDE / 2], [0, focal, SIDE / 2], [0, 0, 1]])
    viewmat = camera.viewmat.clone()
    viewmat[2, 3] *= focal / camera.K[0, 0]
    afar = replace(camera, K=torch.from_numpy(mav).float(), viewmat=viewmat)
    far = filmed(replace(single, tracking=replace(single.tracking, cameras=(afar,))), scene)
    far_folder = export(tmp_path / "far", "avatar-mav", far)
    for folder, one, most in ((folders["avatar-mav"], camera, 3.0), (far_folder, afar, 0.01)):
        told = (folder / "README.txt").read_text()
        unit, *origin = map(float, known(re.search(r"unit is (\S+) m, .* at (\S+), (\S+), (\S+) m", told)).groups())
        for part, timesteps in (("train", TRAINED), ("test", HELD_OUT)):
            assert len(list((folder / part / "images").iterdir())) == 2 * len(timesteps)
            for number, timestep in enumerate(timesteps):
                assert near(folder, f"{part}/images/img_{number:05d}.jpg", content.image(timestep))
                mask = np.repeat(content.matte(timestep)[..., None], 3, axis=2)
                assert near(folder, f"{part}/images/mask_{number:05d}.jpg", mask)
                found = np.load(folder / part / f"params/params_{number:05d}.npz")
                shapes = {name: (found[name].shape, found[name].dtype.name) for name in found.files}
                assert shapes == {name: (shape, "float32") for name, shape in _MAV.items()}
                check_numbers(found["exp_coeff"], (timestep,), single, scene)
                head = scene.model.head_vertices(single.tracking.face[timestep])[0].double().numpy()
                pose = found["pose"][0].astype(float)
                world = found["scale"] * ((head - origin) / unit) @ rotation_of(pose[:3]).T + pose[3:]
                seen = projected(world, mav, np.diag([1.0, -1, -1]), np.array([0, 0, 4.0]))
                true, _ = one.project(scene.model(single.tracking.face[timestep])[0])
                assert np.abs(seen - true.double().numpy()).max() < most


def test_without_room_for_all_the_expressions_that_change_most_are_written(single: Sequence, scene: Scene) -> None:
    expression = single.tracking.face.expression.clone()
    expression[:, 1], expression[:, -1] = 0.5, torch.arange(TIMESTEPS) * 9.0
    face = replace(single.tracking.face, expression=expression)
    content = filmed(replace(single, tracking=replace(single.tracking, face=face)), scene)
    joints = 3 * len([each for each in scene.model.free_joint_names if each != "neck"])
    numbers, told = vectors(content, joints + 1)
    assert np.array_equal(numbers[:, 0], expression[:, -1].double().numpy())
    assert any(f"the {expression.shape[1] - 1} expression coefficients that change least" in words for words in told)


_MAV = {"pose": (1, 6), "scale": (1,), "exp_coeff": (1, 32)}


def test_nersemble_is_read_back(folders, single: Sequence, both: Sequence, scene: Scene, tmp_path: Path) -> None:
    train, test = read(folders["nersemble"], "nersemble-benchmark", scene.model)
    check_halves(train, test, single, scene)
    folder = export(tmp_path / "out", "nersemble", filmed(both, scene))
    train, _ = read(folder, "nersemble-benchmark", scene.model)
    assert train.capture.camera_ids == CAMERAS
    assert np.array_equal(train.capture.images, both.capture.images[list(TRAINED)])
    assert np.array_equal(train.capture.mattes, both.scoring[list(TRAINED)])
    for ours, theirs in zip(both.tracking.cameras, train.capture.calibration, strict=True):
        assert torch.allclose(ours.viewmat, theirs.viewmat, rtol=1e-6, atol=1e-7)
        assert torch.allclose(ours.K, theirs.K, rtol=1e-6)
    hidden = export(tmp_path / "hidden", "nersemble", filmed(both, scene, held_out_cameras=CAMERAS[1:]))
    assert not list(hidden.glob(f"sequences/*/*/cam_{CAMERAS[1]}.mp4"))
    assert CAMERAS[1] in json.loads((hidden / "calibration/camera_params.json").read_text())["world_2_cam"]
    assert len(list((hidden / "scoring/truth").glob("*.png"))) == 2 * len(HELD_OUT) + len(TRAINED)


def test_pictures_of_others_are_scored_against_the_truth(folders: dict[str, Path], single: Sequence) -> None:
    """A program that gives back the held-out pictures over white, by name, has a perfect score."""
    for name, expected in LAYOUTS.items():
        found = sorted((folders[name] / "scoring/truth").glob("*.png"))
        assert [file.stem for file in found] == expected
        for file, timestep in zip(found, HELD_OUT, strict=True):
            picture, _ = read_picture(file)
            inside, outside = (single.scoring[timestep, 0] == level for level in (255, 0))
            assert np.array_equal(picture[inside], single.capture.images[timestep, 0][inside])
            assert (picture[outside] == 255).all()
        assert "mien evaluate images PICTURES scoring/truth" in (folders[name] / "README.txt").read_text()
    truths = folders["insta"] / "scoring/truth"
    assert score_folders(ImageFolders(truths, truths))["l1"] == 0


def test_frames_that_mien_does_not_train_on_are_left_out(single: Sequence, scene: Scene, tmp_path: Path) -> None:
    valid = np.arange(TIMESTEPS) != 3
    tracking = replace(single.tracking, valid=torch.from_numpy(valid))
    gone = replace(single, capture=replace(single.capture, valid=valid[:, None]), tracking=tracking)
    folder = export(tmp_path / "out", "insta", filmed(gone, scene))
    (sequence,) = read(folder, "insta", scene.model)
    check_back(sequence, single, scene, tuple(t for t in range(TIMESTEPS) if t != 3), bends=False)
    assert sequence.own_split.timesteps == ((7, 9),), "numbers have no gaps"
    assert "Left out: 1 frame " in (folder / "README.txt").read_text()
    assert sorted(each.name for each in tmp_path.iterdir()) == ["out"], "nothing else is left"


def test_what_a_layout_cannot_hold_is_told_or_refused(
    both: Sequence, single: Sequence, scene: Scene, anny: FaceModel, tmp_path: Path
) -> None:
    for name in ("insta", "imavatar", "nerface", "nerf-blendshape", "avatar-mav"):
        with pytest.raises(UserError, match=f"clip: has 2 cameras, and the layout {name} holds one"):
            export(tmp_path / name, name, filmed(both, scene))
    images, mattes = (each[:, :, :, :99] for each in (single.capture.images, single.capture.mattes))
    narrow = replace(single, capture=replace(single.capture, images=images, mattes=mattes), scoring=mattes)
    refuses("of 99x128, and the layout avatar-mav holds square ones", export, tmp_path / "narrow", "avatar-mav",
            filmed(narrow, scene))  # fmt: skip
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "a").touch()
    refuses("full: is not empty", export, tmp_path / "full", "nersemble", filmed(both, scene))
    with pytest.raises(UserError, match=f"{tmp_path}/my_images: programs of this layout replace every 'image'"):
        export(tmp_path / "my_images", "imavatar", filmed(single, scene))
    other = replace(single, tracking=replace(single.tracking, face=anny.neutral(TIMESTEPS), face_model="anny"))
    content = filmed_frames(other, anny, TrainSettings(), "person")
    with pytest.raises(UserError, match=r"clip: is tracked on 'anny', and .* pose FLAME themselves; track it with"):
        export(tmp_path / "imavatar", "imavatar", content)
    assert not (tmp_path / "imavatar").exists()
    for name, words in (("insta", "they are not FLAME's"), ("nerface", "axis-angles of left_eye, right_eye"),
                        ("nersemble", "tracking: not written, because anny is not FLAME")):  # fmt: skip
        folder = export(tmp_path / name, name, content)
        readme = (folder / "README.txt").read_text()
        assert words in readme, name
        assert "Mattes: the person." in readme
        assert not [file for file in folder.rglob("*") if file.suffix in (".frame", ".npz")]


def test_the_command(single: Sequence, scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    workspace, out = tmp_path / "W", tmp_path / "out"
    folder = workspace / "sequences" / "clip"
    write_capture(folder / "capture", single.capture)
    write_tracking(folder / "tracking", single.tracking)
    crops = np.tile(np.array([4, 4, 20, 20], np.int64), (TIMESTEPS, 1, 1))
    write_scoring(folder / "scoring", Scoring(single.scoring, crops), read_capture_hash(folder / "capture"))
    monkeypatch.setattr(training, "load_face_model", lambda _: scene.model)

    def refused(message: str, *options: str) -> None:
        assert message in complaint(capsys, "export-dataset", workspace, "--out", out, *options)

    refused("--benchmark is an option of --format nersemble-benchmark", "--format", "insta", "--benchmark", "393")
    layouts = "insta, imavatar, nerface, nerf-blendshape, avatar-mav, nersemble or nersemble-benchmark"
    refused(f"choose {layouts}", "--format", "inst")
    refused("there is no run yet", "--format", "insta", "--run", "me")
    refused("no sequence 'other'", "--format", "insta", "--sequence", "other")
    refused("--split dataset: the sequence clip has no split", "--format", "insta", "--split", "dataset")
    assert main(["export-dataset", str(workspace), "--out", str(out), "--format", "insta", "--split", "tail"]) == 0
    assert f"{out}: 10 training frames, 2 held out; see README.txt" in capsys.readouterr().err
    (sequence,) = read(out, "insta", scene.model)
    assert sequence.own_split.timesteps == ((10, 12),)
    refused("out: is not empty, and a capture is written into a new folder", "--format", "insta")
    (workspace / "sequences/clip/tracking/tracking.json").unlink()
    refused("the sequence clip is not tracked", "--format", "nerface")


def test_a_run_decides_what_is_held_out(tmp_path: Path) -> None:
    write_toy_workspace(tmp_path)  # the last fifth
    workspace = Workspace(tmp_path)
    assert settings_of(workspace, "clip", "toy", None).split == "tail"
    assert settings_of(workspace, "clip", None, None).split == "blocks"
    refuses("--run toy: was trained on clip, not on other", settings_of, workspace, "other", "toy", None)
