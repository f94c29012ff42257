"""Datasets whose tracking mien cannot use, and the NeRSemble benchmark: what independent writers wrote is imported."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import dataset_checks as checks
import dataset_writers as writers
from dataset_scene import Scene, draw, drawn_person, head_view, projected, unfound
from mien.capture.cameras.calibration import read_calibration
from mien.capture.settings import CaptureSettings
from mien.datasets import sequences
from mien.datasets.dataset import Clip, FilmedSequence, Footage, TrackedSequence
from mien.datasets.nerface import viewmats_from_nerface
from mien.datasets.registry import datasets, find_dataset
from mien.errors import UserError
from mien.face import load_face_model
from mien.media.video import write_video
from mien.pipeline import import_dataset as import_footage
from mien.render.mesh import rasterize_mesh
from mien.rotation import matrix_from_axis_angle
from mien.training.settings.splits import OwnSplit
from refusals import refuses


@pytest.fixture
def scene(monkeypatch: pytest.MonkeyPatch) -> Scene:
    """Return the drawn person. The detector is left out, since it finds no face in drawings this small."""
    monkeypatch.setattr(sequences, "detected_landmarks", unfound)
    return drawn_person()


def check_pose(
    sequence: FilmedSequence, row: int, timestep: int, scene: Scene, person: np.ndarray, scale: float = 1.0
) -> None:
    """Check a picture's head-to-camera matrix, in a world of another scale. `person` [h, w] are the pixels of it."""
    rotation, translation = head_view(timestep)
    matrix = sequence.foreign["head_to_camera"][row].astype(np.float64)
    assert np.abs(matrix - writers.rigid(rotation, translation * scale)).max() < checks.CAMERA
    vertices = scene.vertices(timestep, root=False)
    placed = (vertices * scale) @ matrix[:3, :3].T + matrix[:3, 3]
    camera = checks.filmed_camera(sequence)
    checks.check_intrinsics(camera, writers.UNEQUAL)
    checks.check_view(camera, writers.MIRROR, np.zeros(3))
    view = (camera.K.double().numpy(), np.eye(3), np.zeros(3))
    wanted = projected(vertices, writers.UNEQUAL, rotation, translation)
    assert np.abs(projected(placed, *view) - wanted).max() < checks.PIXELS
    checks.check_edges(draw(scene, placed, *view)[1] > 127, person)


@pytest.mark.unchecked
def test_nerface(scene: Scene, tmp_path: Path) -> None:
    train, test = checks.read(writers.write_nerface(tmp_path / "person_1", scene), "nerface")
    assert isinstance(train, FilmedSequence)
    assert (train.capture.name, test.capture.name) == ("train", "test")
    assert train.foreign["expression"][:, 0].tolist() == [0, 1, 2, 3], "the order of time"
    for sequence, timesteps in ((train, range(4)), (test, [5])):
        for index, timestep in enumerate(timesteps):
            vertices = scene.vertices(timestep, root=False)
            image, _ = draw(scene, vertices, writers.UNEQUAL, *head_view(timestep))
            assert np.array_equal(sequence.capture.images[index, 0], image)
            person = sequence.capture.images[index, 0].min(-1) < 245  # before a white wall
            check_pose(sequence, index, timestep, scene, person, 0.6)
    assert (train.own_split, test.own_split) == (OwnSplit(), OwnSplit(((0, 1),)))
    # A world that is not mirrored is plain OpenGL.
    view = writers.rigid(*head_view(1))
    pose = np.linalg.inv(view) @ writers.rigid(writers.MIRROR, np.zeros(3))
    assert np.abs(viewmats_from_nerface(pose[None], 100.0)[0] - view).max() < 1e-12


