"""The list of datasets. A new one is one file in this folder and one line here (CONTRIBUTING.md, "Add a dataset").

Other packages add datasets by entry points of the group `mien.datasets`.
"""

from pathlib import Path

from mien.datasets.dataset import Dataset
from mien.datasets.gaussian_avatars import GAUSSIAN_AVATARS
from mien.errors import UserError
from mien.plugins import with_plugins

_OWN = (GAUSSIAN_AVATARS,)


def datasets() -> list[Dataset]:
    """Return all datasets: mien's own first, then those of other packages.

    Raises:
        UserError: a dataset of another package cannot be imported, or has the name of one before it.
    """
    return with_plugins("mien.datasets", Dataset, _OWN, lambda each: (each.name,))


def find_dataset(name: str) -> Dataset:
    """Return a dataset by its name.

    Raises:
        UserError: there is none of this name.
    """
    found = next((each for each in datasets() if each.name == name), None)
    if found is None:
        raise UserError(f"--dataset {name}: there is no such dataset; choose one of {known_datasets()}")
    return found


def recognised(path: Path) -> tuple[Dataset, str]:
    """Return the dataset whose files are at a path, and what it found there.

    Raises:
        UserError: no dataset recognises the path, or several do.
    """
    found = [(each, told) for each in datasets() if (told := each.recognises(path)) is not None]
    if not found:
        raise UserError(f"{path}: is no dataset that mien knows; give one of {known_datasets()}")
    if len(found) > 1:
        names = " and ".join(each.name for each, _ in found)
        raise UserError(f"{path}: is recognised as {names}; choose one with --dataset NAME")
    return found[0]


def known_datasets() -> str:
    """Return the names of all datasets, each with what its files are, for messages."""
    return ", ".join(f"{each.name} ({each.about})" for each in datasets())
