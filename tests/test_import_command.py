"""An exported GaussianAvatars folder is imported, posed at any frame, rendered, and exported again."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from mien.avatar import load_avatar
from mien.cli import main
from mien.runtime import load as load_portable
from mien.training import read_face_track
from toy_workspace import write_toy_workspace


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the toy workspace W, its exported folder F, and the workspace I that F was imported into."""
    place = tmp_path_factory.mktemp("made")
    write_toy_workspace(place / "W")
    export = ["export", str(place / "W"), "--out", str(place / "F"), "--format", "gaussian-avatars"]
    assert main(export) == 0
    assert main(["import", str(place / "F"), "--out", str(place / "I")]) == 0
    return place


def refused(line: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    assert main(line) == 2
    told = capsys.readouterr().err
    assert message in told
    assert told.count("\n") == 1


def picture(path: Path) -> np.ndarray:
    pixels = cv2.imread(str(path))
    assert pixels is not None
    return pixels


def test_frames_are_those_of_training(made: Path) -> None:
    trained, imported = made / "W/runs/toy", made / "I/runs/gaussian_avatars"
    avatars = load_avatar(trained), load_avatar(imported)
    before, after = (
        read_face_track(run, avatar.face_model) for run, avatar in zip((trained, imported), avatars, strict=True)
    )
    assert len(before) == len(after) == 5
    means = [avatar.pose(face).gaussians.means.detach() for avatar, face in zip(avatars, (before, after), strict=True)]
    assert float((means[0] - means[1]).abs().max()) < 1e-6


def test_any_frame_is_rendered(made: Path, tmp_path: Path) -> None:
    pictures = []
    for timestep in ("0", "2"):
        out = tmp_path / f"{timestep}.png"
        assert main(["render", str(made / "I"), "--out", str(out), "--timestep", timestep, "--size", "64"]) == 0
        pictures.append(picture(out))
    assert pictures[0].std() > 5
    assert np.abs(pictures[0].astype(int) - pictures[1]).max() > 20
    film = [str(made / "I"), "--out", str(tmp_path / "film"), "--own-motion", "--path", "still", "--size", "64"]
    assert main(["render", *film]) == 0
    frames = sorted((tmp_path / "film").iterdir())
    assert len(frames) == 5
    assert np.array_equal(picture(frames[2]), pictures[1])


def test_it_is_exported_again(made: Path, tmp_path: Path) -> None:
    assert main(["export", str(made / "I"), "--out", str(tmp_path / "a.mien")]) == 0
    assert len(load_portable(tmp_path / "a.mien").portable.baked.attributes.quats) > 100
    assert main(["export", str(made / "I"), "--out", str(tmp_path / "F"), "--format", "gaussian-avatars"]) == 0
    for name in ("point_cloud.ply", "face_model.safetensors"):
        assert (tmp_path / "F" / name).read_bytes() == (made / "F" / name).read_bytes()


def test_mistakes_are_told(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, out = str(made / "F"), str(tmp_path / "N")
    refused(
        ["import", str(tmp_path / "gone"), "--out", out],
        "no such file or folder; give one of gaussian-avatars (",
        capsys,
    )
    refused(["import", str(made / "W"), "--out", out], "is no dataset that mien knows; give one of", capsys)
    named = ["--dataset", "gaussian-avatars"]
    refused(["import", str(made / "W"), "--out", out, *named], "has no point_cloud.ply", capsys)
    refused(["import", folder, "--out", out, "--dataset", "nobody"], "there is no such dataset; choose one of", capsys)
    refused(["import", folder, "--out", str(made / "I")], "is there already; give the imported run", capsys)
    refused(["import", folder, "--out", out, "--run", "a/b"], "cannot be the name", capsys)
    refused(["import", folder, "--out", out, "--face-model", "gone"], "no face model 'gone'", capsys)
    refused(["render", str(made / "I"), "--out", f"{out}.png", "--timestep", "5"], "has the timesteps 0 to 4", capsys)
    both = ["--own-motion", "--timestep", "1"]
    refused(["render", str(made / "I"), "--out", f"{out}.png", *both], "give only one of them", capsys)
    as_folder = ["--format", "gaussian-avatars"]
    refused(["export", str(made / "I"), "--out", f"{out}.ply", *as_folder], "writes a folder", capsys)
    refused(["export", str(made / "I"), "--out", out, *as_folder, "--every", "2"], "holds every timestep", capsys)
    refused(["export", str(made / "I"), "--out", f"{out}.mien", "--format", "ply"], "does not end in .ply", capsys)
    refused(["export", str(made / "I"), "--out", f"{out}.ply", "--format", "usd"], "in .usd or .usda or .usdc", capsys)
    assert not list(tmp_path.iterdir())


def test_a_damaged_folder_leaves_nothing(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(made / "F", tmp_path / "F")
    path = tmp_path / "F" / "point_cloud.ply"
    path.write_bytes(path.read_bytes()[:-4] + np.int32(-7).tobytes())
    refused(["import", str(tmp_path / "F"), "--out", str(tmp_path / "I")], "binding_0 of Gaussian", capsys)
    assert not (tmp_path / "I" / "runs").exists()


def test_an_imported_run_is_not_scored_or_continued(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for command in ("evaluate", "train"):
        capsys.readouterr()
        assert main([command, str(made / "I")]) == 2
        assert capsys.readouterr().err.count("\n") == 1
