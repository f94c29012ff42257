"""A layout: how a tracked capture is written as the files of another laboratory. A new one is a file here and a line.

This file needs no torch, because the command line lists the layouts and checks options against them.
"""

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from mien.errors import UserError

if TYPE_CHECKING:
    from mien.datasets.layouts.filmed import Filmed

MatteKind = Literal["head", "person"]
"""Mattes that are written: the head above mien's cut at the neck, which mien trains on and scores, or the person."""


@dataclass(frozen=True)
class Written:
    """The report of a writer on the files that it wrote."""

    names: "dict[tuple[int, int], str]"
    """Name of the held-out pictures in the layout, without their ending, by timestep and camera."""
    told: tuple[str, ...]
    """Sentences for README.txt that say what the files hold and what is lost."""


@dataclass(frozen=True)
class Layout:
    """A layout of files. Its writer is the function `write` of the file with its name, in underscores."""

    name: str
    """Name for `mien export-dataset --format`."""
    about: str
    """The programs that read it, in a few words."""
    one_camera: bool = True
    """Whether it holds one camera only."""
    needs_flame: bool = False
    """Whether its programs pose FLAME themselves, so that no other face model helps them."""

    def write(self, folder: Path, filmed: "Filmed") -> Written:
        """Write a capture into a new folder."""
        return import_module(f"mien.datasets.layouts.{self.name.replace('-', '_')}").write(folder, filmed)


def check_new_folder(folder: Path) -> None:
    """Check that a folder can be made, and that nothing is in it."""
    from mien.disk.files import check_writable

    check_writable(folder, folder=True)
    if folder.exists() and any(folder.iterdir()):
        raise UserError(f"{folder}: is not empty, and a capture is written into a new folder; give another --out")


LAYOUTS = (
    Layout("insta", "INSTA, GaussianBlendshapes and RGBAvatar"),
    Layout("imavatar", "IMavatar, PointAvatar, MonoGaussianAvatar and SplattingAvatar", needs_flame=True),
    Layout("nerface", "NeRFace"),
    Layout("nerf-blendshape", "NeRFBlendShape"),
    Layout("avatar-mav", "AvatarMAV"),
    Layout("nersemble", "the NeRSemble benchmark (version 2)", one_camera=False),
)


def find_layout(name: str | None) -> Layout | None:
    """Return a layout by its name; None if there is none."""
    return next((each for each in LAYOUTS if each.name == name), None)
