"""`mien import`: datasets and avatars of other programs."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mien.datasets.dataset import Dataset, Findings
from mien.datasets.registry import find_dataset, known_datasets, recognised
from mien.disk.workspace import Workspace, check_new_workspace
from mien.errors import UserError
from mien.machine.progress import say
from mien.pipeline.names import check_new_run, check_new_sequence, run_name


def _about_path() -> str:
    return f"The files of a dataset: {known_datasets()}."


@dataclass(frozen=True)
class Command:
    """Read the files of another program, and write its avatar as a run, or its sequences with their tracking."""

    path: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PATH"), _about_path]
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Workspace folder to put the run or the sequences into. It is made if it is missing."""
    name: Annotated[str | None, tyro.conf.arg(name="run")] = None
    """Name of the run that an avatar becomes (default: the name of the dataset)."""
    dataset: str | None = None
    """Name of the dataset (default: it is recognised by its files)."""
    face_model: str | None = None
    """The face model that the files belong to: its name among your face models, or a .npz or .pkl in FLAME's schema
    (added at its first use). It is not needed for folders that `mien export` wrote with the face model inside."""
    dry_run: bool = False
    """Only say what was found: sequences, frames, cameras, face model, split, and what is missing."""
    retrack: bool = False
    """Leave out the tracking of the dataset's authors, and track the pictures with mien's own model instead."""
    color_correction: bool = True
    """By default, the colours of cameras are corrected if the dataset says how. --no-color-correction leaves them as
    filmed."""

    resume: bool = False
    """Leave sequences that are there already as they are, and read the others, as after a stop."""

    def check(self) -> None:
        """Check options and paths without heavy libraries."""
        if not self.path.exists():
            raise UserError(f"{self.path}: no such file or folder; give one of {known_datasets()}")
        dataset, _ = self._found()
        if self.retrack and dataset.read_pictures is None:
            raise UserError(f"--retrack: {dataset.name} has no pictures that could be tracked; leave --retrack out")
        if self.retrack and self.face_model is not None:
            raise UserError("--retrack and --face-model: the pictures are tracked with mien's own model; give only one")
        if not self.dry_run:
            check_new_workspace(self.out)
        run = run_name(self._run(dataset))
        if dataset.holds == "avatar":
            if not self.dry_run:
                check_new_run(Workspace(self.out).run_dir(run))
        elif self.name is not None:
            raise UserError(f"--run {self.name}: {dataset.name} holds sequences, which are no run; leave --run out")

    def run(self) -> None:
        """Read the files and write what they hold."""
        dataset, told = self._found()
        try:
            self._read(dataset, told)
        except UserError as error:
            if type(error) is not UserError or self.dataset is None or dataset.recognises(self.path) is not None:
                raise
            try:
                other = recognised(self.path)[0].name
            except UserError:
                raise error from None
            raise UserError(
                f"{self.path}: looks like {other}, and cannot be read as {dataset.name}; leave --dataset out ({error})"
            ) from None

    def _read(self, dataset: Dataset, told: str | None) -> None:
        from mien.pipeline.import_dataset import findings_lines, run_import_stage

        if told is not None and (self.dry_run or dataset.holds == "sequences"):
            say(f"{self.path}: {told}")  # before they are read, which takes long
        if dataset.survey is not None:
            findings = dataset.survey(self.path)
            given = self.face_model is not None or not self.dry_run
            for line in findings_lines(findings, given, self.color_correction):
                say(line)
            if not self.dry_run and self._is_there(findings):
                say(f"{self.out}: all sequences are there already")
                return
        if not self.dry_run:
            run_import_stage(
                dataset, self.path, Workspace(self.out), self._run(dataset), self.face_model, self.retrack, self.resume,
                self.color_correction,
            )  # fmt: skip

    def _is_there(self, findings: Findings) -> bool:
        """Whether there is nothing to do. Without --resume, no sequence may be there, which is checked first."""
        folders = [Workspace(self.out).sequence_dir(clip.name) for clip in findings.clips]
        if not self.resume:
            for folder in folders:
                check_new_sequence(folder)
        return not self.retrack and bool(folders) and all(folder.exists() for folder in folders)

    def _found(self) -> tuple[Dataset, str | None]:
        """The dataset, and what it found; None if the user names the dataset."""
        return recognised(self.path) if self.dataset is None else (find_dataset(self.dataset), None)

    def _run(self, dataset: Dataset) -> str:
        return dataset.name.replace("-", "_") if self.name is None else self.name
