"""The content that `mien export` writes of an avatar in a file. Whole avatars are written without torch."""

from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from mien import runtime
from mien.errors import UserError
from mien.formats.format import Format, Options
from mien.formats.registry import format_of
from mien.machine.progress import say
from mien.runtime.baked import PortableAvatar

if TYPE_CHECKING:
    from mien.gaussians import Gaussians


class FileContent:
    """An avatar that comes from a file, as `mien.formats.Content`. It has no run and no mesh with a texture."""

    def __init__(self, source: Path):
        """Read the file."""
        kind = format_of(source)
        avatar = None if kind is None or kind.read is None else kind.read(source)
        if not isinstance(avatar, PortableAvatar):
            raise UserError(f"{source}: files of this format do not hold a whole avatar; give a .mien or a .glb file")
        self._source, self._avatar = source, avatar

    @property
    def name(self) -> str:
        """The avatar's name."""
        return self._avatar.about.name

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return len(self._posed())

    def portable(self, confidence: bool = True, soft_cut: bool = False) -> PortableAvatar:
        """Return the avatar as it was read."""
        return self._avatar

    def mesh(self) -> NoReturn:
        """Refuse: the texture coordinates are only in a run."""
        raise self._only_in_a_run()

    def pose(self) -> "Gaussians":
        """Return the Gaussians at rest. This needs torch."""
        import torch

        from mien.formats.shared.world_space import in_world
        from mien.gaussians import Gaussians

        posed = self._posed()
        arrays = (posed.means, posed.quats, posed.scales, posed.opacities, posed.sh)
        pose = None if posed.T_world_local is None else torch.from_numpy(posed.T_world_local.copy())
        return in_world(Gaussians(*(torch.from_numpy(array.copy()) for array in arrays), T_world_local=pose))

    def poses(self) -> None:
        """Return None: a file is exported at rest."""

    def motion(self) -> None:
        """Return None: a file is exported at rest."""

    def trained(self) -> NoReturn:
        """Refuse: what was trained is only in a run."""
        raise self._only_in_a_run()

    def _posed(self) -> runtime.Gaussians:
        """The Gaussians at rest, with the head at the origin."""
        return runtime.Avatar(self._avatar).pose(head_rotation=(0, 0, 0), head_translation=(0, 0, 0))

    def _only_in_a_run(self) -> UserError:
        return UserError(f"{self._source}: does not have all that this format needs; export it from its workspace")


def convert(source: Path, out: Path, kind: Format, options: Options) -> None:
    """Write the avatar in a file in another format, at rest with the head at the origin, and report it."""
    content = FileContent(source)
    told = kind.write(out, content, options)
    size = f"{out.stat().st_size / 1e6:.1f} MB" if options.largest is None else told
    say(f"{out}: {content.name!r} of {source}, {size}")
