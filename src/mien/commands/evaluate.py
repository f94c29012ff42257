"""`mien evaluate`: figures, reports and comparisons."""

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from mien.disk.config import Range
from mien.disk.workspace import open_workspace
from mien.errors import UserError
from mien.machine.devices import DeviceName, check_device
from mien.machine.terminal import show

Protocol = Literal["insta", "imavatar", "nersemble", "nersemble-benchmark", "vhap", "nerface", "nerf-blendshape"]
"""Names of `mien.evaluation.dataset_protocols`, without its imports."""
_COUNT = Range(0, 1_000_000)
_FRAMES = 24
"""Number of frames on which ST-LPIPS is computed by default."""


@dataclass(frozen=True)
class Run:
    """Score a run on its held-out frames: metrics.json, report.html and side-by-side videos in DIR/runs/NAME.

    mien evaluate compare DIR [DIR ...]: one table over all evaluated runs, and compare.html.

    mien evaluate images PREDICTED TRUTH: the same figures for pictures of any origin.
    """

    workspace: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """Workspace folder."""
    run_name: Annotated[str | None, tyro.conf.arg(name="run")] = None
    """Name of the run (default: the only one)."""
    drivers: tuple[Path, ...] = ()
    """Also score cross-reenactment: workspaces (or their sequences/NAME folders) whose motion drives the avatar. For a
    run with --split gaussian-avatars, only the sequence FREE of each workspace drives it."""
    pictures: bool = False
    """Also write every scored picture and its truth as png, so that other programs can be scored on them."""
    perceptual: bool = True
    """By default, ST-LPIPS is computed, which takes most of the time. --no-perceptual leaves it out."""
    perceptual_frames: Annotated[int | None, _COUNT] = None
    """Largest number of frames, evenly spread, on which ST-LPIPS and LPIPS are computed. 0 means all frames (default:
    24; with --protocol and --lpips-weights all, as papers do)."""
    lpips_weights: Path | None = None
    """Torchvision's alexnet-owt-7be5be79.pth or vgg16-397923af.pth, to compute exact LPIPS as well, as papers report
    it. It needs the package lpips."""
    edges: Literal["cleaned", "filmed"] = "cleaned"
    """Truth at soft edges of the matte: colours of the person alone (cleaned), or pictures as they were filmed, which
    hold some of the background there (filmed), for figures beside those of other programs."""
    protocol: Protocol | None = None
    """Score as the authors of an imported dataset do: whole pictures over white, their mattes, their held-out frames,
    their window of SSIM (docs/datasets.md). The run has to be trained with their split: --split dataset,
    gaussian-avatars or nersemble-benchmark. It implies --edges filmed."""
    fit_faces: bool = False
    """Also score the avatar with expression and pose fitted to each held-out frame by its colours: a third figure
    beside those as tracked and corrected, never the headline. It takes longer."""
    fit_steps: Annotated[int, Range(1, 10_000)] = 20
    """Number of optimiser steps of --fit-faces, for each held-out timestep."""
    device: DeviceName = "cpu"
    """Device that draws the avatar; auto: a GPU if there is one. --fit-faces needs the CPU."""
    resume: bool = False
    """Leave a run that was scored with the same settings as it is, unless drivers are given."""
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Print the result as json on standard output, for programs."""

    def check(self) -> None:
        """Check without heavy libraries that there is such a run."""
        check_weights(self.lpips_weights)
        check_device(self.device)
        if self.fit_faces and self.device != "cpu":
            raise UserError(f"--fit-faces --device {self.device}: faces are fitted on the CPU; leave out --device")
        open_workspace(self.workspace).pick_run(self.run_name)

    def run(self) -> None:
        """Score the run."""
        from mien.evaluation.protocols import EvaluationSettings
        from mien.pipeline.evaluate import run_evaluation_stage

        chosen = scoring_of(self.protocol, self.lpips_weights, self.edges)
        if self.perceptual_frames is not None:
            chosen["perceptual_frames"] = self.perceptual_frames
        settings = EvaluationSettings(
            perceptual=self.perceptual, pictures=self.pictures, fit_faces=self.fit_faces, fit_steps=self.fit_steps,
            device=self.device, **chosen,
        )  # fmt: skip
        workspace = open_workspace(self.workspace)
        metrics = run_evaluation_stage(
            workspace, workspace.pick_run(self.run_name), settings, self.drivers, again=not self.resume
        )
        if self.as_json:
            show(json.dumps(metrics, indent=1))


@dataclass(frozen=True)
class Compare:
    """Print one table over the evaluated runs of some workspaces, and write it as a page."""

    workspaces: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="DIR [DIR ...]")]
    """Workspace folders."""
    run_name: Annotated[str | None, tyro.conf.arg(name="run")] = None
    """Name of the runs (default: all)."""
    out: Path | None = None
    """File for the page (default: compare.html in the first workspace)."""
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Print the result as json on standard output, for programs."""

    def check(self) -> None:
        """Check without heavy libraries that there are such workspaces and runs."""
        if not self.workspaces:
            raise UserError("no workspace to compare the runs of; give one or several folders")
        for folder in self.workspaces:
            workspace = open_workspace(folder)
            if self.run_name is not None:
                workspace.pick_run(self.run_name)

    def run(self) -> None:
        """Print the table, and write the page."""
        from mien.evaluation.text import comparison_text
        from mien.pipeline.evaluate import run_comparison

        comparison = run_comparison([open_workspace(folder) for folder in self.workspaces], self.run_name, self.out)
        if self.as_json:
            show(json.dumps(comparison.content(), indent=1))
        else:
            show(comparison_text(comparison, bold=sys.stdout.isatty()), styled=True)