def test_nerf_blendshape(scene: Scene, tmp_path: Path) -> None:
    folder = writers.write_nerf_blendshape(tmp_path / "id1", scene)
    (sequence,) = checks.read(folder, "nerf-blendshape")
    for timestep in range(len(scene)):
        vertices = scene.vertices(timestep, root=False)
        image, matte = draw(scene, vertices, writers.UNEQUAL, *head_view(timestep))
        assert np.array_equal(sequence.capture.mattes[timestep, 0], (matte > 127) * np.uint8(255))
        stored = Image.open(folder / f"ori_imgs/{7 + timestep + (timestep > 2)}.jpg")
        assert np.array_equal(sequence.capture.images[timestep, 0], np.asarray(stored))
        assert np.abs(sequence.capture.images[timestep, 0].astype(int) - image).mean() < 3, "a jpg"
        assert np.allclose(sequence.capture.landmarks[timestep, 0, 130], (2, timestep + 0.25))
        check_pose(sequence, timestep, timestep, scene, sequence.capture.mattes[timestep, 0] > 127)
    assert np.allclose(sequence.foreign["expression"][:, 45], np.arange(6) / 10)
    assert sequence.own_split is None


@pytest.mark.unchecked
def test_poses_and_coefficients_of_an_unpublished_head_become_a_tracking(scene: Scene, tmp_path: Path) -> None:
    """Their axes and unit are found by landmarks. The person differs from the mean head by some millimetres."""
    folder, model = tmp_path / "id1", load_face_model("coefficients-46")
    writers.write_nerf_blendshape(folder, scene, 7.0, True)
    (sequence,) = checks.read(folder, "nerf-blendshape", model)
    assert isinstance(sequence, TrackedSequence)
    face, camera = sequence.tracking.face, sequence.tracking.cameras[0]
    assert np.allclose(face.expression[:, 45], np.arange(6) / 10)
    assert 0.8 < float(-face.head_translation[:, 2].mean()) < 1.0, "metres"
    drawn = camera.project(model.landmark_positions(model(face), "mediapipe"))[0].numpy()
    mattes, mesh, above = sequence.capture.mattes, model(face), model.faces[~model.region_mask("neck")]
    for timestep in range(len(scene)):
        marks = scene.marks(scene.vertices(timestep, root=False, neck=False))
        expected = projected(marks, writers.UNEQUAL, *head_view(timestep))
        apart = np.linalg.norm(drawn[timestep] - expected, axis=1)
        assert np.median(apart) < 0.12 * np.linalg.norm(expected[33] - expected[263]), timestep
        covered = (rasterize_mesh(mesh[timestep], above, camera).face_index >= 0).numpy()
        inside = (covered & (mattes[timestep, 0] > 127)).sum() / covered.sum()
        assert inside > 0.85, "the mean head has another shape, but no other place"
    turned = matrix_from_axis_angle(face.head_rotation).double().numpy()
    for timestep in range(1, len(scene)):
        views = [writers.MIRROR @ head_view(each)[0] for each in (0, timestep)]
        assert np.abs(turned[timestep] @ turned[0].T - views[1] @ views[0].T).max() < 1e-4
    with pytest.raises(UserError, match="has 46 coefficients, and --face-model coefficients-76 has 76; give"):
        checks.read(folder, "nerf-blendshape", load_face_model("coefficients-76"))
    file = folder / "transforms.json"
    content = json.loads(file.read_text())
    for index, frame in enumerate(content["frames"]):
        frame["transform_matrix"][0][3] += (-1) ** index * 1.5  # no place of the head fits places that jump by 40 cm
    file.write_text(json.dumps(content))
    refuses("by its poses, landmarks are", checks.read, folder, "nerf-blendshape", model)


