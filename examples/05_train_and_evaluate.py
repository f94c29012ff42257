"""Train an avatar with settings of your own, then score it on held-out frames.

python examples/05_train_and_evaluate.py out/examples/subject --steps 3000
"""

import argparse
from dataclasses import replace
from pathlib import Path

import torch

from mien.avatar import GaussianAvatarsConfig
from mien.disk.workspace import open_workspace
from mien.evaluation import evaluate
from mien.face import load_face_model
from mien.training import TrainSettings, read_sequence, train


def main() -> None:
    """Train and evaluate. If this is interrupted, the same command continues where it stopped."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("workspace", type=Path, help="workspace with tracked sequences")
    parser.add_argument("--run", default="example", help="name of the new run")
    parser.add_argument("--steps", type=int, default=3000, help="optimiser steps")
    parser.add_argument("--gaussians", type=int, default=20_000, help="largest number of Gaussians")
    options = parser.parse_args()

    torch.set_num_threads(1)
    workspace = open_workspace(options.workspace)
    folders = [workspace.sequence_dir(name) for name in workspace.tracked_names()]
    sequences = [read_sequence(folder) for folder in folders]
    # The defaults are those of `mien train`. The same settings there give the same bytes.
    method = GaussianAvatarsConfig()
    method = replace(method, density=replace(method.density, max_gaussians=options.gaussians))
    settings = TrainSettings(steps=options.steps)
    run_dir = workspace.run_dir(options.run)
    train(sequences, load_face_model(sequences[0].tracking.face_model), method, settings, run_dir)

    metrics = evaluate(run_dir, folders)
    for name, scores in metrics["protocols"].items():
        print(f"{name}: PSNR {scores['psnr']:.2f} dB whole frame, {scores['head']['psnr']:.2f} dB head crop")
        for baseline, values in scores["baselines"].items():
            print(f"  baseline {baseline}: {values['psnr']:.2f} dB whole frame")
    print(f"look at {run_dir / 'report.html'}")


if __name__ == "__main__":
    main()
