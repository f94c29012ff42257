"""Avatars are trained on imports: what writers of each layout wrote, one after the other and by a table."""

import csv
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import dataset_writers as writers
from dataset_cases import make_quick, tiny_scene
from dataset_scene import NoDetector, Scene, drawn_person, scene_of
from mien.batch import Batch, run_row
from mien.batch.steps import do_with
from mien.cli import main
from mien.commands.stages.batch_table import read_table
from mien.datasets import matting, overlay, sequences
from mien.evaluation import EvaluationSettings, evaluate
from mien.face import add_face_model
from mien.face.cache import cache_folder
from mien.training import read_sequence

pytestmark = pytest.mark.unchecked

TASK = ("EXP-2-eyes", "SEN-10-port_strong_smokey")
LAYOUTS: dict[str, tuple[Callable[[Path, Scene], Path], str, str, int]] = {
    "vhap": (writers.write_vhap, "gaussian_avatars", "dataset", 7),
    "insta": (partial(writers.write_insta, held_out=2), "headgas", "dataset", 2),
    "imavatar": (writers.write_imavatar, "headgas", "dataset", 3),
    "nersemble-benchmark": (partial(writers.write_benchmark, clips=TASK), "headgas", "nersemble-benchmark", 3),
    "nerf-blendshape": (partial(writers.write_nerf_blendshape, scale=7.0, detected=True), "headgas", "tail", 1),
    "nerface": (partial(writers.write_nerface, detected=True), "headgas", "dataset", 1),
}
"""Writer, method and split of each layout that has a tracking, and how many pictures the split holds out.

VHAP holds out one timestep seen by two cameras, and five seen by one. The last two have coefficients without a basis,
which suffice for HeadGaS. NeRFBlendShape's own split needs more than 500 frames."""
MODELS = {"nerf-blendshape": "coefficients-46", "nerface": "coefficients-76"}
"""Face models of the layouts that do not have FLAME's parameters."""
SMALL = {"gaussian_avatars": ("--steps", "30"), "headgas": ("--steps", "40", "--method.points", "400")}
PLAIN = ("--training.unseen", "trained", "--training.inside", "free", "--training.mesh", "tracked")
"""Options that leave out what closes the sides that no camera filmed."""


def not_white(images: np.ndarray, mattes: np.ndarray, plate: np.ndarray | None = None) -> None:
    mattes[:] = 255 * (images < 250).any(-1)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_an_import_is_trained_on_and_scored_by_its_protocol(layout: str, tmp_path, monkeypatch) -> None:
    scene = drawn_person()
    monkeypatch.setattr(overlay, "LandmarkDetector", NoDetector)  # it finds no face in drawings this small
    shutil.copytree(cache_folder() / "face_models", tmp_path / "cache" / "face_models")
    monkeypatch.setenv("MIEN_CACHE", str(tmp_path / "cache"))
    add_face_model(replace(scene.model, name="flame"), Path("flame.npz"), "0")
    write, method, split, held_out = LAYOUTS[layout]
    given, root = write(tmp_path / "me", scene), tmp_path / "W"
    # NeRFace has no landmarks and no mattes, and the networks know no drawings this small.
    monkeypatch.setattr(sequences, "detected_landmarks", lambda images: writers.nerface_landmarks(scene, images))
    monkeypatch.setattr(matting, "fill_mattes", not_white)
    assert main(["import", str(given), "--out", str(root), "--face-model", MODELS.get(layout, "flame")]) == 0
    line = ["train", str(root), "--method", method, "--split", split, "--preset", "draft"]
    assert main([*line, "--training.resolution", "96", *SMALL[method], *PLAIN]) == 0
    settings = EvaluationSettings(perceptual=False, video_frames=0, edges="filmed")
    if layout != "nerf-blendshape":
        settings = replace(settings, protocol=layout)
    found = evaluate(root / "runs" / method, sorted((root / "sequences").iterdir()), settings)["protocols"]
    assert sum(each["frames"] for each in found.values()) == held_out
    for name, each in found.items():
        assert each.get("dataset_protocol", layout) == layout
        assert each["psnr"] > each["baselines"]["mean_frame"]["psnr"] + 1, name


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
    states = [run_row(batch, row, do_with(_quietly)) for row in rows]
    assert [state.status for state in states if state is not None] == ["done", "failed"]
    assert (batch.workspace("subject1") / "sequences/MVI_1810").is_dir(), "what was read stays"
    damaged.write_text(whole)
    mended = run_row(batch, rows[1], do_with(_quietly))
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
