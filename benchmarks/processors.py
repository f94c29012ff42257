"""Measure how results differ between processors, and print the table of docs/reproducibility.md.

    python benchmarks/processors.py --out out/processors                  # some minutes
    python benchmarks/processors.py --out out/processors --settings isa-avx2 old

Environment variables emulate older processors. One synthetic clip is drawn once. Then a process for each setting tracks
it, trains an avatar on it (with the true tracking, so that the two do not mix), and renders both its own avatar and
that of the first setting. The table compares every setting with the first one, which is this machine as it is: PSNR of
renderings in dB, tracked vertices in millimetres, landmarks in pixels. To compare with another machine, copy the output
folder there and run the same command.
"""

import argparse
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from mien.avatar import Avatar, load_avatar
from mien.avatar.gaussian_avatars.settings import as_published
from mien.capture import read_capture, write_capture
from mien.capture.capture import Capture
from mien.face import load_face_model
from mien.lab.synthetic import RECIPES, synthesize
from mien.render import rasterize
from mien.tracking import read_tracking, track, write_tracking
from mien.tracking.tracking import Tracking
from mien.training import TrainSettings, train
from mien.training.footage.sequence import Sequence

FIRST = "here"
OLD = {"MKL_CBWR": "COMPATIBLE", "ATEN_CPU_CAPABILITY": "default", "OPENBLAS_CORETYPE": "Nehalem", "MIEN_ISA": "sse4"}
SETTINGS: dict[str, dict[str, str]] = {
    FIRST: {},
    "again, one more thread": {"MIEN_THREADS": "2"},
    "mkl-compatible": {"MKL_CBWR": "COMPATIBLE"},
    "aten-default": {"ATEN_CPU_CAPABILITY": "default"},
    "openblas-nehalem": {"OPENBLAS_CORETYPE": "Nehalem"},
    "isa-avx2": {"MIEN_ISA": "avx2"},
    "isa-sse4": {"MIEN_ISA": "sse4"},
    "old": OLD,
}
"""Environments by name. Those that name an instruction set need x86-64."""


def main() -> None:
    """Run the settings without results, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder for clip, avatars and results")
    parser.add_argument("--settings", nargs="*", default=[*SETTINGS], help=f"settings to run: {', '.join(SETTINGS)}")
    parser.add_argument("--steps", type=int, default=400, help="optimiser steps")
    parser.add_argument("--size", type=int, default=128, help="side of the pictures in pixels")
    parser.add_argument("--frames", type=int, default=16, help="frames of the clip")
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.worker:
        measure(given.out, given.worker, given.steps)
        return
    draw_clip(given.out, given.size, given.frames)
    names = [FIRST, *(name for name in given.settings if name != FIRST)]
    for name in names:
        if not (given.out / f"{name}.npz").is_file():
            command = [sys.executable, __file__, "--out", given.out, "--steps", str(given.steps), "--worker", name]
            subprocess.run(command, env={"MIEN_THREADS": "1", **os.environ, **SETTINGS[name]}, check=True)
    print(format_table(given.out, names))


def draw_clip(out: Path, size: int, frames: int) -> None:
    """Draw the clip and its true tracking, unless they exist."""
    if not (out / "truth").is_dir():
        recipe = replace(RECIPES["plain"], width=size, height=size, fps=8.0, seconds=frames / 8, texture_size=512)
        capture, truth = synthesize(recipe, 3)
        write_capture(out / "capture", capture)
        write_tracking(out / "truth", truth)


def measure(out: Path, name: str, steps: int) -> None:
    """Track, train and render in this environment, and write OUT/NAME.npz and OUT/run-NAME."""
    torch.set_num_threads(1)
    capture, truth = read_capture(out / "capture"), read_tracking(out / "truth")
    model = load_face_model(truth.face_model)
    tracked = track(capture, model)
    sequence = Sequence(capture.name, capture, truth, np.array(capture.mattes))
    settings = TrainSettings(
        steps=steps, split="none", background="white", edges="filmed", inside="free", unseen="trained"
    )
    own = train([sequence], model, as_published(), settings, out / f"run-{name}")
    points = model(tracked.face)
    marks = model.landmark_positions(points, "mediapipe")
    np.savez(
        out / f"{name}.npz",
        trained=render(own, truth),
        clip=over_white(capture),
        rendered=render(load_avatar(out / f"run-{FIRST}"), truth),
        vertices=points.numpy(),
        landmarks=tracked.cameras[0].project(marks)[0].numpy(),
    )


def over_white(capture: Capture) -> np.ndarray:
    """Return the pictures over white, as training sees them, float32."""
    alpha = capture.mattes[:, 0, ..., None] / np.float32(255)
    return alpha * (capture.images[:, 0] / np.float32(255)) + 1 - alpha


@torch.no_grad()
def render(avatar: Avatar, tracking: Tracking) -> np.ndarray:
    """Return an avatar's pictures at every timestep, float32."""
    pictures = []
    for timestep in range(len(tracking.face)):
        gaussians = avatar.pose(tracking.face[timestep]).gaussians.timestep(0)
        pictures.append(rasterize(gaussians, tracking.cameras[0], background=torch.ones(3)).image.numpy())
    return np.stack(pictures)


def format_table(out: Path, names: list[str]) -> str:
    """Return a table in Markdown that compares every setting with the first."""
    results = {name: dict(np.load(out / f"{name}.npz")) for name in names}
    first = results[FIRST]
    lines = [
        "| setting | one avatar, rendered | avatar, trained | against the clip | tracking: vertices | landmarks |",
        "|---|---|---|---|---|---|",
        f"| the machine as it is | | | {format_psnr(first['trained'], first['clip'])} | | |",
    ]
    for name in names[1:]:
        one = results[name]
        settings = " ".join(f"{key}={value}" for key, value in SETTINGS[name].items())
        cells = [format_psnr(one[part], first[part]) for part in ("rendered", "trained")]
        cells.append(format_psnr(one["trained"], one["clip"]))
        for part, unit, factor in (("vertices", "mm", 1000), ("landmarks", "px", 1)):
            away = factor * np.linalg.norm(one[part].astype(np.float64) - first[part], axis=-1)
            cells.append("same bytes" if not away.any() else f"{away.mean():.2g} {unit} (most {away.max():.2g})")
        lines.append(f"| `{settings}` | {' | '.join(cells)} |")
    return "\n".join(lines)


def format_psnr(pictures: np.ndarray, expected: np.ndarray) -> str:
    """Return the PSNR over all pictures as text."""
    squared = float(((pictures.astype(np.float64) - expected) ** 2).mean())
    return "same bytes" if squared == 0 else f"{-10 * np.log10(squared):.1f} dB"


if __name__ == "__main__":
    main()
