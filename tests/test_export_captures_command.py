"""`mien export` of captures: what is left out, told and refused, and how pictures of other programs are scored."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dataset_scene import Scene, make_scene
from exported_captures import (
    CAMERAS,
    HELD_OUT,
    TIMESTEPS,
    check_face,
    check_frames,
    export,
    filmed,
    on_head,
    read,
    with_one_camera,
    with_two_cameras,
)
from mien.cli import main
from mien.datasets.layouts import filmed_frames
from mien.datasets.pictures import read_picture
from mien.errors import UserError
from mien.evaluation.image_folders import ImageFolders, score_folders
from mien.training import Sequence, TrainSettings


@pytest.fixture(scope="module")
def scene(anny, tmp_path_factory) -> Scene:
    return make_scene(anny, tmp_path_factory.mktemp("flame"), TIMESTEPS)


@pytest.fixture(scope="module")
def both(scene: Scene) -> Sequence:
    return with_two_cameras(scene)


@pytest.fixture(scope="module")
def single(both: Sequence) -> Sequence:
    return with_one_camera(both)


def test_pictures_of_others_are_scored_against_the_truth(single: Sequence, scene: Scene, tmp_path: Path) -> None:
    """A program that gives back the held-out pictures over white, by name, has a perfect score."""
    names = {"insta": ["00008", "00009"], "imavatar": ["1", "2"], "nerface": ["f_0000", "f_0001"],
             "nersemble": [f"clip-test_cam_{CAMERAS[0]}_0000{n}" for n in range(2)]}  # fmt: skip
    content = filmed(single, scene)
    for name, expected in names.items():
        folder = export(tmp_path / name, name, content)
        found = sorted((folder / "scoring/truth").glob("*.png"))
        assert [file.stem for file in found] == expected
        for file, timestep in zip(found, HELD_OUT, strict=True):
            picture, _ = read_picture(file)
            inside, outside = (single.scoring[timestep, 0] == level for level in (255, 0))
            assert np.array_equal(picture[inside], single.capture.images[timestep, 0][inside])
            assert (picture[outside] == 255).all()
        assert "mien evaluate --images PICTURES --truth scoring/truth" in (folder / "README.txt").read_text()
    scores = score_folders(ImageFolders(tmp_path / "insta/scoring/truth", tmp_path / "insta/scoring/truth"))
    assert scores["l1"] == 0


def test_frames_that_mien_does_not_train_on_are_left_out(single: Sequence, scene: Scene, tmp_path: Path) -> None:
    valid = single.capture.valid.copy()
    tracked = single.tracking.valid.clone()
    valid[3], tracked[3] = False, False
    gone = replace(
        single, capture=replace(single.capture, valid=valid), tracking=replace(single.tracking, valid=tracked)
    )
    folder = export(tmp_path / "out", "insta", filmed(gone, scene))
    (sequence,) = read(folder, "insta", scene)
    kept = tuple(t for t in range(TIMESTEPS) if t != 3)
    check_frames(sequence, single, kept)
    check_face(sequence, scene, kept, on_head(scene))
    assert sequence.own_split.timesteps == ((7, 9),), "numbers have no gaps"
    assert "Left out: 1 frame " in (folder / "README.txt").read_text()
    assert sorted(each.name for each in tmp_path.iterdir()) == ["out"], "nothing else is left"


def test_what_a_layout_cannot_hold_is_told_or_refused(both: Sequence, single: Sequence, scene: Scene, anny,
                                                      tmp_path: Path) -> None:  # fmt: skip
    for name in ("insta", "imavatar", "nerface"):
        with pytest.raises(UserError, match=f"clip: has 2 cameras, and the layout {name} holds one"):
            export(tmp_path / name, name, filmed(both, scene))
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "a").touch()
    with pytest.raises(UserError, match="full: is not empty"):
        export(tmp_path / "full", "nersemble", filmed(both, scene))
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
        assert not list(folder.rglob("*.frame"))
        assert not list(folder.rglob("*.npz"))


@pytest.fixture
def workspace(single: Sequence, scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A workspace with the sequence, whose face model is known by name."""
    from mien.capture import read_capture_hash, write_capture
    from mien.commands.stages import training
    from mien.tracking import Scoring, write_scoring, write_tracking

    folder = tmp_path / "W" / "sequences" / "clip"
    write_capture(folder / "capture", single.capture)
    write_tracking(folder / "tracking", single.tracking)
    crops = np.tile(np.array([4, 4, 20, 20], np.int64), (TIMESTEPS, 1, 1))
    write_scoring(folder / "scoring", Scoring(single.scoring, crops), read_capture_hash(folder / "capture"))
    monkeypatch.setattr(training, "load_face_model", lambda _: scene.model)
    return tmp_path / "W"


def test_the_command(workspace: Path, scene: Scene, capsys: pytest.CaptureFixture[str]) -> None:
    def refused(message: str, *options: str) -> None:
        assert main(["export", str(workspace), "--out", str(workspace.parent / "out"), *options]) == 2
        told = capsys.readouterr().err.strip()
        assert message in told
        assert len(told.splitlines()) == 1

    refused("--set: is for avatars, and --format insta writes a capture", "--format", "insta", "--set", "smile=1")
    refused("--split tail: is for captures", "--format", "ply", "--split", "tail", "--out", "a.ply")
    refused("or insta, imavatar, nerface or nersemble for a capture", "--format", "inst")
    refused("there is no run yet", "--format", "insta", "--run", "me")
    refused("no sequence 'other'", "--format", "insta", "--sequence", "other")
    refused("--split dataset: the sequence clip has no split", "--format", "insta", "--split", "dataset")
    out = workspace.parent / "out"
    assert main(["export", str(workspace), "--out", str(out), "--format", "insta", "--split", "tail"]) == 0
    assert f"{out}: 10 training frames, 2 held out; see README.txt" in capsys.readouterr().err
    (sequence,) = read(out, "insta", scene)
    assert sequence.own_split.timesteps == ((10, 12),)
    capsys.readouterr()
    refused("out: is not empty, and a capture is written into a new folder", "--format", "insta")
    (workspace / "sequences/clip/tracking/tracking.json").unlink()
    refused("the sequence clip is not tracked", "--format", "nerface")


def test_a_run_decides_what_is_held_out(tmp_path: Path) -> None:
    from mien.commands.stages.exporting_capture import settings_of
    from mien.workspace import Workspace
    from toy_workspace import write_toy_workspace

    write_toy_workspace(tmp_path)  # the last fifth
    workspace = Workspace(tmp_path)
    assert settings_of(workspace, "clip", "toy", None).split == "tail"
    assert settings_of(workspace, "clip", None, None).split == "blocks"
    with pytest.raises(UserError, match="--run toy: was trained on clip, not on other"):
        settings_of(workspace, "other", "toy", None)
