"""Avatars are trained on imports of each layout, and runs become the videos that a benchmark asks for."""

import csv
import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import dataset_writers as writers
from dataset_cases import make_quick, tiny_scene
from dataset_checks import decoded
from dataset_scene import NoDetector, Scene, drawn_person, scene_of
from dataset_writers import BENCHMARK_SCALE, write_benchmark
from mien.avatar.methods import DEFAULT_METHOD
from mien.avatar.settings import FaceTuning
from mien.batch.plan import Batch
from mien.batch.row import do_steps, run_row
from mien.cli import main
from mien.commands.batch_table import read_table
from mien.datasets import overlay, pictures, sequences
from mien.face import load_face_model
from mien.face.cache import cache_folder
from mien.face.loading import add_face_model
from mien.media.video import probe_video
from mien.training import read_sequence, train
from plain_settings import plain_config, plain_run
from refusals import complaint
from shared_things import MadeOnce, rows_here, toy_workspace

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
    line = ["export-dataset", str(workspace), "--format", "nersemble-benchmark", "--benchmark", str(benchmark)]
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
    line = ["export-dataset", root, "--format", "nersemble-benchmark", "--out", str(tmp_path / "out")]
    kinds = "insta, imavatar, nerface, nerf-blendshape, avatar-mav"
    for more, words in (
        ([], "--benchmark"),
        (["--benchmark", str(tmp_path)], "has no calibration/camera_params.json"),
        (["--benchmark", str(named)], "its name is not the number of a person"),
        (["--split", "none"], f"--split is an option of --format {kinds} or nersemble; leave it out"),
        (["--benchmark", str(person)], "has no 'world_2_cam'"),
    ):
        assert words in complaint(capsys, *line, *more)
    assert not list(tmp_path.glob("out/*"))


TASK = ("EXP-2-eyes", "SEN-10-port_strong_smokey")
LAYOUTS: dict[str, tuple[Callable[[Path, Scene], Path], str, int]] = {
    "vhap": (writers.write_vhap, "gaussian_avatars", 7),
    "insta": (partial(writers.write_insta, held_out=2), "headgas", 2),
    "imavatar": (writers.write_imavatar, "headgas", 3),
    "nersemble-benchmark": (partial(writers.write_benchmark, clips=TASK), "headgas", 3),
    "nerf-blendshape": (partial(writers.write_nerf_blendshape, scale=7.0, detected=True), "headgas", 1),
    "nerface": (partial(writers.write_nerface, detected=True), "headgas", 1),
}
"""Writer and method of each layout that has a tracking, and how many pictures its split holds out.

VHAP holds out one timestep seen by two cameras, and five seen by one. The last two have coefficients without a basis,
which suffice for HeadGaS. NeRFBlendShape's own split needs more than 500 frames."""
SMALL = {"gaussian_avatars": ("--steps", "30"), "headgas": ("--steps", "40", "--method.points", "400")}
PLAIN = ("--training.unseen", "trained", "--training.inside", "free", "--training.mesh", "tracked")
"""Options that leave out what closes the sides that no camera filmed."""


def not_white(images: np.ndarray, mattes: np.ndarray, plate: np.ndarray | None = None) -> None:
    mattes[:] = 255 * (images < 250).any(-1)


