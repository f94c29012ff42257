"""`mien analyze`: the figures of a method's paper, measured on a run."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from mien.workspace import Workspace, open_workspace

AnalysisName = Literal["gaussian-avatars", "headgas", "mono-gaussian-avatar"]
"""The keys of `mien.lab.analysis.ANALYSES`, written out for options. A test compares them."""


@dataclass(frozen=True)
class Command:
    """Measure on a run what the paper of its method measures, and show it beside the paper's figures.

    Writes analysis.html (one page), analysis.json and a .png for each chart and picture. A stopped command continues
    where it was, and what is measured is not measured again.

    Parts of gaussian-avatars: growth (Gaussians and step time over training), speed (drawing at five sizes, and
    memory), teeth (with and without the Gaussians on teeth), teeth-trained and scale (two short trainings each: without
    the triangles of teeth, and without the threshold of the scale loss).

    Parts of headgas: basis (one expression at a time, beside the mesh), layers (Gaussians removed from near to far),
    beyond (an expression to 1.4 times its training maximum, and views beyond those of training), sizes (time of a frame
    against the size of the picture), ablations (a short training for each variant of the paper).

    Parts of mono-gaussian-avatar: times (of the training, and of a frame with networks and baked), convergence
    (held-out pictures during a short training), resolutions (short trainings at full and at half resolution), diversity
    (short trainings on all frames, on a frontal quarter and on a mixed half).
    """

    method: Annotated[AnalysisName, tyro.conf.Positional]
    """Method of the run."""
    workspace: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """Workspace folder."""
    run_name: Annotated[str | None, tyro.conf.arg(name="run")] = None
    """Name of the run (default: the only one)."""
    parts: tuple[str, ...] = ()
    """Parts to measure (default: all that need no training)."""
    train: bool = False
    """Also measure the parts that need short trainings. A message says beforehand how long they take."""
    steps: int = 3_000
    """Number of optimiser steps of each short training."""
    seconds: float = 2.0
    """Seconds to spend on each timed row."""
    out: Path | None = None
    """Folder for the result and the short trainings (default: analysis/RUN in the workspace)."""
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Print the content of analysis.json on standard output, for programs."""

    def check(self) -> None:
        """Check options and paths without heavy libraries."""
        from mien.files import check_writable
        from mien.inside import check_subtrees
        from mien.lab.analysis import ANALYSES, AnalysisOptions, chosen_parts

        AnalysisOptions(self.steps, self.seconds).check()
        chosen_parts(ANALYSES[self.method], self.parts, self.train)
        workspace = open_workspace(self.workspace)
        check_subtrees(workspace.root, "analysis")
        check_writable(self._folder(workspace, workspace.pick_run(self.run_name)), folder=True)

    def run(self) -> None:
        """Measure the parts and write the page."""
        import json

        from mien.commands.stages.evaluating import run_sequences
        from mien.lab.analysis import ANALYSES, AnalysisOptions, chosen_parts, run_analysis
        from mien.progress import say
        from mien.terminal import show

        workspace = open_workspace(self.workspace)
        run = workspace.pick_run(self.run_name)
        run_dir, folder = workspace.run_dir(run), self._folder(workspace, run)
        analysis = ANALYSES[self.method]
        parts = chosen_parts(analysis, self.parts, self.train)
        options = AnalysisOptions(self.steps, self.seconds)
        content = run_analysis(analysis, parts, run_dir, run_sequences(workspace, run_dir), folder, options)
        left = [part.name for part in analysis.parts if part.trainings and part.name not in content["parts"]]
        if left:
            say(f"not measured, because they train: {', '.join(left)} (--train, or --parts)")
        say(f"Look at {folder / 'analysis.html'}")
        if self.as_json:
            show(json.dumps(content, indent=1))

    def _folder(self, workspace: Workspace, run: str) -> Path:
        return self.out or workspace.root / "analysis" / run
