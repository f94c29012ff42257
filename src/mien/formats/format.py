"""What a format is: the files that it writes, what they hold, and the content that they are made of.

This file needs no torch, because the command line lists the formats and checks options against them.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from mien.errors import UserError

if TYPE_CHECKING:
    # By their full names: several rooms have a class of the same name, and the reference tells them apart so.
    import mien.avatar.avatar
    import mien.face.params
    import mien.formats.glb
    import mien.formats.shared.packed
    import mien.gaussians
    import mien.runtime.baked

Holds = Literal["pose", "sequence", "avatar", "folder"]
"""What a file of a format holds: Gaussians in one pose, or in many, a whole avatar, or a folder with a whole run."""


class Content(ABC):
    """An avatar that is written. A format asks for what it holds, and nothing else is computed."""

    @property
    @abstractmethod
    def count(self) -> int:
        """Number of Gaussians."""

    @abstractmethod
    def portable(self, confidence: bool = True, soft_cut: bool = False) -> "mien.runtime.baked.PortableAvatar":
        """Return the whole avatar.

        `confidence` asks for what was filmed of each triangle, if that is known, and `soft_cut` for a head that fades
        towards its neck cut.
        """

    @abstractmethod
    def pose(self) -> "mien.gaussians.Gaussians":
        """Return the Gaussians with the expression that was asked for: the head at the origin, +y up, +z ahead."""

    @abstractmethod
    def poses(self) -> "tuple[Iterator[Content], float] | None":
        """Return the content in the pose of each frame of the motion, and frames per second; None without a motion."""

    @abstractmethod
    def motion(self) -> "mien.formats.shared.packed.Motion | None":
        """Return the motion that was asked for, as face parameters with head poses; None without one."""

    @abstractmethod
    def mesh(self) -> "mien.formats.glb.MeshModel":
        """Return the person's mesh with its texture coordinates, which only a run has."""

    @abstractmethod
    def trained(self) -> "tuple[mien.avatar.avatar.Avatar, mien.face.params.FaceParams]":
        """Return the trained avatar, and the person at all timesteps of its training, which only a run has."""


@dataclass(frozen=True)
class NoOptions:
    """Options of a format: nothing can be chosen. Formats with options have a class of their own beside the writer."""


@dataclass(frozen=True)
class MotionOptions(NoOptions):
    """Options of formats that hold a motion. The fields are options of `mien export`, with these descriptions."""

    series: str | None = None
    """A motion: the name of a sequence of the workspace, or anything that `mien drive --by` takes. A page plays it. For
    Gaussians in a pose, every frame becomes a file, or a time sample of the file; the head stays at the origin."""
    neutral: str | None = None
    """With --series, the driver's face at rest, as for `mien drive`: first, calm, model, or a video, recording,
    workspace or sequence folder of the driver at rest."""
    every: int = 1
    """With --series, take only every n-th frame."""


@dataclass(frozen=True)
class PoseOptions(MotionOptions):
    """Options of formats that hold Gaussians in a pose."""

    set: tuple[str, ...] = ()
    """Expressions and whole faces by name, and joint angles in radians, for example --set smile=0.6 jawOpen=0.3
    eyeLookUpLeft=0.5 left_eye_y=0.2 (default: the person's neutral). An unknown name lists all of them."""


@dataclass(frozen=True)
class SplatOptions(PoseOptions):
    """Options of files whose usual viewers take +y for down."""

    y_down: bool = False
    """Turn the head by half a turn about x, for viewers that take +y for down and would show it upside down."""

    def pose(self, content: Content) -> "mien.gaussians.Gaussians":
        """Return the Gaussians as they are written."""
        from mien.formats.shared.world_space import with_y_down

        return with_y_down(content.pose()) if self.y_down else content.pose()


def check_options(path: Path, options: NoOptions) -> None:
    """Check that there is a motion if something is said of it."""
    if isinstance(options, MotionOptions):
        if options.every < 1:
            raise UserError(f"--every {options.every}: give 1 or more")
        if options.series is None and (options.every > 1 or options.neutral is not None):
            raise UserError(f"{path}: --every and --neutral are for a motion; name it with --series, or leave them out")


@dataclass(frozen=True)
class Format:
    """A format of files.

    `write(path, content, options)` writes a file (a folder, if it holds one) and returns what is told of it, in one
    line or more. It replaces an earlier file in one step, and raises UserError in one line that names the path.
    """

    name: str
    """Name for `mien export --format`."""
    holds: Holds
    write: Callable[[Path, Content, Any], str]
    endings: tuple[str, ...] = ()
    """Endings of the files, in lower case with the dot. Only folders have none."""
    read: "Callable[[Path], mien.runtime.baked.PortableAvatar] | None" = None
    """Function that reads the whole avatar in a file. It raises UserError in one line that names the path."""
    options: Callable[[], NoOptions] = PoseOptions
    """Class of the options. The command line has an option for each of its fields."""
    check: Callable[[Path, Any], None] = check_options
    """Checks the options before any work, and that the packages which write the file are installed."""


def pose_words(path: Path, content: Content) -> str:
    """Return what a file holds that has Gaussians in one pose and nothing to move them by."""
    return f"{content.count:,} Gaussians in one pose, {path.stat().st_size / 1e6:.1f} MB"
