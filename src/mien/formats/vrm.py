"""The .vrm file: the mesh of the .glb, for programs that know avatars by VRM (docs/glb.md)."""

from pathlib import Path

from mien import export
from mien.formats.format import Content, Format, Options

_WHOLE = "a .vrm file has an expression for every name; leave --set and --series out"


def _write(path: Path, content: Content, options: Options) -> str:
    written = export.write_vrm(path, content.portable(), content.mesh())
    return f"a mesh with {len(written.targets)} expressions in VRM 1.0, {written.size / 1e6:.1f} MB"


VRM = Format("vrm", "avatar", _write, (".vrm",), refusals={"set": _WHOLE, "series": _WHOLE}, from_files=False)
