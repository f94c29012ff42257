"""Finished pieces of tracking in a folder, from which interrupted tracking resumes. Each is a file, written whole."""

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from torch import Tensor

from mien.disk.files import read_tensors, write_tensors
from mien.disk.reading import remove_tree
from mien.errors import UserError
from mien.machine.progress import say

INTERVAL_SECONDS = 20.0  # least time between two versions of a piece that is replaced again and again


@dataclass(eq=False)
class StageCache:
    """Keeps pieces of a fit, which depend on their name and its input alone, in a folder, if there is one. Mutable."""

    folder: Path | None = None
    last: float = field(default_factory=time.monotonic)
    resumed: bool = False

    def get_or_compute(self, name: str, make: Callable[[], dict[str, Tensor]]) -> dict[str, Tensor]:
        """Return the piece of that name. If none is stored yet, `make` computes it and it is stored."""
        found = self.read(name)
        if found is not None:
            return found
        made = _as_read(make())
        self.write(name, made)
        return made

    def offer(self, name: str, make: Callable[[], dict[str, Tensor]]) -> None:
        """Replace the kept piece by a newer version, unless that was done less than 20 seconds ago."""
        if self.folder is not None and time.monotonic() - self.last >= INTERVAL_SECONDS:
            self.write(name, make())
            self.last = time.monotonic()

    def read(self, name: str) -> dict[str, Tensor] | None:
        """The kept piece, or None if there is none, or it cannot be read, or holds numbers that are not finite."""
        path = self._path(name)
        if path is None or not path.is_file():
            return None
        tensors: dict[str, Tensor] = {}
        with suppress(UserError):
            tensors = read_tensors(path)
        if not tensors or not all(bool(tensor.isfinite().all()) for tensor in tensors.values()):
            say(f"{path.name}: is damaged, so this part of tracking runs again")
            return None
        if not self.resumed:
            say("Tracking continues where it was interrupted")
            self.resumed = True
        return _as_read(tensors)

    def drop(self, beginning: str) -> None:
        """Remove the pieces with names that begin with `beginning`, once their result is kept."""
        if self.folder is not None:
            for path in self.folder.glob(f"{beginning}*.safetensors"):
                path.unlink(missing_ok=True)

    def forget(self) -> None:
        """Remove the whole folder, because the fit is done."""
        if self.folder is not None:
            remove_tree(self.folder)

    def _path(self, name: str) -> Path | None:
        return None if self.folder is None else self.folder / f"{name}.safetensors"

    def write(self, name: str, tensors: dict[str, Tensor]) -> None:
        """Write a piece, if there is a folder."""
        path = self._path(name)
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_tensors(path, tensors)


def _as_read(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Contiguous copies of tensors, whether made or read, because matrix products depend on the layout in memory."""
    return {name: tensor.detach().clone().contiguous() for name, tensor in tensors.items()}
