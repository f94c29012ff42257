"""`mien analyze`: the figures of a method's paper, measured on a run."""

import json
from dataclasses import dataclass, field
from inspect import cleandoc
from pathlib import Path
from typing import Annotated

import tyro

from mien.disk.reading import check_subtrees
from mien.disk.workspace import Workspace, open_workspace
from mien.errors import UserError
from mien.lab.analysis.registry import ANALYSES, Analysis, AnalysisOptions, chosen_parts
from mien.machine.devices import check_device
from mien.machine.progress import say
from mien.machine.terminal import show


def _about_target() -> str:
    return (
        f"Workspace folder, or several, whose figures are then also joined to statistics over subjects. The method of "
        f"their runs ({', '.join(ANALYSES)}) may stand before them."
    )


@dataclass(frozen=True)
class Command:
    """Measure on a run what the paper of its method measures, and show it beside the paper's figures.

    Writes analysis.html (one page), analysis.json, a .svg for each chart and a .png for each picture, and of several
    workspaces joined.md and joined.json. A stopped command continues, and what is measured is not measured again.
    """

    target: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="DIR [DIR ...]"), _about_target]
    run_name: Annotated[str | None, tyro.conf.arg(name="run")] = None
    """Name of the run (default: the only one)."""
    parts: tuple[str, ...] = ()
    """Parts to measure (default: all that need no training)."""
    train: bool = False
    """Also measure the parts that need short trainings. A message says beforehand how long they take."""
    options: Annotated[AnalysisOptions, tyro.conf.arg(name="")] = field(default_factory=AnalysisOptions)
    out: Path | None = None
    """Folder for the result and the short trainings (default: analysis/RUN in the workspace). Several workspaces have
    folders of their names in it (default: joined.md is in analysis of the first)."""
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Print the content of analysis.json on standard output, for programs."""

    def check(self) -> None:
        """Check options and paths without heavy libraries."""
        from mien.disk.files import check_writable

        self.options.check()
        check_device(self.options.device)
        workspaces = self._workspaces()
        chosen_parts(self._analysis(workspaces[0]), self.parts, self.train)
        for workspace in workspaces:
            check_subtrees(workspace.root, "analysis")
            check_writable(self._folder(workspace, workspace.pick_run(self.run_name)), folder=True)

    def run(self) -> None:
        """Measure the parts and write the page."""
        from mien.lab.analysis.joining import join_analyses
        from mien.lab.analysis.running import run_analysis
        from mien.pipeline.evaluate import run_sequences

        workspaces, contents = self._workspaces(), {}
        analysis = self._analysis(workspaces[0])
        parts, content = chosen_parts(analysis, self.parts, self.train), {}
        for workspace in workspaces:
            run_dir = workspace.run_dir(run := workspace.pick_run(self.run_name))
            folder, sequences = self._folder(workspace, run), run_sequences(workspace, run_dir)
            content = run_analysis(analysis, parts, run_dir, sequences, folder, self.options)
            contents[workspace.root.resolve().name] = content
            left = [part.name for part in analysis.parts if part.trains and part.name not in content["parts"]]
            if left:
                say(f"not measured, because they train: {', '.join(left)} (--train, or --parts)")
            say(f"Look at {folder / 'analysis.html'}")
        if len(workspaces) > 1:
            folder = self.out or workspaces[0].root / "analysis"
            content = join_analyses(analysis, contents, folder)
            say(f"Look at {folder / 'joined.md'}")
        if self.as_json:
            show(json.dumps(content, indent=1))

    def _workspaces(self) -> list[Workspace]:
        folders = self.target[self._is_named() :]
        if 1 < len(self.target) == len(folders) and not Path(folders[0]).exists():
            raise UserError(f"{self.target[0]}: has no analysis; choose one of {', '.join(ANALYSES)}, or leave it out")
        workspaces = [open_workspace(Path(each)) for each in folders]
        names = [each.root.resolve().name for each in workspaces]
        if not names:
            raise UserError("analyze takes a workspace, or several; give a folder")
        if len({*names}) < len(names):
            raise UserError(f"{max(names, key=names.count)}: two workspaces have this name; rename a folder")
        return workspaces

    def _analysis(self, workspace: Workspace) -> Analysis:
        """The analysis of the method that is named, or of the first run's method."""
        if self._is_named():
            return ANALYSES[self.target[0]]
        from mien.training.run import read_run_config

        run = workspace.pick_run(self.run_name)
        method = read_run_config(workspace.run_dir(run))["method"]["kind"].replace("_", "-")
        if method not in ANALYSES:
            raise UserError(f"{run}: its method, {method}, has no analysis; there are {', '.join(ANALYSES)}")
        return ANALYSES[method]

    def _folder(self, workspace: Workspace, run: str) -> Path:
        if self.out is None:
            return workspace.root / "analysis" / run
        several = len(self.target) - self._is_named() > 1
        return self.out / workspace.root.resolve().name if several else self.out

    def _is_named(self) -> bool:
        """Whether the method is named before the workspaces."""
        return len(self.target) > 1 and self.target[0] in ANALYSES


# The help names the parts of every analysis, which only the analyses know.
_PARTS = (f"Parts of {name}: {analysis.about_parts}." for name, analysis in ANALYSES.items())
Command.__doc__ = "\n\n".join((cleandoc(str(Command.__doc__)), *_PARTS))
