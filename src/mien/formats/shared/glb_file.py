"""The .glb container: json and one buffer in one file (glTF 2.0, sections 3.6 and 4)."""

import json
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from mien.disk.files import write_atomically
from mien.disk.reading import parse_json, read_bytes
from mien.errors import UserError

_MAGIC, _VERSION = 0x46546C67, 2
_JSON, _BINARY = 0x4E4F534A, 0x004E4942
_MAX_BYTES = 1 << 28
"""Largest file that is read, in bytes. The largest that mien writes has some tens of megabytes."""
_MAX_JSON_BYTES = 32 << 20
_COMPONENTS = {np.dtype("<f4"): 5126, np.dtype("<u4"): 5125, np.dtype("<u2"): 5123, np.dtype("u1"): 5121}
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
VERTICES, INDICES = 34962, 34963
"""Targets of buffer views: attributes of vertices, and indices of triangles."""


@dataclass
class GlbWriter:
    """Collects arrays, and writes them with the json that refers to them."""

    accessors: list[dict[str, Any]] = field(default_factory=list)
    views: list[dict[str, Any]] = field(default_factory=list)
    _pieces: list[bytes] = field(default_factory=list)
    _size: int = 0

    def view(self, data: bytes, target: int | None = None) -> int:
        """Add bytes, and return the index of their buffer view. Each begins at a multiple of 4 bytes."""
        self.views.append({"buffer": 0, "byteOffset": self._size, "byteLength": len(data)})
        if target is not None:
            self.views[-1]["target"] = target
        padded = data + b"\0" * (-len(data) % 4)
        self._pieces.append(padded)
        self._size += len(padded)
        return len(self.views) - 1

    def accessor(
        self, array: np.ndarray, target: int | None = None, bounds: bool = False, normalized: bool = False
    ) -> int:
        """Add an array [n] or [n, c], and return the index of its accessor.

        With `bounds`, the least and the largest value of each component are stated, as positions need it; `normalized`
        integers mean 0 to 1.
        """
        view = self.view(np.ascontiguousarray(array).tobytes(), target)
        described = {"bufferView": view, **self._described(array, bounds)}
        if normalized:
            described["normalized"] = True
        self.accessors.append(described)
        return len(self.accessors) - 1

    def sparse(self, array: np.ndarray) -> int:
        """Add an array [n, c] that is zero in most rows, and return the index of its accessor."""
        rows = np.flatnonzero((array != 0).any(1))
        described = self._described(array, bounds=True)
        if len(rows):
            kind = np.dtype("<u2") if len(array) <= 2**16 else np.dtype("<u4")
            described["sparse"] = {
                "count": len(rows),
                "indices": {"bufferView": self.view(rows.astype(kind).tobytes()), "componentType": _COMPONENTS[kind]},
                "values": {"bufferView": self.view(np.ascontiguousarray(array[rows]).tobytes())},
            }
        self.accessors.append(described)
        return len(self.accessors) - 1

    def jpeg(self, colors: Float32[np.ndarray, "h w 3"], quality: int) -> dict[str, Any]:
        """Add a picture of colours 0 to 1, and return its description as an image. This needs OpenCV."""
        import cv2

        from mien.media.picture_files import encode_picture

        picture = (colors * 255 + 0.5).astype(np.uint8)
        data = encode_picture(picture, ".jpeg", (cv2.IMWRITE_JPEG_QUALITY, quality))
        return {"mimeType": "image/jpeg", "bufferView": self.view(data)}

    @staticmethod
    def _described(array: np.ndarray, bounds: bool) -> dict[str, Any]:
        width = int(np.prod(array.shape[1:], dtype=int))
        described: dict[str, Any] = {
            "componentType": _COMPONENTS[array.dtype], "count": len(array), "type": _TYPES[width],
        }  # fmt: skip
        if bounds:
            flat = array.reshape(len(array), width)
            described |= {"min": flat.min(0).tolist(), "max": flat.max(0).tolist()}
        return described

    def write(self, path: Path, content: dict[str, Any]) -> None:
        """Write the file. `content` is its json without accessors, bufferViews and buffers."""
        whole = {
            **content,
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{"byteLength": self._size}],
        }
        text = json.dumps(whole, allow_nan=False, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        size = 12 + 8 + len(text) + 8 + self._size
        parts = [
            struct.pack("<III", _MAGIC, _VERSION, size), struct.pack("<II", len(text), _JSON), text,
            struct.pack("<II", self._size, _BINARY), *self._pieces,
        ]  # fmt: skip
        write_atomically(path, lambda temporary: temporary.write_bytes(b"".join(parts)))


@dataclass(frozen=True)
class Glb:
    """The content of a .glb file."""

    content: dict[str, Any]
    """Its json."""
    buffer: bytes

    def bytes_of(self, view: int) -> bytes:
        """The bytes of a buffer view. One that reaches beyond the buffer is a ValueError."""
        described = self.content["bufferViews"][view]
        start, size = described.get("byteOffset", 0), described["byteLength"]
        if view < 0 or start < 0 or size < 0 or start + size > len(self.buffer):
            raise ValueError(f"buffer view {view} reaches beyond the buffer")
        return self.buffer[start : start + size]


def read_glb(path: Path) -> Glb:
    """Read a .glb file that `GlbWriter` wrote."""
    remedy = "write it again with `mien export`"
    if not path.is_file():
        raise UserError(f"{path}: no such file; {remedy}")
    try:
        data = read_bytes(path, _MAX_BYTES)
        magic, version, size = struct.unpack_from("<III", data)
        if (magic, version, size) != (_MAGIC, _VERSION, len(data)):
            raise ValueError("its header is wrong")
        length, kind = struct.unpack_from("<II", data, 12)
        rest, binary = struct.unpack_from("<II", data, 20 + length)
        if (kind, binary) != (_JSON, _BINARY) or 28 + length + rest != len(data) or length > _MAX_JSON_BYTES:
            raise ValueError("its chunks are wrong")
        content = parse_json(data[20 : 20 + length].decode())
        if not isinstance(content, dict):
            raise ValueError("its json is no object")
        return Glb(content, data[28 + length :])
    except (ValueError, struct.error, OSError) as error:
        raise UserError(f"{path}: is damaged, or not a .glb file ({str(error)[:100]}); {remedy}") from None
