"""Datasets that are tracked on FLAME: what independent writers wrote is imported, and lies on its pictures."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from dataset_checks import check_pictures, check_projection, check_silhouette, check_view
from dataset_scene import SIDE, Scene, draw, head_view, make_scene, projected
from dataset_writers import (
    IMAVATAR_PLACE,
    OFF_CENTRE,
    UNEQUAL,
    imavatar_classes,
    seen_by_tracker,
    write_flash_avatar,
    write_imavatar,
    write_insta,
    write_vhap,
)
from mien.commands.stages import importing
from mien.datasets import Dataset, Findings, TrackedSequence, find_dataset, recognised
from mien.datasets.pictures import read_picture
from mien.errors import UserError
from mien.training.footage import clothes_mask
from mien.workspace import Workspace

MIRROR = np.diag([1.0, -1.0, -1.0])


@pytest.fixture(scope="module")
def scene(anny, tmp_path_factory) -> Scene:
    return make_scene(anny, tmp_path_factory.mktemp("flame"))


def read(path: Path, scene: Scene, name: str) -> list[TrackedSequence]:
    dataset, _ = recognised(path)
    assert dataset.name == name
    found = list(dataset.read(path, scene.model))  # type: ignore[arg-type]
    assert all(isinstance(each, TrackedSequence) for each in found)
    return found  # type: ignore[return-value]


def surveyed(path: Path) -> Findings:
    dataset: Dataset = recognised(path)[0]
    assert dataset.survey is not None
    return dataset.survey(path)


def check_landmarks(sequence: TrackedSequence, vertices: Callable[[int], np.ndarray], view: tuple) -> None:
    """Check the imported landmarks against triangles of the writer's vertices."""
    marks, faces = sequence.face_model.landmarks["mediapipe"], sequence.face_model.faces
    for timestep in range(sequence.capture.timesteps):
        points = torch.from_numpy(vertices(timestep))[faces[marks.faces]]
        expected = projected((points * marks.barycentric.double()[..., None]).sum(1).numpy(), *view)
        assert np.abs(sequence.capture.landmarks[timestep, 0] - expected).max() < 0.005


def test_insta(scene: Scene, tmp_path: Path) -> None:
    folder = write_insta(tmp_path / "me", scene)
    (sequence,) = read(folder, scene, "insta")
    assert sequence.capture.name == "me"
    for timestep in range(len(scene)):
        vertices = scene.vertices(timestep, root=False, neck=False)
        check_projection(sequence, timestep, vertices, (OFF_CENTRE, *head_view(timestep)))
        check_pictures(sequence, timestep, seen_by_tracker(scene, timestep, OFF_CENTRE))
    check_silhouette(sequence)
    findings = surveyed(folder)
    assert findings.clips[0].frames == 6
    assert findings.face_model == "FLAME 2020"


def test_flash_avatar_counts_pictures_from_one(scene: Scene, tmp_path: Path) -> None:
    (sequence,) = read(write_flash_avatar(tmp_path / "root", scene), scene, "insta")
    for timestep in range(len(scene)):
        vertices = scene.vertices(timestep, root=False, neck=False)
        check_projection(sequence, timestep, vertices, (OFF_CENTRE, *head_view(timestep)))
        check_pictures(sequence, timestep, seen_by_tracker(scene, timestep, OFF_CENTRE))
    check_silhouette(sequence)


def test_imavatar(scene: Scene, tmp_path: Path) -> None:
    folder = write_imavatar(tmp_path / "subject1", scene)
    train, test = read(folder, scene, "imavatar")
    assert (train.capture.name, test.capture.name) == ("MVI_1810", "MVI_1812")
    view = (UNEQUAL, MIRROR, MIRROR @ IMAVATAR_PLACE / 4)
    for first, sequence in ((0, train), (3, test)):
        for timestep in range(3):
            vertices = scene.vertices(first + timestep) - scene.translation[first + timestep]
            check_projection(sequence, timestep, vertices, view)
            check_pictures(sequence, timestep, draw(scene, vertices, *view))
        check_silhouette(sequence)
        check_landmarks(sequence, lambda t, first=first: scene.vertices(first + t) - scene.translation[first + t], view)
    assert train.own_split is not None
    assert test.own_split is not None
    assert not train.own_split.whole(3)
    assert test.own_split.whole(3)
    assert surveyed(folder).split == "the clip MVI_1812 is held out"
    for timestep in range(3):
        packed = np.asarray(test.foreign["clothes"])
        expected = np.isin(imavatar_classes(test.capture.mattes[timestep, 0]), (15, 16))
        assert expected.any()
        assert np.array_equal(clothes_mask(packed, timestep, expected.shape[1]), expected)
    shutil.rmtree(folder / "subject1/MVI_1810/semantic")
    assert surveyed(folder).missing == ("semantic of MVI_1810: figures without clothes need it",)
    assert not read(folder, scene, "imavatar")[0].foreign


