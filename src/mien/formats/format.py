"""What a format is: the files that it writes, what they hold, and the content that they are made of.

This file needs no torch, because the command line lists the formats and checks options against them.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Protocol, runtime_checkable

if TYPE_CHECKING:
    # By their full names: several rooms have a class of the same name, and the reference tells them apart so.
    import mien.avatar.avatar
    import mien.face.params
    import mien.formats.glb
    import mien.formats.shared.packed
    import mien.formats.shared.webcam
    import mien.gaussians
    import mien.runtime.baked

Holds = Literal["pose", "sequence", "avatar", "folder"]
"""What a file of a format holds: Gaussians in one pose, or in many, a whole avatar, or a folder with a whole run."""


@runtime_checkable
class Content(Protocol):
    """An avatar that is written. A format asks for what it holds, and nothing else is computed."""

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        ...

    def portable(self, confidence: bool = True, soft_cut: bool = False) -> "mien.runtime.baked.PortableAvatar":
        """Return the whole avatar.

        `confidence` asks for what was filmed of each triangle, if that is known, and `soft_cut` for a head that fades
        towards its neck cut.
        """
        ...

    def mesh(self) -> "mien.formats.glb.MeshModel":
        """Return the person's mesh with its texture coordinates. Avatars that come from a file have none."""
        ...

    def pose(self) -> "mien.gaussians.Gaussians":
        """Return the Gaussians with the expression that was asked for.

        The head is at the origin, +y up, +z out of the face.
        """
        ...

    def poses(self) -> "tuple[Iterator[mien.gaussians.Gaussians], float] | None":
        """Return the Gaussians of every frame of the motion, as in `pose`, and frames per second; None without one."""
        ...

    def motion(self) -> "mien.formats.shared.packed.Motion | None":
        """Return the motion that was asked for, as face parameters with head poses."""
        ...

    def trained(self) -> "tuple[mien.avatar.avatar.Avatar, mien.face.params.FaceParams]":
        """Return the trained avatar, and the person at all timesteps of its training."""
        ...


@dataclass(frozen=True)
class Options:
    """Options that only some formats take. A format names those that it takes in `Format.options`."""

    sh: int | None = None
    """Degree of the spherical harmonics in the file."""
    webgpu: bool = False
    """Whether a page draws with WebGPU where the browser has it."""
    webcam: "mien.formats.shared.webcam.WebcamFiles | None" = None
    """Files of the face landmarker, with which a webcam drives a page."""
    spz_version: int = 4
    """Version of a .spz file."""
    title: str | None = None
    """Title of a page. None for the avatar's name."""
    address: str | None = None
    """Address at which a page will be published."""
    soft_cut: bool = True
    """Whether a head fades towards its neck cut."""
    microphone: bool = False
    """Whether the lips of a page follow a voice."""
    largest: float | None = None
    """Largest size of a page or a packed avatar, in MB. None for all Gaussians."""


def _no_check(path: Path) -> None:
    """Find nothing missing."""


@dataclass(frozen=True)
class Format:
    """A format of files.

    `write(path, content, options)` writes a file (a folder, if it holds one) and returns what is told of it, in one
    line or more. It replaces an earlier file in one step, and raises UserError in one line that names the path.
    """

    name: str
    """Name for `mien export --format`."""
    holds: Holds
    write: Callable[[Path, Content, Options], str]
    endings: tuple[str, ...] = ()
    """Endings of the files, in lower case with the dot. Only folders have none."""
    read: "Callable[[Path], mien.runtime.baked.PortableAvatar | mien.gaussians.Gaussians] | None" = None
    """Function that reads a file: a whole avatar, or Gaussians in one pose (the first of a sequence). It raises
    UserError in one line that names the path. None if files of this format are not read."""
    options: frozenset[str] = frozenset()
    """Names of the fields of `Options` that the format takes."""
    refusals: Mapping[str, str] = field(default_factory=dict)
    """Why options of `mien export` ("set", "series", "every") have no meaning for the format, each as a sentence."""
    from_files: bool = True
    """Whether an avatar that comes from a file can be written. False if the format asks for `mesh` or `trained`."""
    check: Callable[[Path], None] = _no_check
    """Function that raises UserError, before any work, if a package is missing."""

    @property
    def reads_avatars(self) -> bool:
        """Whether files of the format are read as whole avatars."""
        return self.read is not None and self.holds == "avatar"


def pose_words(path: Path, content: Content) -> str:
    """Return what a file holds that has Gaussians in one pose and nothing to move them by."""
    return f"{content.count:,} Gaussians in one pose, {path.stat().st_size / 1e6:.1f} MB"
