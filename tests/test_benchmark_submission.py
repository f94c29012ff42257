"""A run becomes the videos that the NeRSemble benchmark asks for, in its folders, seen by its cameras."""

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dataset_checks import decoded
from dataset_scene import NoDetector, Scene, drawn_person
from dataset_writers import BENCHMARK_SCALE, write_benchmark
from mien.avatar import DEFAULT_METHOD, FaceTuning
from mien.capture.video import probe_video
from mien.cli import main
from mien.datasets import overlay
from mien.face import add_face_model, load_face_model
from mien.training import read_sequence, train
from plain_settings import plain_config, plain_run
from shared_things import MadeOnce, toy_workspace

pytestmark = pytest.mark.unchecked
TESTED = ("222200037", "222200046", "220700191", "222200039")
"""Cameras of the monocular task, frontal one first."""


scene = pytest.fixture(scope="module")(lambda: drawn_person(3))


@pytest.fixture(scope="module")
def person(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a person whose test sequence FREE has a tracking only. EXP-2-eyes shows the same motion."""
    return write_benchmark(tmp_path_factory.mktemp("mono_flame_avatar") / "393", scene, TESTED)


@pytest.fixture(scope="module")
def workspace(scene: Scene, person: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    patch = pytest.MonkeyPatch()
    patch.setattr(overlay, "LandmarkDetector", NoDetector)
    patch.setenv("MIEN_CACHE", str(tmp_path_factory.mktemp("cache")))
    add_face_model(replace(scene.model, name="flame"), Path("flame.npz"), "0")
    root = tmp_path_factory.mktemp("workspaces") / "393"
    assert main(["import", str(person), "--out", str(root), "--face-model", "flame"]) == 0
    sequence = read_sequence(root / "sequences" / "EXP-2-eyes")
    config = plain_config(DEFAULT_METHOD, face_tuning=FaceTuning(enabled=False))
    settings = plain_run(steps=2, record_every=1, checkpoint_every=2, split="none")
    train([sequence], load_face_model("flame"), config, settings, root / "runs" / "a")
    yield root
    patch.undo()


def film_of(video: Path, truth: Path, rate: float) -> tuple[np.ndarray, np.ndarray]:
    assert probe_video(video).fps == pytest.approx(rate)
    return decoded(video), decoded(truth)


def inside(pictures: np.ndarray, mattes: np.ndarray, shift: int = 0) -> list[float]:
    """Return the share of each avatar's dark pixels that lie on the matte, moved sideways by some pixels.
    An avatar of two steps is a fog, and ends at the neck, so that its silhouette is not that of the matte."""
    dark, solid = pictures.min(-1) < 205, np.roll(mattes[..., 0] > 127, shift, axis=2)
    assert dark.sum((1, 2)).min() > 300
    return [float((a & b).sum() / a.sum()) for a, b in zip(dark, solid, strict=True)]


def export(workspace: Path, benchmark: Path, out: Path) -> int:
    line = ["export", str(workspace), "--format", "nersemble-benchmark", "--benchmark", str(benchmark)]
    return main([*line, "--out", str(out)])


def test_test_sequences_are_rendered_from_their_four_cameras(person: Path, workspace: Path, tmp_path: Path, capsys):
    """The avatar lies on the mattes that the writer drew of the same motion, in all cameras."""
    out = tmp_path / "submission"
    assert export(workspace, person, out) == 0
    files = sorted(path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file())
    assert files == sorted(f"393/FREE/cam_{serial}.mp4" for serial in TESTED)
    for serial in TESTED:
        mattes = person / f"sequences/EXP-2-eyes/alpha_maps/cam_{serial}.mp4"
        pictures, truth = film_of(out / f"393/FREE/cam_{serial}.mp4", mattes, 24.3)
        assert pictures.shape == truth.shape
        assert pictures[:, :4, :4].min() > 250, "white around the head"
        assert min(inside(pictures, truth)) > 0.95
        assert max(inside(pictures, truth, 5) + inside(pictures, truth, -5)) < 0.88, "five pixels are noticed"
    told = capsys.readouterr().err
    for words in ("393: 1 sequence from 4 cameras, 3 timesteps", "pictures are 128x128, not 512x512",
                  "no tracking of EMO-1-shout+laugh, SEN-09",
                  "a submission needs 404, 461, 477, 486 as well"):  # fmt: skip
        assert words in told
    assert export(workspace, person, out) == 2
    assert "393: is there already; delete it" in capsys.readouterr().err


def test_novel_views_are_rendered_from_the_hidden_cameras(person: Path, workspace: Path, tmp_path: Path, capsys):
    """Without test sequences, the trained sequence is seen by the hidden cameras, in the world of the tracking."""
    other, out = tmp_path / "475", tmp_path / "submission"
    shutil.copytree(person, other)
    shutil.rmtree(other / "sequences" / "FREE")
    # The import of one camera shrinks the world to the size of FLAME, and that of several does not.
    calibration = other / "calibration" / "camera_params.json"
    content = json.loads(calibration.read_text())
    for pose in content["world_2_cam"].values():
        for row in pose[:3]:
            row[3] /= BENCHMARK_SCALE
    calibration.write_text(json.dumps(content))
    assert export(workspace, other, out) == 0
    serials = ("222200037", "222200039", "222200046")
    assert sorted(path.name for path in out.rglob("*.mp4")) == [f"cam_{serial}.mp4" for serial in serials]
    for serial in serials:
        mattes = person / f"sequences/EXP-2-eyes/alpha_maps/cam_{serial}.mp4"
        assert min(inside(*film_of(out / f"475/EXP-2-eyes/cam_{serial}.mp4", mattes, 73))) > 0.95
    assert "a submission needs 388, 422, 443, 445 as well" in capsys.readouterr().err


def test_mistakes_are_told_in_one_line(made_once: MadeOnce, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root, person, named = str(toy_workspace(made_once)), tmp_path / "393", tmp_path / "somebody"
    for folder in (person, named):
        (folder / "calibration").mkdir(parents=True)
        (folder / "calibration" / "camera_params.json").write_text("{}")
    line = ["export", root, "--format", "nersemble-benchmark", "--out", str(tmp_path / "out")]
    for more, words in (
        ([], "needs the person's folder of the benchmark"),
        (["--benchmark", str(tmp_path)], "has no calibration/camera_params.json"),
        (["--benchmark", str(named)], "its name is not the number of a person"),
        (["--benchmark", str(person), "--sh", "3"], "--sh: is not for --format nersemble-benchmark"),
        (["--benchmark", str(person)], "has no 'world_2_cam'"),
    ):
        capsys.readouterr()
        assert main([*line, *more]) == 2
        (told,) = (one for one in capsys.readouterr().err.splitlines() if one.startswith("mien: "))
        assert words in told
    assert not list(tmp_path.glob("out/*"))
    assert main(["export", root, "--benchmark", str(person), "--out", str(tmp_path / "a.ply")]) == 2
    assert "--benchmark" in capsys.readouterr().err