@pytest.mark.parametrize("from_below", [False, True])
def test_vhap(scene: Scene, tmp_path: Path, from_below: bool) -> None:
    folder = write_vhap(tmp_path / "306_EMO-1", scene, from_below)
    (sequence,) = read(folder, scene, "vhap")
    assert sequence.capture.camera_ids == ("222200036", "222200037")
    for timestep in range(len(scene)):
        for camera in range(2):
            view = (UNEQUAL, *head_view(2 + camera, 1.0))
            check_projection(sequence, timestep, scene.vertices(timestep), view, camera)
            check_view(sequence.tracking.cameras[camera], *view[1:])
            drawn = draw(scene, scene.vertices(timestep), *view, (SIDE, 136))
            check_pictures(sequence, timestep, drawn, camera)
    check_silhouette(sequence)
    assert sequence.own_split is not None
    assert sequence.own_split.timesteps == ((5, 6),)
    assert sequence.own_split.cameras == ("222200037",)


def test_vhap_of_one_camera_has_the_camera_of_mien(scene: Scene, tmp_path: Path) -> None:
    folder = write_vhap(tmp_path / "me", scene, cameras=("0",))
    (sequence,) = read(folder, scene, "vhap")
    assert sequence.capture.calibration is not None
    assert torch.equal(sequence.capture.calibration[0].viewmat, torch.diag(torch.tensor([1.0, -1, -1, 1])))
    for timestep in range(len(scene)):
        view = (UNEQUAL, *head_view(2, 1.0))
        check_projection(sequence, timestep, scene.vertices(timestep), view)
        check_pictures(sequence, timestep, draw(scene, scene.vertices(timestep), *view, (SIDE, 136)))
    check_silhouette(sequence)


def test_without_flame_the_remedy_is_told(scene: Scene, tmp_path: Path, anny) -> None:
    folder = write_insta(tmp_path / "me", scene)
    for model in (None, anny):
        with pytest.raises(UserError, match=r"its tracking needs FLAME 2020 \(generic_model.pkl\)"):
            list(find_dataset("insta").read(folder, model))  # type: ignore[arg-type]


def test_a_tracking_that_does_not_fit_its_pictures_is_refused(scene: Scene, tmp_path: Path) -> None:
    """The mesh of other conventions lies beside the person."""
    from dataset_writers import tracker_frame, write_frame

    folder = write_insta(tmp_path / "me", scene)
    for number in range(7):
        frame = tracker_frame(scene, min(number, 5), OFF_CENTRE)
        frame["opencv"]["t"] += np.array([0.15, 0, 0], np.float32)
        write_frame(folder / f"checkpoint/{number:05d}.frame", frame)
    with pytest.raises(UserError, match="of the tracked head lies on the person in me"):
        list(find_dataset("insta").read(folder, scene.model))  # type: ignore[arg-type]


@pytest.mark.parametrize("layout", ["insta", "vhap"])
def test_the_imported_mesh_is_drawn_over_some_pictures(
    layout: str, scene: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The drawn mesh covers the person, and nothing else. The last line names the picture."""
    folder = write_insta(tmp_path / "me", scene) if layout == "insta" else write_vhap(tmp_path / "me", scene)
    found = read(folder, scene, layout)
    importing._write_sequences(found, Workspace(tmp_path / "W"), find_dataset(layout), folder, False)
    first = tmp_path / "W/sequences" / found[0].capture.name / "tracking/overlay.png"
    assert f"the imported mesh over some pictures: {first}" in capsys.readouterr().err.splitlines()[-1]
    for sequence in found:
        place = tmp_path / "W/sequences" / sequence.capture.name / "tracking/overlay.png"
        pixels = read_picture(place)[0].astype(int)
        count = min(6, max(sequence.capture.timesteps, len(sequence.tracking.cameras)))
        assert pixels.shape == (480, 240 * count, 3)
        above, below = pixels[20:240], pixels[260:]  # without the line that names the frame
        person, drawn = (above < 250).any(-1), np.abs(above - below).max(-1) > 3
        assert (person & drawn).sum() > 0.95 * (person | drawn).sum()
        assert 0.2 < person.mean() < 0.9
        seen = [pixels[:240, at : at + 240] for at in range(0, 240 * count, 240)]
        assert all(np.abs(one - other).max() > 50 for one, other in zip(seen, seen[1:], strict=False))
