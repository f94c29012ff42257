"""Measure what each rule of density control is worth, and print a table of them (docs/log.md has the figures).

    python benchmarks/density_rules.py --out out/density_rules            # about half an hour on one core

A synthetic person is drawn once: a ring of cameras, 256x256. One avatar is trained with all rules on, one with each
rule off, and two with the preset `paper` in short: with its rates of the face, and with those of `standard`. All use
the true tracking, so that no error of a tracker mixes in. Figures are PSNR on the head crop: of a held-out camera at
trained timesteps (view), and of held-out timesteps in all cameras (frames). Rows that exist already are kept.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path
from statistics import fmean, median
from typing import Any, get_args

import numpy as np
import torch

from mien.avatar import Avatar, GaussianAvatarsConfig
from mien.avatar.gaussian_avatars.settings import as_published
from mien.avatar.settings import DensityRule, FaceTuning, GradientSettings
from mien.disk.files import read_tensors
from mien.evaluation.metrics import psnr
from mien.evaluation.scoring import as_8_bit
from mien.face import FaceParams, load_face_model
from mien.lab.synthetic import synthesize
from mien.lab.synthetic.recipe import Segment, SyntheticRecipe
from mien.render import rasterize
from mien.tracking.scoring import Scoring, make_scoring
from mien.training import PRESETS, train
from mien.training.footage.frames import Frame, evenly_spread, held_out
from mien.training.footage.sequence import Sequence, composite
from mien.training.run import read_curves

RECIPE = SyntheticRecipe(
    name="rules", width=256, height=256, fps=10.0, cameras="ring", ring_size=6, glasses=False,
    rotation=(8.0, 5.0, 4.0), turns=(30.0, 14.0), translation=(0.012, 0.008, 0.02),
    script=(Segment("expressions", 3.0), Segment("speech", 2.0)),
)  # fmt: skip
HELD_OUT_CAMERA = 2
MAX_SCORED = 60
TUNED = FaceTuning(enabled=False)
DENSITY = GradientSettings(prune_radius=20.0, max_gaussians=24_000)


def configs() -> dict[str, GaussianAvatarsConfig]:
    """The rows of the table."""
    base = replace(as_published(), face_tuning=TUNED, density=DENSITY)
    rows = {"all rules on": base}
    for name in get_args(DensityRule):
        rows[f"without {name}"] = replace(base, density=replace(DENSITY, rules_off=(name,)))
    paper: Any = replace(PRESETS["paper"].config("gaussian_avatars"), sh_degree=0)
    paper = replace(paper, density=replace(paper.density, max_gaussians=DENSITY.max_gaussians))
    rows["paper in short"] = paper
    rows["paper in short, face rates of standard"] = replace(paper, face_tuning=FaceTuning())
    return rows


def scores(avatar: Avatar, faces: FaceParams, sequence: Sequence, scoring: Scoring) -> dict[str, float]:
    """PSNR on the head crop, by what is held out."""
    left_out = held_out(sequence.capture.timesteps, "blocks").tolist()
    cameras = range(len(sequence.capture.camera_ids))
    frames = {
        "view": [Frame(0, t, HELD_OUT_CAMERA) for t, out in enumerate(left_out) if not out],
        "frames": [Frame(0, t, c) for t, out in enumerate(left_out) if out for c in cameras],
    }
    return {name: fmean(_score(avatar, faces, sequence, scoring, f) for f in chosen(fs)) for name, fs in frames.items()}


def chosen(frames: list[Frame]) -> list[Frame]:
    """At most `MAX_SCORED` of the frames, evenly spread."""
    return evenly_spread(frames, MAX_SCORED)


@torch.no_grad()
def _score(avatar: Avatar, faces: FaceParams, sequence: Sequence, scoring: Scoring, frame: Frame) -> float:
    gaussians = avatar.pose(faces[frame.timestep]).gaussians.timestep(0)
    drawn = rasterize(gaussians, sequence.tracking.cameras[frame.camera], torch.ones(3)).image
    truth = composite(sequence.capture.images[frame[1:]], scoring.masks[frame[1:]], np.full(3, 255, np.uint8))
    left, top, width, height = (int(value) for value in scoring.crops[frame[1:]])
    return float(psnr(as_8_bit(drawn), torch.from_numpy(truth).float() / 255, (left, top, width, height)))


def main() -> None:
    """Measure the rows that are missing, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=1500)
    arguments = parser.parse_args()
    capture, tracking = synthesize(RECIPE, seed=8)
    face_model = load_face_model(tracking.face_model)
    scoring = make_scoring(capture, tracking, face_model)
    sequence = Sequence("rules", capture, tracking, scoring.masks)
    plain, held = PRESETS["paper"].settings, (capture.camera_ids[HELD_OUT_CAMERA],)
    settings = replace(plain, steps=arguments.steps, held_out_cameras=held)
    print("| rules | view | frames | Gaussians | step, ms | empty triangles |\n|---|---|---|---|---|---|", flush=True)
    for name, config in configs().items():
        run_dir = arguments.out / name.replace(",", "").replace(" ", "_")
        kept = run_dir / "row.json"
        if not kept.is_file():
            avatar = train([sequence], face_model, config, settings, run_dir)
            faces = FaceParams(**read_tensors(run_dir / "face_track.safetensors"))
            filled = len(avatar.store["face_index"].unique())
            row = scores(avatar, faces, sequence, scoring)
            row |= {"gaussians": len(avatar.store), "ms": median(read_curves(run_dir)["step_ms"].tolist())}
            kept.write_text(json.dumps(row | {"empty": len(face_model.faces) - filled}))
        row = json.loads(kept.read_text())
        figures = f"{row['view']:.2f} | {row['frames']:.2f} | {row['gaussians']:,} | {row['ms']:.1f} | {row['empty']}"
        print(f"| {name} | {figures} |", flush=True)


if __name__ == "__main__":
    main()