PAPER = """
layouts.nersemble-benchmark = {{ split = "nersemble-benchmark" }}
layouts.nerf-blendshape = {{ split = "tail", protocol = "", face-model = "coefficients-46" }}
layouts.nerface = {{ face-model = "coefficients-76" }}
options = {{ preset = "draft", "training.resolution" = 96 }}
columns = {{ "PSNR" = "self_reenactment.psnr" }}
rows = [{{ name = "Ours", method = "{method}", paper = ["31.4"] }}]
"""


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.usefixtures("short_films")
def test_a_layout_becomes_a_table_by_its_split_and_protocol(layout: str, tmp_path, monkeypatch) -> None:
    scene = drawn_person()
    monkeypatch.setattr(overlay, "LandmarkDetector", NoDetector)  # it finds no face in drawings this small
    shutil.copytree(cache_folder() / "face_models", tmp_path / "cache" / "face_models")
    monkeypatch.setenv("MIEN_CACHE", str(tmp_path / "cache"))
    add_face_model(replace(scene.model, name="flame"), Path("flame.npz"), "0")
    write, method, held_out = LAYOUTS[layout]
    write(tmp_path / "people/me", scene)
    paper, out = tmp_path / "paper.toml", tmp_path / "out"
    paper.write_text(PAPER.format(method=method))
    # NeRFace has no landmarks and no mattes, and the networks know no drawings this small.
    monkeypatch.setattr(sequences, "detected_landmarks", lambda images: writers.nerface_landmarks(scene, images))
    monkeypatch.setattr(pictures, "fill_mattes", not_white)
    rows_here(monkeypatch)
    line = ["batch", str(tmp_path / "people"), "--paper", str(paper), "--out", str(out), *SMALL[method], *PLAIN]
    assert main([*line, *(() if "nerf" in layout else ("--face-model", "flame"))]) == 0
    (file,) = out.glob("rows/me/runs/*/metrics.json")
    found = json.loads(file.read_text())["protocols"]
    assert sum(each["frames"] for each in found.values()) == held_out
    for name, each in found.items():
        assert each.get("dataset_protocol", layout) == layout
        assert each["psnr"] > each["baselines"]["mean_frame"]["psnr"] + 1, name
    psnr = next(each["psnr"] for name, each in found.items() if name.startswith("self_reenactment"))
    assert (
        f"| Ours | {psnr:.2f} | 31.4 | run short: {SMALL[method][1]} of 4,000 steps; with "
        in (out / "table.md").read_text()
    )


@pytest.mark.usefixtures("short_films")
def test_people_are_imported_trained_and_scored_by_one_table(tmp_path, monkeypatch, capsys) -> None:
    """A row is a person. The row of a damaged one fails alone, and goes on where it stopped after it is mended."""
    make_quick(monkeypatch)
    monkeypatch.setenv("MIEN_CACHE", str(tmp_path / "cache"))
    scene = tiny_scene(tmp_path)
    add_face_model(scene.model, Path("tiny.npz"), "0")
    people = ("subject0", "subject1")
    for number, name in enumerate(people):
        writers.write_imavatar(tmp_path / name, scene_of(scene.arrays, scene.model, len(scene), number))
    table = tmp_path / "people.csv"
    heading = "dataset,face_model,method,split,protocol,preset,steps,method.points\n"
    table.write_text(heading + "".join(f"{name},tiny,headgas,dataset,imavatar,draft,4,60\n" for name in people))
    damaged = tmp_path / "subject1/subject1/MVI_1812/flame_params.json"
    whole = damaged.read_text()
    damaged.write_text(whole.replace("world_mat", "world_mad", 1))
    batch, rows = Batch(tmp_path / "out"), read_table(table)
    batch.write_plan(rows)
    states = [run_row(batch, row, partial(do_steps, _quietly)) for row in rows]
    assert [state.status for state in states if state is not None] == ["done", "failed"]
    assert (batch.workspace("subject1") / "sequences/MVI_1810").is_dir(), "what was read stays"
    damaged.write_text(whole)
    mended = run_row(batch, rows[1], partial(do_steps, _quietly))
    assert mended is not None
    assert mended.status == "done"
    capsys.readouterr()
    assert main(["batch", str(table), "--out", str(batch.root)]) == 0
    assert "2 rows: 2 done before" in capsys.readouterr().err
    with (batch.root / "results.csv").open() as file:
        found = list(csv.DictReader(file))
    assert tuple(each["name"] for each in found) == people
    assert all(float(each["psnr"]) > 5 for each in found)
    assert len({each["psnr"] for each in found}) == len(people)
    tracked = [read_sequence(batch.workspace(name) / "sequences/MVI_1810").tracking for name in people]
    apart = (tracked[0].face.identity - tracked[1].face.identity).abs().max()
    assert float(apart) > 0.05, "each person has its own identity"


def _quietly(words: list[str]) -> int:
    """Run a command as a row does, without the options that draw most of the time."""
    return main([*words, "--no-perceptual"] if words[0] == "evaluate" else words)
