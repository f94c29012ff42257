"""`mien export`: an avatar is written in a format. Whole avatars that come from a file are written without torch."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from mien import runtime
from mien.errors import UserError
from mien.formats.format import Content, Format, NoOptions
from mien.formats.registry import format_of, numbered
from mien.machine.progress import say
from mien.runtime.baked import PortableAvatar

if TYPE_CHECKING:
    import mien.avatar.avatar
    import mien.face.params
    import mien.formats.glb
    import mien.gaussians


def export(content: Content, out: Path, kind: Format, options: NoOptions) -> None:
    """Write an avatar in a format, and tell of it. A motion is numbered files if a file holds one pose."""
    frames = content.poses() if kind.holds == "pose" else None
    if frames is None:
        first, *notes = kind.write(out, content, options).splitlines()
        for line in (f"{out}: {first}", *notes):
            say(line)
        return
    written = []
    for index, frame in enumerate(frames[0]):
        written.append(numbered(out, index))
        kind.write(written[-1], frame, options)
    say(f"{written[0]} ... {written[-1].name}: {len(written)} files")


_ONLY_RUNS = "a file does not have all that this format needs; export its workspace"


class FileContent(Content):
    """An avatar that comes from a file, at rest, as `mien.formats.Content`."""

    def __init__(self, source: Path):
        """Read the file."""
        kind = format_of(source)
        assert kind is not None
        assert kind.read is not None
        self._avatar = kind.read(source)

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return len(self._posed())

    def portable(self, confidence: bool = True, soft_cut: bool = False) -> PortableAvatar:
        """Return the avatar as it was read."""
        return self._avatar

    def pose(self) -> "mien.gaussians.Gaussians":
        """Return the Gaussians. This needs torch."""
        import torch

        from mien.formats.shared.splats import gaussians_of
        from mien.formats.shared.world_space import in_world

        posed = self._posed()
        pose = None if posed.T_world_local is None else torch.from_numpy(posed.T_world_local)
        still = gaussians_of((posed.means, posed.quats, posed.scales, posed.opacities, posed.sh))
        return in_world(replace(still, T_world_local=pose))

    def poses(self) -> None:
        """A file has no motion."""

    def motion(self) -> None:
        """A file has no motion."""

    def mesh(self) -> "mien.formats.glb.MeshModel":
        """Refused."""
        raise UserError(_ONLY_RUNS)

    def trained(self) -> "tuple[mien.avatar.avatar.Avatar, mien.face.params.FaceParams]":
        """Refused."""
        raise UserError(_ONLY_RUNS)

    def _posed(self) -> runtime.Gaussians:
        """The Gaussians with the head at the origin."""
        return runtime.Avatar(self._avatar).pose(head_rotation=(0, 0, 0), head_translation=(0, 0, 0))
