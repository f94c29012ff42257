"""The .glb file: a mesh with morph targets and a skin, and the avatar itself (docs/glb.md)."""

from pathlib import Path
from typing import TYPE_CHECKING

from mien.formats.format import Content, Format, Options

if TYPE_CHECKING:
    from mien.runtime import PortableAvatar

_WHOLE = "a .glb file has a morph target for every expression; leave --set and --series out"


def _write(path: Path, content: Content, options: Options) -> str:
    from mien.export import write_glb

    mesh = content.mesh()
    written = write_glb(path, content.portable(), mesh)
    return (
        f"a mesh with {len(written.targets)} morph targets and {len(mesh.rig.joint_names)} joints, "
        f"{content.count:,} Gaussians at rest, {written.size / 1e6:.1f} MB"
    )


def _read(path: Path) -> "PortableAvatar":
    from mien.export import read_glb_avatar

    return read_glb_avatar(path)


GLB = Format(
    "glb", "avatar", _write, (".glb",), _read, refusals={"set": _WHOLE, "series": _WHOLE}, from_files=False
)  # fmt: skip
