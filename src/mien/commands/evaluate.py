"""`mien evaluate`: figures, reports and comparisons."""

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from mien.disk.workspace import open_workspace
from mien.errors import UserError
from mien.machine.terminal import show

Protocol = Literal["insta", "imavatar", "nersemble", "nersemble-benchmark", "vhap", "nerface", "nerf-blendshape"]
"""Names of `mien.evaluation.dataset_protocols`, without its imports."""
_FRAMES = 24
"""Number of frames on which ST-LPIPS is computed by default."""
JsonFlag = Annotated[bool, tyro.conf.arg(name="json")]


@dataclass(frozen=True)
class Command:
    """Score a run on its held-out frames, compare runs, or score pictures that another program made.

    mien evaluate DIR [--run NAME]: metrics.json, report.html and side-by-side videos in DIR/runs/NAME.

    mien evaluate DIR [DIR ...] --compare: one table over all evaluated runs, and compare.html.

    mien evaluate --images PRED --truth TRUTH: the same figures for pictures of any origin.
    """

    workspaces: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[DIR [DIR ...]]")] = ()
    """Workspace folders. Give one, or several with --compare."""
    run_name: Annotated[str | None, tyro.conf.arg(name="run")] = None
    """Name of the run (default: the only one)."""
    drivers: tuple[Path, ...] = ()
    """Also score cross-reenactment: workspaces (or their sequences/NAME folders) whose motion drives the avatar. For a
    run with --split gaussian-avatars, only the sequence FREE of each workspace drives it."""
    pictures: bool = False
    """Also write every scored picture and its truth as png, so that other programs can be scored on them."""
    perceptual: bool = True
    """By default, ST-LPIPS is computed, which takes most of the time. --no-perceptual leaves it out."""
    perceptual_frames: int | None = None
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
    fit_steps: int = 20
    """Number of optimiser steps of --fit-faces, for each held-out timestep: 1 to 10,000."""
    compare: bool = False
    """Print one table over the runs of all given workspaces, and write compare.html into the first one."""
    images: Path | None = None
    """Folder of pictures (or a video) to score. The names must be those of the true pictures."""
    truth: Path | None = None
    """Folder of the true pictures (or a video)."""
    mattes: Path | None = None
    """Folder of opacity pictures. They select the part of the truth that counts; the rest becomes the background."""
    crops: Path | None = None
    """A crops.json with head boxes (default: the one in TRUTH, or else the boxes of the mattes)."""
    background: Literal["white", "black"] = "white"
    """Background of the pictures of --images outside the person."""
    out: Path | None = None
    """File for the result: json with --images, html with --compare."""
    as_json: JsonFlag = False
    """Print the result as json on standard output, for programs."""

    def check(self) -> None:
        """Check without heavy libraries which of the three tasks is asked for, and that its input exists."""
        if self.perceptual_frames is not None and self.perceptual_frames < 0:
            raise UserError(f"--perceptual-frames {self.perceptual_frames}: give a positive number, or 0 for all")
        if self.lpips_weights is not None and not self.lpips_weights.is_file():
            raise UserError(f"--lpips-weights {self.lpips_weights}: no such file; give torchvision's file of AlexNet")
        if not 1 <= self.fit_steps <= 10_000:
            raise UserError(f"--fit-steps {self.fit_steps}: give a number from 1 to 10000")
        if self.fit_faces and (self.compare or self.images is not None):
            raise UserError("--fit-faces: is for one run, without --compare and --images; leave it out")
        if self.protocol is not None and (self.compare or self.images is not None):
            raise UserError(f"--protocol {self.protocol}: is for one run, without --compare and --images; leave it out")
        if self.edges == "filmed" and (self.compare or self.images is not None):
            raise UserError("--edges filmed: is for one run, without --compare and --images; leave it out")
        if self.images is not None or self.truth is not None:
            self._check_images()
        elif not self.workspaces:
            raise UserError("nothing to evaluate; give a workspace folder, or --images PRED --truth TRUTH")
        elif len(self.workspaces) > 1 and not self.compare:
            raise UserError(f"{len(self.workspaces)} workspaces: give one, or add --compare to compare their runs")
        for folder in self.workspaces:
            workspace = open_workspace(folder)
            if not self.compare or self.run_name is not None:
                workspace.pick_run(self.run_name)

    def run(self) -> None:
        """Run the task that is asked for."""
        if self.images is not None and self.truth is not None:
            self._score_images(self.images, self.truth)
        elif self.compare:
            self._compare()
        else:
            self._evaluate()

    def _evaluate(self) -> None:
        from mien.evaluation.protocols import EvaluationSettings
        from mien.pipeline.evaluate import run_evaluation_stage

        whole = self.protocol is not None and self.lpips_weights is not None
        settings = EvaluationSettings(
            perceptual=self.perceptual,
            perceptual_frames=self._frames(0 if whole else _FRAMES),
            pictures=self.pictures,
            lpips_weights=self.lpips_weights,
            edges="filmed" if self.protocol is not None else self.edges,
            protocol=self.protocol,
            fit_faces=self.fit_faces,
            fit_steps=self.fit_steps,
        )
        workspace = open_workspace(self.workspaces[0])
        metrics = run_evaluation_stage(workspace, workspace.pick_run(self.run_name), settings, self.drivers)
        if self.as_json:
            _print_json(metrics)

    def _frames(self, default: int) -> int:
        return default if self.perceptual_frames is None else self.perceptual_frames

    def _compare(self) -> None:
        from mien.evaluation.text import comparison_text
        from mien.pipeline.evaluate import run_comparison

        comparison = run_comparison([open_workspace(folder) for folder in self.workspaces], self.run_name, self.out)
        if self.as_json:
            _print_json(comparison.content())
        else:
            show(comparison_text(comparison, bold=sys.stdout.isatty()), styled=True)

    def _check_images(self) -> None:
        if self.images is None or self.truth is None:
            raise UserError("--images PRED and --truth TRUTH belong together; give both")
        if self.workspaces or self.compare:
            raise UserError("--images and --truth score folders of pictures; leave out the workspace and --compare")
        for path in (self.images, self.truth):
            if not path.exists():
                raise UserError(f"{path}: no such folder; give a folder of pictures, or a video")

    def _score_images(self, images: Path, truth: Path) -> None:
        from mien.evaluation.image_folders import ImageFolders, score_folders, write_scores
        from mien.evaluation.scoring import ScoreSettings
        from mien.evaluation.text import scores_lines

        folders = ImageFolders(images, truth, self.mattes, self.crops, self.background)
        scores = score_folders(
            folders, ScoreSettings(self.perceptual, self._frames(_FRAMES), lpips_weights=self.lpips_weights)
        )
        if self.out is not None:
            write_scores(self.out, scores)
        if self.as_json:
            _print_json(scores)
        else:
            show("\n".join(scores_lines(scores)))


def _print_json(content: dict[str, Any]) -> None:
    show(json.dumps(content, indent=1))