def test_benchmark_of_one_camera(scene: Scene, tmp_path: Path) -> None:
    folder = writers.write_benchmark(tmp_path / "393", scene)
    (sequence,) = checks.read(folder, "nersemble-benchmark", scene.model)
    assert isinstance(sequence, TrackedSequence)
    assert sequence.capture.name == "EXP-2-eyes"
    truth = np.load(folder / "truth.npz")
    view, place = (writers.UNEQUAL, *head_view(2, 1.0)), folder / "sequences/EXP-2-eyes"
    films = [checks.decoded(place / f"{part}/cam_{writers.FRONTAL}.mp4") for part in ("images", "alpha_maps")]
    assert np.array_equal(sequence.capture.images[:, 0], films[0])
    assert np.array_equal(sequence.capture.mattes[:, 0], films[1][..., 0])
    for timestep in range(len(scene)):
        vertices = writers.benchmark_vertices(scene, timestep, truth["angles"][timestep], truth["shifts"][timestep])
        checks.check_projection(sequence, timestep, vertices, view, scale=writers.BENCHMARK_SCALE)
        image, matte = draw(scene, vertices, *view)
        assert np.abs(films[0][timestep].astype(int) - image).mean() < 4
        assert np.abs(films[1][timestep, ..., 0].astype(int) - matte).max() < 4
    checks.check_silhouette(sequence)
    assert any("pictures of FREE, which are hidden" in each for each in checks.surveyed(folder).missing)
    # Euler angles of another order are refused.
    file = place / "tracking/flame2023_tracking_v2.npz"
    arrays = dict(np.load(file))
    file.write_bytes(writers.npz({**arrays, "rotation": arrays["rotation"][:, ::-1]}))
    refuses("'rotation' and 'rotation_matrices' differ", checks.read, folder, "nersemble-benchmark", scene.model)


def test_benchmark_of_novel_views(scene: Scene, tmp_path: Path) -> None:
    folder = writers.write_benchmark(tmp_path / "388", scene, ("222200042", "222200044"), tracked=False)
    (sequence,) = checks.read(folder, "nersemble-benchmark")
    assert sequence.capture.camera_ids == ("222200042", "222200044")
    for camera, serial in enumerate(sequence.capture.camera_ids):
        checks.check_intrinsics(checks.filmed_camera(sequence, camera), writers.UNEQUAL)
        checks.check_view(checks.filmed_camera(sequence, camera), *head_view(2 + camera, 1.0))
        place = folder / "sequences/EXP-2-eyes"
        assert np.array_equal(sequence.capture.images[:, camera], checks.decoded(place / f"images/cam_{serial}.mp4"))
        mattes = checks.decoded(place / f"alpha_maps/cam_{serial}.mp4")[..., 0]
        assert np.array_equal(sequence.capture.mattes[:, camera], mattes)


def test_nersemble_is_captured_with_its_cameras_and_clean_plates(tmp_path: Path, monkeypatch) -> None:
    folder = writers.write_nersemble(tmp_path / "017")
    (footage,) = checks.read(folder, "nersemble")
    assert isinstance(footage, Footage)
    assert footage.stride == 3
    names, asked = ("222200036", writers.FRONTAL), []

    def capture(videos: list[Path], calibration: Path, out: Path, name: str, settings: CaptureSettings) -> None:
        plates = sorted((settings.clean_plate or tmp_path).iterdir())
        asked.append(([video.name for video in videos], [plate.name for plate in plates]))
        for entry in read_calibration(calibration):
            assert (entry.camera.width, entry.camera.height, entry.camera.K[0, 2]) == (2200, 3208, 1100)
        if out.parent.name == "out2":
            raise UserError(f"--capture.clean-plate {plates[0]}: {videos[1]} and {calibration} differ")
        out.mkdir(parents=True)

    monkeypatch.setattr(import_footage, "capture_cameras", capture)
    import_footage.write_footage(tmp_path / "out", footage, find_dataset("nersemble"), folder)
    assert asked == [([f"{name}.mp4" for name in names], [f"{name}.jpg" for name in names])]
    assert (tmp_path / "out/dataset.json").is_file()
    with pytest.raises(UserError) as told:  # without the links' names, which vanish
        import_footage.write_footage(tmp_path / "out2", footage, find_dataset("nersemble"), folder)
    plate, video = folder / "sequences/BACKGROUND/image_222200036.jpg", footage.videos[1]
    assert str(told.value) == f"{plate}: {video} and {folder} (its cameras) differ"
    assert not (tmp_path / "out2").exists()
    # Every third frame is taken. A video that leads nowhere is refused when it is read, with its name.
    seven = np.zeros((7, 32, 32, 3), np.uint8)
    folder = writers.write_nersemble(tmp_path / "018", film=lambda path, _: write_video(path, iter(seven), 73.0))
    assert checks.surveyed(folder).clips == (Clip("EMO-1-shout+laugh", 3, 2),)
    video = folder / "sequences/EMO-1-shout+laugh/images/cam_222200036.mp4"
    video.unlink()
    video.symlink_to(video)
    assert checks.surveyed(folder).clips == (Clip("EMO-1-shout+laugh", 3, 2),)
    refuses(r"cam_222200036.mp4: is missing, or no file", checks.read, folder, "nersemble")


