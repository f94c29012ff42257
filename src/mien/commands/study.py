"""Let people judge runs blind, beside the truth."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from mien.disk.reading import check_subtrees
from mien.disk.workspace import Workspace, open_workspace
from mien.errors import UserError
from mien.lab.analysis.study.files import (
    MOST_RUNS,
    TALLY,
    VERSION,
    StudySettings,
    key_path,
    read_all_answers,
    read_key,
    tally_content,
    tally_text,
)
from mien.machine.terminal import show


@dataclass(frozen=True)
class Make:
    """Write the page of a study: clips of held-out frames, runs beside the truth in random order and without names.

    The page is one file that makes no request. Send it to participants; each saves a small json file with the answers
    and sends it back. The key, which says which run is which, is beside the page: keep it.
    """

    workspaces: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="DIR [DIR ...]")]
    """Workspace folders. All need runs of the same names."""
    out: Path
    """File for the page, .html. The key is beside it: NAME.key.json."""
    runs: tuple[str, ...] = ()
    """Names of the runs to compare, 2 to 8 (default: those that all workspaces have)."""
    settings: Annotated[StudySettings, tyro.conf.arg(name="")] = field(default_factory=StudySettings)

    def check(self) -> None:
        """Check options and paths without heavy libraries."""
        from mien.disk.files import check_writable

        self.settings.check()
        if self.out.suffix.lower() != ".html":
            raise UserError(f"--out {self.out}: give a file that ends in .html")
        check_writable(self.out)
        opened = [open_workspace(folder) for folder in self.workspaces]
        roots = [workspace.root.resolve() for workspace in opened]
        if len({*roots}) < len(roots):
            raise UserError(f"{max(roots, key=roots.count)}: is given twice; give each workspace once")
        for workspace in opened:
            check_subtrees(workspace.root, "runs", "sequences")
        self._labels(opened)

    def run(self) -> None:
        """Write the page and the key."""
        from mien.lab.analysis.study.making import StudyRuns, write_study
        from mien.machine.progress import say
        from mien.pipeline.evaluate import run_sequences

        opened, runs = [open_workspace(folder) for folder in self.workspaces], []
        labels = self._labels(opened)
        for one in opened:
            folders = {label: one.run_dir(label) for label in labels}
            sequences = {label: (folder, tuple(run_sequences(one, folder))) for label, folder in folders.items()}
            runs.append(StudyRuns(one.root.resolve().name, sequences))
        write_study(self.out, runs, self.settings)
        key = key_path(self.out)
        say(f"Look at {self.out} and send it; keep {key}, then: mien study tally {key} ANSWERS.json ...")

    def _labels(self, workspaces: list[Workspace]) -> list[str]:
        """The names of the runs: those asked for, or those that all workspaces have."""
        if self.runs:
            for workspace in workspaces:
                for name in self.runs:
                    workspace.pick_run(name)
        trained = [
            [name for name in one.run_names() if (one.run_dir(name) / "training.json").is_file()] for one in workspaces
        ]
        every = [name for name in trained[0] if all(name in names for names in trained)]
        labels = list(dict.fromkeys(self.runs)) or every
        if not 2 <= len(labels) <= MOST_RUNS:
            listed = ", ".join(labels) or "none"
            raise UserError(f"--runs: a study compares 2 to {MOST_RUNS} runs, here {listed}; name them with --runs")
        return labels


@dataclass(frozen=True)
class Tally:
    """Count answers: for each run the percentage of judgements that prefer it, with 95 % confidence intervals."""

    key: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="KEY.json")]
    """The key that `mien study make` wrote beside the page."""
    answers: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="ANSWERS [ANSWERS ...]")]
    """Files that participants saved, or folders of them."""
    out: Path | None = None
    """File for the result as json (default: only printed)."""
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Print the result as json on standard output, for programs."""

    def check(self) -> None:
        """Read the key and all answers, and check that the result can be written, without heavy libraries."""
        from mien.disk.files import check_writable

        if not self.key.is_file():
            raise UserError(f"{self.key}: no such file; give the key that `mien study make` wrote beside the page")
        if not self.answers:
            raise UserError("no answers to tally; give the files that participants saved, or a folder of them")
        if self.out is not None:
            check_writable(self.out)
        read_all_answers(self.answers, read_key(self.key))

    def run(self) -> None:
        """Print the percentages."""
        from mien.disk.files import write_json

        key = read_key(self.key)
        content = tally_content(key, read_all_answers(self.answers, key))
        if self.out is not None:
            write_json(self.out, TALLY, VERSION, content)
        if self.as_json:
            show(json.dumps({"format": TALLY, "version": VERSION, **content}, indent=1))
        else:
            show(tally_text(content))


TASKS = {"make": Make, "tally": Tally}
