"""The .mien file: one safetensors file with metadata that gives its arrays their meaning (docs/avatar_file.md).

The metadata has one entry, `mien`, a json text: `format` = "mien.baked", `version`, `sha256` of content and arrays, and
`content`: the nested classes of `mien.runtime.baked`, each with its `kind`. Arrays are objects {"tensor": NAME}.
"""

import hashlib
import json
import struct
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import safetensors

from mien.disk.config import decode
from mien.disk.files import check_writable, read_safetensors, write_arrays
from mien.disk.reading import expect_whole, parse_json
from mien.errors import UserError
from mien.runtime.baked import PortableAvatar
from mien.runtime.checks import check

FORMAT, VERSION = "mien.baked", 1
_MAX_BYTES = 1 << 29
"""Largest file that is read, in bytes. The largest that mien writes has some tens of megabytes."""
_REMEDY = "write one with `mien export DIR --out me.mien`"


def write_portable(path: Path, avatar: PortableAvatar) -> None:
    """Write a .mien file atomically. The same avatar gives the same bytes."""
    check_writable(path)
    header, arrays = to_arrays(path, avatar)
    # A single entry, because safetensors writes several in random order.
    write_arrays(path, arrays, {"mien": json.dumps(header, allow_nan=False, sort_keys=True)})


def read_portable(path: Path) -> PortableAvatar:
    """Read a .mien file. All of its content is checked, so that the result can be posed."""
    if not path.is_file():
        raise UserError(f"{path}: no such file; {_REMEDY}")
    if path.stat().st_size > _MAX_BYTES:
        raise UserError(f"{path}: has more than {_MAX_BYTES:,} bytes, too many for an avatar; {_REMEDY}")
    try:
        metadata, arrays = read_safetensors(path, _load)
    except UserError as error:
        reason = str(error).split("; ")[0].partition("file (")[2].removesuffix(")")
        raise UserError(f"{path}: is damaged, or not a .mien file ({reason}); {_REMEDY}") from None
    try:
        header = parse_json(metadata.get("mien", "{}"))
    except ValueError as error:
        raise UserError(f"{path}: is damaged ({repr(error)[:200]}); export it again with `mien export`") from None
    return from_arrays(path, header, arrays)


def to_arrays(path: Path, avatar: PortableAvatar) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The header of the metadata, and the arrays by name, as the .mien file of an avatar has them."""
    check(avatar, str(path))
    arrays: dict[str, np.ndarray] = {}
    content = _tree(avatar, "", arrays)
    header = {"format": FORMAT, "version": VERSION, "sha256": content_digest(content, arrays), "content": content}
    return header, arrays


def from_arrays(path: Path, header: Any, arrays: dict[str, np.ndarray]) -> PortableAvatar:
    """The avatar of a header and arrays as `to_arrays` returns them. All of its content is checked."""
    try:
        found = (header.get("format"), header.get("version"))
        if found == (None, None):
            raise UserError(f"{path}: is not a .mien file; {_REMEDY}")
        if found != (FORMAT, VERSION):
            raise UserError(
                f"{path}: has format {found[0]!r:.80} version {found[1]!r:.80}, expected {FORMAT!r} version {VERSION}; "
                "export it again with `mien export`"
            )
        if header["sha256"] != content_digest(header["content"], arrays):
            raise UserError(
                f"{path}: does not match its checksum, so it was damaged or changed; copy it again, or export it again "
                "with `mien export`"
            )
        # Each array has one place, so that no check of a small file repeats without end.
        tree = _restored(header["content"], dict(arrays))
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise UserError(f"{path}: is damaged ({repr(error)[:200]}); export it again with `mien export`") from None
    with expect_whole(path, "export it again with `mien export`"):
        avatar: PortableAvatar = decode(PortableAvatar, tree, str(path), "export it again with `mien export`")
    check(avatar, str(path))
    return avatar


def _load(path: Path) -> tuple[dict[str, str], dict[str, np.ndarray]]:
    with safetensors.safe_open(path, framework="numpy") as file:
        return file.metadata() or {}, {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118


def _tree(value: Any, path: str, arrays: dict[str, np.ndarray]) -> Any:
    """`value` as json. Arrays are replaced by their dotted paths and put into `arrays` under these."""
    if isinstance(value, np.ndarray):
        arrays[path] = value
        return {"tensor": path}
    if is_dataclass(value) and not isinstance(value, type):
        inside = {f.name: _tree(getattr(value, f.name), f"{path}.{f.name}".lstrip("."), arrays) for f in fields(value)}
        return {"kind": type(value).__name__, **inside}
    if isinstance(value, tuple):
        return [_tree(item, f"{path}.{index}", arrays) for index, item in enumerate(value)]
    return value


_LATER: dict[str, dict[str, Any]] = {"ExpressionChanges": {"shares": None, "head": None}}
"""Fields that files of an earlier mien lack, by record, and what they stand for."""
_GONE = {"Filmed": ("directions", "reach")}
"""Fields that only files of an earlier mien have, by record."""


def _restored(node: Any, arrays: dict[str, np.ndarray]) -> Any:
    if isinstance(node, dict) and set(node) == {"tensor"}:
        return arrays.pop(node["tensor"])
    if isinstance(node, dict):
        kind = node.get("kind", "")
        known, gone = _LATER.get(kind, {}) | node, _GONE.get(kind, ())
        return {key: _restored(item, arrays) for key, item in known.items() if key not in gone}
    return [_restored(item, arrays) for item in node] if isinstance(node, list) else node


def content_digest(content: Any, arrays: dict[str, np.ndarray]) -> str:
    """The checksum of a header's content and of the arrays that it names."""
    digest = hashlib.sha256(json.dumps(content, sort_keys=True).encode())
    for name, array in sorted(arrays.items()):
        digest.update(name.encode() + str(array.dtype).encode() + struct.pack(f"<{array.ndim}q", *array.shape))
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()
