"""The .glb file: a mesh with morph targets and a skin, and the avatar itself (docs/glb.md)."""

from pathlib import Path

from mien import export
from mien.formats.format import Content, Format, Options

_WHOLE = "a .glb file has a morph target for every expression; leave --set and --series out"


def _write(path: Path, content: Content, options: Options) -> str:
    mesh = content.mesh()
    written = export.write_glb(path, content.portable(), mesh)
    return (
        f"a mesh with {len(written.targets)} morph targets and {len(mesh.rig.joint_names)} joints, "
        f"{content.count:,} Gaussians at rest, {written.size / 1e6:.1f} MB"
    )


GLB = Format(
    "glb",
    "avatar",
    _write,
    (".glb",),
    lambda path: export.read_glb_avatar(path),
    refusals={"set": _WHOLE, "series": _WHOLE},
    from_files=False,
)
