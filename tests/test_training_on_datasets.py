"""Avatars are trained on imports: what writers of each layout wrote, by the commands that docs/datasets.md names."""

import csv
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from dataset_cases import NoDetector, tiny_scene
from dataset_scene import Scene, make_scene, scene_of
from dataset_writers import (
    nerface_landmarks,
    write_benchmark,
    write_imavatar,
    write_insta,
    write_nerf_blendshape,
    write_nerface,
    write_vhap,
)
from mien.batch import Batch, run_row
from mien.batch.steps import do_with
from mien.cli import main
from mien.commands.stages.batch_table import read_table
from mien.face import add_face_model
from mien.face.cache import cache_folder
from mien.training import read_sequence
from test_datasets_fuzz import quick  # noqa: F401

TASK = ("EXP-2-eyes", "SEN-10-port_strong_smokey")
LAYOUTS: dict[str, tuple[Callable[[Path, Scene], Path], str, str]] = {
    "vhap": (write_vhap, "gaussian_avatars", "dataset"),
    "insta": (lambda folder, scene: write_insta(folder, scene, held_out=2), "headgas", "dataset"),
    "imavatar": (write_imavatar, "headgas", "dataset"),
    "nersemble-benchmark": (
        lambda folder, scene: write_benchmark(folder, scene, clips=TASK), "headgas", "nersemble-benchmark",
    ),
    "nerf-blendshape": (
        lambda folder, scene: write_nerf_blendshape(folder, scene, 7.0, True), "headgas", "tail",
    ),
    "nerface": (lambda folder, scene: write_nerface(folder, scene, detected=True), "headgas", "dataset"),
}  # fmt: skip
"""Writer, method and split of each layout that has a tracking. The last two have coefficients without a basis, which
suffice for HeadGaS. NeRFBlendShape's own split needs more than 500 frames."""
MODELS = {"nerf-blendshape": "coefficients-46", "nerface": "coefficients-76"}
"""Face models of the layouts that do not have FLAME's parameters."""
PROTOCOLS = tuple(layout for layout in LAYOUTS if layout != "nerf-blendshape")
SMALL = {"gaussian_avatars": ("--steps", "30"), "headgas": ("--steps", "40", "--method.points", "400")}
PLAIN = ("--training.unseen", "trained", "--training.inside", "free", "--training.mesh", "tracked")
"""Options that leave out what closes the sides that no camera filmed."""
HELD_OUT = {"vhap": 7, "insta": 2, "imavatar": 3, "nersemble-benchmark": 3, "nerf-blendshape": 1, "nerface": 1}
"""Pictures that each split holds out: of VHAP one timestep seen by two cameras, and five that are seen by one."""


@pytest.fixture(scope="module")
def scene(anny, tmp_path_factory) -> Scene:
    return make_scene(anny, tmp_path_factory.mktemp("flame"))


def not_white(images: np.ndarray, mattes: np.ndarray, plate: np.ndarray | None = None) -> None:
    mattes[:] = 255 * (images < 250).any(-1)


@pytest.mark.slow
@pytest.mark.usefixtures("short_films")
@pytest.mark.parametrize("layout", LAYOUTS)
def test_an_import_is_trained_on_and_scored_by_its_protocol(
    layout: str, scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from mien.datasets import matting, overlay, sequences

    monkeypatch.setattr(overlay, "LandmarkDetector", NoDetector)  # it finds no face in drawings this small
    shutil.copytree(cache_folder() / "face_models", tmp_path / "cache" / "face_models")
    monkeypatch.setenv("MIEN_CACHE", str(tmp_path / "cache"))
    add_face_model(replace(scene.model, name="flame"), Path("flame.npz"), "0")
    write, method, split = LAYOUTS[layout]
    given, root = write(tmp_path / "me", scene), tmp_path / "W"
    # NeRFace has no landmarks and no mattes, and the networks know no drawings this small.
    monkeypatch.setattr(sequences, "detected_landmarks", lambda images: nerface_landmarks(scene, images))
    monkeypatch.setattr(matting, "fill_mattes", not_white)
    assert main(["import", str(given), "--out", str(root), "--face-model", MODELS.get(layout, "flame")]) == 0
    line = ["train", str(root), "--method", method, "--split", split, "--preset", "draft"]
    assert main([*line, "--training.resolution", "96", *SMALL[method], *PLAIN]) == 0
    protocol = ["--protocol", layout] if layout in PROTOCOLS else []
    assert main(["evaluate", str(root), "--run", method, "--no-perceptual", *protocol]) == 0
    found = json.loads((root / "runs" / method / "metrics.json").read_text())["protocols"]
    assert sum(each["frames"] for each in found.values()) == HELD_OUT[layout]
    for name, each in found.items():
        assert each.get("dataset_protocol", layout) == layout
        assert each["psnr"] > each["baselines"]["mean_frame"]["psnr"] + 1, name


@pytest.mark.slow
@pytest.mark.usefixtures("quick", "short_films")
def test_ten_people_are_imported_trained_and_scored_by_one_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A row is a person. The row of a damaged one fails alone, and goes on where it stopped after it is mended.

    Nine rows run inside this process, without what draws most of the time. `mien batch` does the tenth alone.
    """
    monkeypatch.setenv("MIEN_CACHE", str(tmp_path / "cache"))
    scene = tiny_scene(tmp_path)
    add_face_model(scene.model, Path("tiny.npz"), "0")
    people = [f"subject{number}" for number in range(10)]
    for number, name in enumerate(people):
        write_imavatar(tmp_path / name, scene_of(scene.arrays, scene.model, len(scene), number))
    table = tmp_path / "people.csv"
    heading = "dataset,face_model,method,split,protocol,preset,steps,method.points\n"
    table.write_text(heading + "".join(f"{name},tiny,headgas,dataset,imavatar,draft,4,60\n" for name in people))
    damaged = tmp_path / "subject3/subject3/MVI_1812/flame_params.json"
    whole = damaged.read_text()
    damaged.write_text(whole.replace("world_mat", "world_mad", 1))
    batch, rows = Batch(tmp_path / "out"), read_table(table)
    batch.write_plan(rows)
    states = [run_row(batch, row, do_with(quietly)) for row in rows[:9]]
    assert [state.status for state in states if state is not None] == ["done"] * 3 + ["failed"] + ["done"] * 5
    assert (batch.workspace("subject3") / "sequences/MVI_1810").is_dir(), "what was read stays"
    damaged.write_text(whole)
    mended = run_row(batch, rows[3], do_with(quietly))
    assert mended is not None
    assert mended.status == "done"
    capsys.readouterr()
    assert main(["batch", str(table), "--out", str(batch.root), "--threads", "1"]) == 0
    assert "10 rows: 9 done before, 1 to do on local" in capsys.readouterr().err
    with (batch.root / "results.csv").open() as file:
        found = list(csv.DictReader(file))
    assert [each["name"] for each in found] == people
    assert all(float(each["psnr"]) > 5 for each in found)
    shapes = [read_sequence(batch.workspace(name) / "sequences/MVI_1810").tracking.face.identity for name in people]
    apart = min(float((one - other).abs().max()) for one, other in combinations(shapes, 2))
    assert apart > 0.05, "each person has its own identity"
    assert len({each["psnr"] for each in found}) == len(people)


def quietly(words: list[str]) -> int:
    """Run a command as a row does, without the options that draw most of the time."""
    return main([*words, "--no-perceptual"] if words[0] == "evaluate" else words)