def test_a_benchmark_person_without_its_mattes_is_no_raw_recording(scene: Scene, tmp_path: Path) -> None:
    folder = writers.write_benchmark(tmp_path / "393", scene, ("222200036", writers.FRONTAL), False)
    found = checks.surveyed(folder)
    assert [(clip.frames, clip.cameras) for clip in found.clips] == [(len(scene), 2)]
    assert "the cameras 222200046, 222200039, which are hidden" in found.missing
    mattes = folder / "sequences/EXP-2-eyes/alpha_maps"
    shutil.rmtree(mattes)
    for target in (folder / "nothing", folder / "calibration/camera_params.json"):
        mattes.symlink_to(target)
        assert [each.name for each in datasets() if each.recognises(folder)] == ["nersemble-benchmark"]
        refuses("is missing, the mattes of cam_222200037.mp4", checks.read, folder, "nersemble-benchmark")
        mattes.unlink()
    for video in (folder / "sequences/EXP-2-eyes/images").iterdir():
        video.unlink()
        video.symlink_to(video)
    mattes.mkdir()
    refuses("images: none of its videos", checks.read, folder, "nersemble-benchmark")


def test_a_take_of_live_link_face(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = writers.write_take(tmp_path / "20240131_Me_3")
    (folder / "Me_3_iPhone_raw.csv").write_text("Timecode,BlendshapeCount,")
    (folder / "Me_3_iPhone.csv").write_bytes((folder / "Me_3_iPhone_cal.csv").read_bytes() + b"\n")
    (footage,) = checks.read(folder, "live-link-face")
    assert (footage.name, footage.videos[0].name) == ("20240131_Me_3", "Me_3_iPhone.mov")
    assert footage.files["driving.csv"] == (folder / "Me_3_iPhone_cal.csv").read_bytes()
    monkeypatch.setattr(import_footage, "capture_video", lambda video, out, settings, name: out.mkdir(parents=True))
    import_footage.write_footage(tmp_path / "out", footage, find_dataset("live-link-face"), folder)
    assert (tmp_path / "out/driving.csv").is_file()
    (folder / "Me_3_iPhone_cal.csv").write_text("Timecode,BlendshapeCount,EyeBlinkLeft\nnothing\n")
    pytest.raises(UserError, checks.read, folder, "live-link-face")


def test_insta_without_checkpoints_is_pictures(scene: Scene, tmp_path: Path) -> None:
    folder = writers.write_insta(tmp_path / "me", scene, checkpoints=False)
    (sequence,) = checks.read(folder, "insta")
    assert isinstance(sequence, FilmedSequence)
    view = np.linalg.inv(sequence.foreign["camera_to_head"][1])
    assert np.abs(view[:3, :3] - head_view(1)[0]).max() < 1e-6
    shutil.rmtree(folder / "images")
    refuses(r"images/00000.png: is missing", checks.read, folder, "insta")
