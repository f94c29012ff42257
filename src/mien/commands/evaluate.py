"""`mien evaluate`."""

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from mien.errors import UserError
from mien.terminal import show
from mien.workspace import open_workspace

JsonFlag = Annotated[bool, tyro.conf.arg(name="json")]


@dataclass(frozen=True)
class Command:
    """Score a run on its held-out frames; or compare runs; or score pictures that another program made.

    mien evaluate DIR [--run NAME]: metrics.json, report.html and side-by-side videos in DIR/runs/NAME.
    mien evaluate DIR [DIR ...] --compare: one table over all runs that were evaluated, and compare.html.
    mien evaluate --images PRED --truth TRUTH: the same figures for pictures of any origin.
    """

    workspaces: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Workspace folders; one, unless runs are compared."""
    run_name: Annotated[str | None, tyro.conf.arg(name="run")] = None
    """Which run (default: the only one)."""
    drivers: tuple[Path, ...] = ()
    """Also score cross-reenactment: workspaces (or their sequences/NAME folders) whose motion drives the avatar."""
    pictures: bool = False
    """Also write every scored picture and its truth as png: what other programs can be scored against."""
    perceptual: bool = True
    """ST-LPIPS is computed, which takes most of the time; with --no-perceptual it is not."""
    perceptual_frames: int = 32
    """ST-LPIPS is computed on at most this many frames, evenly spread; 0 for all."""
    compare: bool = False
    """One table over the runs of all workspaces given, as text and as compare.html in the first one."""
    images: Path | None = None
    """Folder of pictures (or a video) to score; names must be those of their truths."""
    truth: Path | None = None
    """Folder of true pictures (or a video)."""
    mattes: Path | None = None
    """Folder of opacity pictures: what of the truth counts; the rest becomes the background."""
    crops: Path | None = None
    """crops.json with head boxes (default: the one in TRUTH, else the boxes of the mattes)."""
    background: Literal["white", "black"] = "white"
    """What the pictures of --images lie over where there is no person."""
    out: Path | None = None
    """Write the result of --images as json, or of --compare as html, to this file."""
    as_json: JsonFlag = False
    """Print the result on standard output for machines."""

    def check(self) -> None:
        """Tell what can be told without heavy libraries: which of the three is asked for, and whether it is there."""
        if self.perceptual_frames < 0:
            raise UserError(f"--perceptual-frames {self.perceptual_frames}: give a positive number, or 0 for all")
        if self.images is not None or self.truth is not None:
            self._check_images()
        elif not self.workspaces:
            raise UserError("nothing to evaluate; give a workspace folder, or --images PRED --truth TRUTH")
        elif len(self.workspaces) > 1 and not self.compare:
            raise UserError(f"{len(self.workspaces)} workspaces: give one, or --compare their runs")
        for folder in self.workspaces:
            workspace = open_workspace(folder)
            if not self.compare or self.run_name is not None:
                workspace.pick_run(self.run_name)

    def run(self) -> None:
        """Do which of the three is asked for."""
        if self.images is not None and self.truth is not None:
            self._score_images(self.images, self.truth)
        elif self.compare:
            self._compare()
        else:
            self._evaluate()

    def _evaluate(self) -> None:
        from mien.commands.stages.evaluating import evaluation_stage
        from mien.evaluation import EvaluationSettings

        settings = EvaluationSettings(
            perceptual=self.perceptual, perceptual_frames=self.perceptual_frames, pictures=self.pictures
        )
        workspace = open_workspace(self.workspaces[0])
        metrics = evaluation_stage(workspace, workspace.pick_run(self.run_name), settings, self.drivers)
        if self.as_json:
            _print_json(metrics)

    def _compare(self) -> None:
        from mien.commands.stages.evaluating import comparison_stage
        from mien.evaluation.compare_text import comparison_text

        comparison = comparison_stage([open_workspace(folder) for folder in self.workspaces], self.run_name, self.out)
        if self.as_json:
            _print_json(comparison.content())
        else:
            show(comparison_text(comparison, bold=sys.stdout.isatty()), styled=True)

    def _check_images(self) -> None:
        if self.images is None or self.truth is None:
            raise UserError("--images PRED and --truth TRUTH belong together; give both")
        if self.workspaces or self.compare:
            raise UserError("--images and --truth score folders of pictures; leave the workspace and --compare out")
        for path in (self.images, self.truth):
            if not path.exists():
                raise UserError(f"{path}: no such folder; name a folder of pictures, or a video")

    def _score_images(self, images: Path, truth: Path) -> None:
        from mien.evaluation.image_folders import ImageFolders, score_folders, write_scores
        from mien.evaluation.scoring import ScoreSettings
        from mien.evaluation.words import scores_lines

        folders = ImageFolders(images, truth, self.mattes, self.crops, self.background)
        scores = score_folders(folders, ScoreSettings(self.perceptual, self.perceptual_frames))
        if self.out is not None:
            write_scores(self.out, scores)
        if self.as_json:
            _print_json(scores)
        else:
            show("\n".join(scores_lines(scores)))


def _print_json(content: dict[str, Any]) -> None:
    show(json.dumps(content, indent=1))
