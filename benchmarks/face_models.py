"""Train an avatar of one synthetic person on each face model, and print how far they differ (docs/face_models.md).

    python benchmarks/face_models.py --out out/face_models --test-data ../shared/data     # an hour on one core

The person is anny's, moved off anny's space (`off_model`), and is filmed by one camera. The landmarks are those that
the detector finds in the pictures; the mattes are exact. Each face model is tracked, trained and evaluated by mien's
own commands with equal settings, and scored by the masks of the first model's tracking. The models in FLAME's and
GNM's schema are generated from anny, as in the tests, so that nothing of others is needed; ICT-FaceKit is read from
the test data. What exists already is kept.
"""

import argparse
import json
import os
import shutil
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mien.capture import write_capture
from mien.cli import main as mien
from mien.datasets.sequences import detected_landmarks
from mien.face.loading import add_face_model
from mien.lab.synthetic import synthesize
from mien.lab.synthetic.recipe import SyntheticRecipe

ROOT = Path(__file__).resolve().parent.parent
NAMES = ("anny", "gnm", "flame", "ict")
SEED = 5


def draw(folder: Path, recipe: SyntheticRecipe, models: list[str]) -> None:
    """Draw the person once, and put the capture into a workspace for each model."""
    missing = [name for name in models if not (folder / name / "sequences/person/capture").exists()]
    if not missing:
        return
    capture, _ = synthesize(recipe, SEED)
    landmarks = detected_landmarks(capture.images)
    valid = np.asarray(np.isfinite(landmarks).all((2, 3)))
    print(f"faces found in {int(valid.sum())} of {valid.size} pictures", flush=True)
    seen = replace(capture, name="person", landmarks=landmarks, valid=valid)
    for name in missing:
        write_capture(folder / name / "sequences/person/capture", seen)


def add(name: str, folder: Path, test_data: Path) -> None:
    """Add a generated model to a cache of its own, so that it stays out of the user's."""
    sys.path.insert(0, str(ROOT / "tests"))  # the tests make these models
    from face_models import face_model_named

    os.environ.pop("MIEN_CACHE", None)
    model = face_model_named(name, folder, test_data)
    os.environ["MIEN_CACHE"] = str(folder / "cache")
    add_face_model(model, folder / f"{name}.npz", "0")


def share_masks(workspace: Path, folder: Path) -> None:
    """Give a workspace the scoring masks of the first one: each tracking would cut the neck elsewhere."""
    own, common = workspace / "sequences/person/scoring", folder / "scoring"
    if not common.exists():
        shutil.copytree(own, common)
    shutil.rmtree(own)
    shutil.copytree(common, own)


def run(folder: Path, name: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """Track, train and evaluate on one face model, and return its row."""
    workspace, seconds, start = str(folder / name), {}, time.perf_counter()
    size = str(arguments.size)
    commands = {
        "track": ["track", workspace, "--face-model", name, "--overlay", "none"],
        "train": ["train", workspace, "--run", "a", "--steps", str(arguments.steps), "--training.resolution", size],
        "evaluate": ["evaluate", workspace, "--run", "a", "--no-perceptual"],
    }
    for step, command in commands.items():
        if step == "train":
            share_masks(folder / name, folder)
        assert mien(command) == 0, command
        seconds[step] = round(time.perf_counter() - start)
        start = time.perf_counter()
    (found,) = json.loads((folder / name / "runs/a/metrics.json").read_text())["protocols"].values()
    parts = {f"{part}_psnr": found[part]["psnr"] for part in ("head", "eyes", "mouth")}
    return {"model": name, "frames": found["frames"], "psnr": found["psnr"], **parts,
            "baselines": {key: each["head"]["psnr"] for key, each in found["baselines"].items()},
            "seconds": seconds}  # fmt: skip


def main() -> None:
    """Draw the person, and go through the face models."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, default=Path("out/face_models"))
    parser.add_argument("--test-data", type=Path, default=ROOT.parent / "shared/data")
    parser.add_argument("--models", nargs="+", default=list(NAMES), choices=NAMES)
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--seconds", type=float, default=4.8)
    parser.add_argument("--off-model", type=float, default=0.5)
    arguments = parser.parse_args()
    folder = arguments.out.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    recipe = SyntheticRecipe(
        name="alike", width=arguments.size, height=arguments.size, seconds=arguments.seconds, fps=10.0, glasses=False,
        off_model=arguments.off_model, rotation=(18.0, 10.0, 5.0),
    )  # fmt: skip
    draw(folder, recipe, arguments.models)
    for name in arguments.models:
        if name != "anny":
            add(name, folder, arguments.test_data)
        row = run(folder, name, arguments)
        with (folder / "rows.jsonl").open("a") as file:
            file.write(json.dumps(row) + "\n")
        print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
