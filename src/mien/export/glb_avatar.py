"""The extension MIEN_gaussian_avatar of glTF: the whole avatar in a .glb file (docs/glb.md).

It holds what a .mien file holds: the same header, and the same arrays, each in a buffer view of its own.
"""

from pathlib import Path
from typing import Any

import numpy as np

from mien.errors import UserError
from mien.formats.shared.glb_file import Glb, GlbWriter, read_glb
from mien.runtime.baked import PortableAvatar
from mien.runtime.file import from_arrays, to_arrays

EXTENSION, VERSION = "MIEN_gaussian_avatar", 1
_KINDS = {"float32": np.dtype("<f4"), "int32": np.dtype("<i4")}
_REMEDY = "write it again with `mien export DIR --out me.glb`"


def avatar_extension(path: Path, writer: GlbWriter, avatar: PortableAvatar) -> dict[str, Any]:
    """Add the arrays of an avatar to a file, and return the extension that refers to them."""
    header, arrays = to_arrays(path, avatar)
    tensors = {}
    for name, array in sorted(arrays.items()):
        kind = _KINDS[array.dtype.name]
        tensors[name] = {"dtype": array.dtype.name, "shape": list(array.shape)}
        if array.size:  # a buffer view has at least one byte
            tensors[name]["bufferView"] = writer.view(np.ascontiguousarray(array, kind).tobytes())
    return {"version": VERSION, "avatar": header, "tensors": tensors}


def read_glb_avatar(path: Path) -> PortableAvatar:
    """Read the avatar in a .glb file: equal to that of the .mien file, array by array."""
    glb = read_glb(path)
    extensions = glb.content.get("extensions")
    found = extensions.get(EXTENSION) if isinstance(extensions, dict) else None
    if not isinstance(found, dict):
        raise UserError(f"{path}: has no avatar of mien ({EXTENSION}); {_REMEDY}")
    if found.get("version") != VERSION:
        raise UserError(
            f"{path}: has version {found.get('version')!r:.80} of {EXTENSION}, expected {VERSION}; {_REMEDY}"
        )
    try:
        # Several arrays must not share a view, as a small file would otherwise fill the memory.
        views = [described["bufferView"] for described in found["tensors"].values() if "bufferView" in described]
        if sum(glb.content["bufferViews"][view]["byteLength"] for view in views) > len(glb.buffer):
            raise ValueError("its arrays are larger than its buffer")
        arrays = {name: _tensor(glb, described) for name, described in found["tensors"].items()}
        header = dict(found["avatar"])
        if "format" not in header:
            raise ValueError("its header has no format")
    except (ValueError, KeyError, TypeError, AttributeError, IndexError, OverflowError) as error:
        raise UserError(f"{path}: is damaged ({repr(error)[:100]}); {_REMEDY}") from None
    return from_arrays(path, header, arrays)


def _tensor(glb: Glb, described: dict[str, Any]) -> np.ndarray:
    shape, kind = described["shape"], _KINDS[described["dtype"]]
    if not isinstance(shape, list) or not all(type(size) is int and size >= 0 for size in shape):
        raise ValueError("a tensor's shape is wrong")
    data = glb.bytes_of(described["bufferView"]) if "bufferView" in described else b""
    return np.frombuffer(data, kind).reshape(shape).copy()
