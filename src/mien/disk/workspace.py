"""Paths on disk: a workspace is a folder for one subject, with `sequences/NAME/` and `runs/NAME/` in it."""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mien.disk.reading import check_subtrees, inside
from mien.errors import UserError

COMPARED = "compare-"
"""First letters of the names of runs that `mien bench compare` makes."""
_FOLDERS = ("sequences", "runs")


@dataclass(frozen=True)
class Workspace:
    """The folders `root/sequences/NAME/{capture,tracking,scoring}/` and `root/runs/NAME/`."""

    root: Path

    def sequence_dir(self, name: str) -> Path:
        """The folder of a sequence."""
        return inside(self.root / "sequences", name)

    def run_dir(self, name: str) -> Path:
        """The folder of a training run."""
        return inside(self.root / "runs", name)

    def sequence_names(self) -> list[str]:
        """Names of the sequences that were captured, sorted."""
        return sorted(p.parent.parent.name for p in self.root.glob("sequences/*/capture/capture.json"))

    def tracked_names(self) -> list[str]:
        """Names of the sequences that were tracked, sorted."""
        return [
            name for name in self.sequence_names() if (self.sequence_dir(name) / "tracking/tracking.json").is_file()
        ]

    def pick_tracked(self, names: Sequence[str], held_out: Sequence[str]) -> list[str]:
        """All tracked sequences, or, if names are given, these and the held-out ones."""
        if names:
            return [self.pick_sequence(name) for name in dict.fromkeys((*names, *held_out))]
        tracked = self.tracked_names()
        if not tracked:
            raise UserError(f"{self.root}: no tracked sequences; run `mien track {self.root}`")
        return tracked

    def run_names(self) -> list[str]:
        """Names of the runs, sorted."""
        return sorted(p.parent.name for p in self.root.glob("runs/*/config.json"))

    def pick_sequence(self, name: str | None) -> str:
        """`name`, or the only sequence if no name is given."""
        return _pick("sequence", name, self.sequence_names(), self.root, "--sequence")

    def pick_run(self, name: str | None) -> str:
        """`name`, or the only run if no name is given.

        Runs without an avatar then count only if no run has one, and those of `mien bench compare` only if there is no
        other.
        """
        names = self.run_names()
        trained = [run for run in names if (self.run_dir(run) / "avatar").is_dir()]
        if name is None:
            names = trained or names
            names = [run for run in names if not run.startswith(COMPARED)] or names
        return _pick("run", name, names, self.root, "--run")


def is_workspace(folder: Path) -> bool:
    """Whether a folder holds captures or runs."""
    return any((folder / name).is_dir() for name in _FOLDERS)


def check_no_workspace(folder: Path) -> None:
    """Check that a folder of which pictures or videos are wanted is no workspace, whose films show an avatar."""
    if is_workspace(folder):
        raise UserError(
            f"{folder}: is a workspace, and not a folder of pictures or videos; give the video that it was made from, "
            f"or train on its captures: {shlex.join(['mien', 'train', str(folder)])}"
        )


def open_workspace(root: Path) -> Workspace:
    """Open an existing workspace, and check that nothing in it leads out of it."""
    workspace = Workspace(root)
    if root.is_file():
        raise UserError(f"{root}: is a file; give the folder of a workspace (`mien create` makes one from a video)")
    if not root.is_dir():
        raise UserError(
            f"{root}: no such folder; make a workspace with `mien create VIDEO --out {shlex.quote(str(root))}`"
        )
    check_subtrees(root, *_FOLDERS)
    if not workspace.sequence_names() and not workspace.run_names():
        from mien.disk.locks import AGAIN, check_free  # imports numpy

        # Another process may be making the first sequence at this moment.
        for file in sorted(root.glob("sequences/.*.lock")):
            check_free(workspace.sequence_dir(file.name[1:].removesuffix(".lock")), AGAIN)
        told = f"{root}: is not a mien workspace (no sequences/NAME/capture, no runs/NAME)"
        whole = root.resolve()
        bare = sorted(path.name for path in root.glob("sequences/[!.]*") if path.is_dir())
        if bare:
            raise UserError(
                f"{root}: the capture of {', '.join(bare)} is missing; make it again from its video: "
                f"{shlex.join(['mien', 'capture', 'VIDEO', '--out', str(root), '--name', bare[0]])}"
            )
        if whole.parent.name == "runs" and whole.name in Workspace(whole.parent.parent).run_names():
            typed = root.parent.parent if len(root.parts) > 2 else whole.parent.parent
            raise UserError(f"{told}; did you mean {shlex.join([str(typed), '--run', whole.name])}?")
        raise UserError(f"{told}; see `mien create --help`")
    return workspace


def check_new_workspace(root: Path) -> None:
    """Check that a workspace can be made or continued here."""
    from mien.disk.files import check_writable  # imports numpy

    check_writable(root, folder=True)
    check_subtrees(root, *_FOLDERS)
    whole = root.resolve()
    for folder in (whole, *whole.parents):
        outer = Workspace(folder.parent)
        if folder.name in _FOLDERS and (outer.sequence_names() or outer.run_names()):
            raise UserError(f"{root}: is inside the workspace {folder.parent}; give that folder, or one beside it")


def _pick(kind: str, name: str | None, names: list[str], root: Path, option: str) -> str:
    if name is None and len(names) == 1:
        return names[0]
    if not names:
        remedy = {"sequence": "mien create VIDEO --out", "run": "mien train"}[kind]
        raise UserError(f"{root}: there is no {kind} yet; make one with `{remedy} {shlex.quote(str(root))}`")
    listed = ", ".join(names)
    if name is None:
        raise UserError(f"{root}: has several {kind}s ({listed}); choose one with {option} NAME")
    if name not in names:
        raise UserError(f"{root}: no {kind} {name!r}; there are: {listed}")
    return name