@dataclass(frozen=True)
class Images:
    """Score pictures that any program made, by the same code."""

    images: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PREDICTED")]
    """Folder of pictures (or a video) to score. The names must be those of the true pictures."""
    truth: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="TRUTH")]
    """Folder of the true pictures (or a video)."""
    mattes: Path | None = None
    """Folder of opacity pictures. They select the part of the truth that counts; the rest becomes the background."""
    crops: Path | None = None
    """A crops.json with head boxes (default: the one in TRUTH, or else the boxes of the mattes)."""
    background: Literal["white", "black"] = "white"
    """Background of the pictures outside the person."""
    perceptual: bool = True
    """By default, ST-LPIPS is computed, which takes most of the time. --no-perceptual leaves it out."""
    perceptual_frames: Annotated[int, _COUNT] = _FRAMES
    """Largest number of frames, evenly spread, on which ST-LPIPS and LPIPS are computed. 0 means all frames."""
    lpips_weights: Path | None = None
    """Torchvision's weights, to compute exact LPIPS as well, as for `mien evaluate DIR`."""
    out: Path | None = None
    """File for the result as json."""
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Print the result as json on standard output, for programs."""

    def check(self) -> None:
        """Check without heavy libraries that there are pictures."""
        check_weights(self.lpips_weights)
        for path in (self.images, self.truth):
            if not path.exists():
                raise UserError(f"{path}: no such folder; give a folder of pictures, or a video")

    def run(self) -> None:
        """Score the pictures."""
        from mien.evaluation.image_folders import ImageFolders, score_folders, write_scores
        from mien.evaluation.scoring import ScoreSettings
        from mien.evaluation.text import scores_lines

        folders = ImageFolders(self.images, self.truth, self.mattes, self.crops, self.background)
        settings = ScoreSettings(self.perceptual, self.perceptual_frames, lpips_weights=self.lpips_weights)
        scores = score_folders(folders, settings)
        if self.out is not None:
            write_scores(self.out, scores)
        show(json.dumps(scores, indent=1) if self.as_json else "\n".join(scores_lines(scores)))


TASKS = {"": Run, "compare": Compare, "images": Images}


def scoring_of(protocol: Protocol | None, weights: Path | None, edges: str = "cleaned") -> dict[str, Any]:
    """Settings of an evaluation by a dataset's protocol and with LPIPS, whose papers score every frame."""
    frames = 0 if protocol is not None and weights is not None else _FRAMES
    edges = edges if protocol is None else "filmed"
    return {"protocol": protocol, "lpips_weights": weights, "edges": edges, "perceptual_frames": frames}


def check_weights(weights: Path | None) -> None:
    """Check that the file of `--lpips-weights` is there."""
    if weights is not None and not weights.is_file():
        raise UserError(f"--lpips-weights {weights}: no such file; give torchvision's file of AlexNet")
