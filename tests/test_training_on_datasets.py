"""Avatars are trained on imports: what writers of each layout wrote, by the commands that docs/datasets.md names."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from dataset_scene import Scene, make_scene
from dataset_writers import write_benchmark, write_imavatar, write_insta, write_nerf_blendshape, write_vhap
from mien.cli import main
from mien.face import add_face_model
from mien.face.cache import cache_folder
from mien.training import read_curves
from test_datasets_fuzz import NoDetector

TASK = ("EXP-2-eyes", "SEN-10-port_strong_smokey")
LAYOUTS: dict[str, tuple[Callable[[Path, Scene], Path], str, str]] = {
    "vhap": (write_vhap, "gaussian_avatars", "dataset"),
    "insta": (lambda folder, scene: write_insta(folder, scene, held_out=2), "headgas", "dataset"),
    "imavatar": (write_imavatar, "mono_gaussian_avatar", "dataset"),
    "nersemble-benchmark": (
        lambda folder, scene: write_benchmark(folder, scene, clips=TASK), "headgas", "nersemble-benchmark",
    ),
    "nerf-blendshape": (
        lambda folder, scene: write_nerf_blendshape(folder, scene, 7.0, True), "headgas", "tail",
    ),
}  # fmt: skip
"""Writer, method and split of each layout that has a tracking. The first three were made for their methods. The last one
has coefficients without a basis, which HeadGaS needs alone, and its own split needs more than 500 frames."""
PROTOCOLS = tuple(layout for layout in LAYOUTS if layout != "nerf-blendshape")
SMALL = {
    "gaussian_avatars": (),
    "headgas": ("--method.points", "400"),
    "mono_gaussian_avatar": ("--method.pretraining", "0", "--method.points", "400", "--method.start", "sphere"),
}
PLAIN = ("--training.unseen", "trained", "--training.inside", "free", "--training.mesh", "tracked")
"""Options that leave out what closes the sides that no camera filmed."""
HELD_OUT = {"vhap": 7, "insta": 2, "imavatar": 3, "nersemble-benchmark": 3, "nerf-blendshape": 1}
"""Pictures that each split holds out: of VHAP one timestep seen by two cameras, and five that are seen by one."""


@pytest.fixture(scope="module")
def scene(anny, tmp_path_factory) -> Scene:
    return make_scene(anny, tmp_path_factory.mktemp("flame"))


@pytest.mark.slow
@pytest.mark.parametrize("layout", LAYOUTS)
def test_an_import_is_trained_on_and_scored_by_its_protocol(
    layout: str, scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from mien.datasets import overlay
    from mien.evaluation import living

    monkeypatch.setattr(overlay, "LandmarkDetector", NoDetector)  # it finds no face in drawings this small
    monkeypatch.setattr(living, "FPS", 2)  # a film of the avatar is no part of this
    shutil.copytree(cache_folder() / "face_models", tmp_path / "cache" / "face_models")
    monkeypatch.setenv("MIEN_CACHE", str(tmp_path / "cache"))
    add_face_model(replace(scene.model, name="flame"), Path("flame.npz"), "0")
    write, method, split = LAYOUTS[layout]
    given, root = write(tmp_path / "me", scene), tmp_path / "W"
    model = "flame" if layout in PROTOCOLS else "coefficients-46"
    assert main(["import", str(given), "--out", str(root), "--face-model", model]) == 0
    line = ["train", str(root), "--method", method, "--split", split, "--preset", "draft", "--steps", "30"]
    assert main([*line, "--training.resolution", "96", "--training.record-every", "1", *SMALL[method], *PLAIN]) == 0
    protocol = ["--protocol", layout] if layout in PROTOCOLS else []
    assert main(["evaluate", str(root), "--run", method, "--no-perceptual", *protocol]) == 0
    found = json.loads((root / "runs" / method / "metrics.json").read_text())["protocols"]
    assert sum(each["frames"] for each in found.values()) == HELD_OUT[layout]
    losses = read_curves(root / "runs" / method)["loss"]
    assert losses[-6:].mean() < 0.6 * losses[:2].mean()
    for name, each in found.items():
        assert each.get("dataset_protocol", layout) == layout
        assert each["psnr"] > each["baselines"]["mean_frame"]["psnr"] + 3, name
