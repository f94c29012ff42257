"""The list of datasets. A new one is one file in this folder and one line here (CONTRIBUTING.md, "Add a dataset").

Other packages add datasets by entry points of the group `mien.datasets`.
"""

from pathlib import Path

from mien.datasets.dataset import Dataset
from mien.datasets.gaussian_avatars import GAUSSIAN_AVATARS
from mien.datasets.imavatar import IMAVATAR
from mien.datasets.insta import INSTA
from mien.datasets.live_link_face_take import LIVE_LINK_FACE
from mien.datasets.nerf_blendshape import NERF_BLENDSHAPE
from mien.datasets.nerface import NERFACE
from mien.datasets.nersemble import NERSEMBLE
from mien.datasets.nersemble_benchmark import NERSEMBLE_BENCHMARK
from mien.datasets.vhap import VHAP
from mien.disk.reading import listed
from mien.errors import UserError
from mien.plugins import plugin, warn, with_plugins

_OWN = (
    GAUSSIAN_AVATARS, VHAP, NERSEMBLE, NERSEMBLE_BENCHMARK, INSTA, IMAVATAR, NERFACE, NERF_BLENDSHAPE, LIVE_LINK_FACE,
)  # fmt: skip
_MAX_NAMED, _MAX_FOLDERS = 5, 1000  # most people that a message names, and most folders that are searched for people
_GROUP = "mien.datasets"  # group of entry points of other packages


def datasets() -> list[Dataset]:
    """Return all datasets: mien's own first, then those of other packages.

    A dataset is left out, with a warning, if it cannot be imported, or has the name of one before it.
    """
    return with_plugins(_GROUP, Dataset, _OWN, lambda each: (each.name,))


def find_dataset(name: str) -> Dataset:
    """Return a dataset by its name."""
    if all(each.name != name for each in _OWN):
        plugin(_GROUP, name, Dataset)
    found = next((each for each in datasets() if each.name == name), None)
    if found is None:
        raise UserError(f"--dataset {name}: there is no such dataset; choose one of {known_datasets()}")
    return found


def recognised(path: Path) -> tuple[Dataset, str]:
    """Return the dataset whose files are at a path, and what it found there."""
    found = [(each, told) for each in datasets() if (told := _told(each, path)) is not None]
    if not found:
        people = people_in(path)
        if people:
            told = (
                f"holds {len(people)} people ({', '.join(people[:_MAX_NAMED])}{', ...' * (len(people) > _MAX_NAMED)})"
            )
            raise UserError(f"{path}: {told}; import each into a workspace of its own, such as {path / people[0]}")
        raise UserError(f"{path}: is no dataset that mien knows; give one of {known_datasets()}")
    if len(found) > 1:
        names = " and ".join(each.name for each, _ in found)
        raise UserError(f"{path}: is recognised as {names}; choose one with --dataset NAME")
    return found[0]


def people_in(path: Path) -> list[str]:
    """The names of folders inside a folder that are each a dataset of one person."""
    try:
        inside = [each for each in listed(path) if each.is_dir()]
    except OSError:
        return []
    return [each.name for each in inside[:_MAX_FOLDERS] if is_dataset(each)]


def is_dataset(path: Path) -> bool:
    """Whether a path has the files of a dataset."""
    return any(_told(one, path) is not None for one in datasets())


def _told(dataset: Dataset, path: Path) -> str | None:
    """Return what a dataset finds at a path. One of another package that raises finds nothing, and is named."""
    if dataset in _OWN:
        return dataset.recognises(path)
    try:
        return dataset.recognises(path)
    except Exception as error:  # whatever the code of another package raises
        warn(f"{path}: the dataset {dataset.name!r} fails ({error!r}); update or uninstall its package")
        return None


def known_datasets() -> str:
    """Return the names of all datasets, each with what its files are, for messages."""
    return ", ".join(f"{each.name} ({each.about})" for each in datasets())
