"""Files without torch: atomic writes, json with format and version, numpy arrays, and whether a path can be written.

`mien.storage` adds torch tensors. Nothing here knows what is stored.
"""

import hashlib
import json
import os
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy

from mien.errors import UserError

_KEPT_OF_NAME = 100
"""Characters of a file's name that its temporary name keeps: file systems allow 255 bytes in all."""


def check_writable(path: Path, *, folder: bool = False) -> None:
    """Find out before any long work whether `path` can be written as a file (or, with `folder`, as a folder).

    Missing parent folders are fine, since `write_atomically` makes them. Leaves nothing behind.

    Raises:
        UserError: it is a folder where a file is asked (or a file where a folder is), a device or pipe; a parent is a
            file; or its place cannot be written to.
    """
    try:
        there = path.exists()
    except OSError as error:
        raise UserError(f"{path}: cannot be written ({error.strerror}); choose another place") from None
    if there and folder and not path.is_dir():
        raise UserError(f"{path}: is a file, but a folder is to be written there; give the name of a folder")
    if there and not folder and path.is_dir():
        raise UserError(f"{path}: is a folder, but a file is to be written there; give the name of a file")
    if there and not folder and not path.is_file():
        raise UserError(f"{path}: is no ordinary file; give the name of a file to write")
    nearest = path if there and folder else path.parent
    while not nearest.exists() and nearest != nearest.parent:
        if nearest.is_symlink():
            raise UserError(f"{path}: {nearest} is a link to nowhere; choose another place")
        nearest = nearest.parent
    if not nearest.is_dir():
        raise UserError(f"{path}: {nearest} is a file, not a folder; choose another place")
    try:
        # Tried, not asked: root may write everywhere by permission, yet not to /proc or a read-only disk.
        with tempfile.NamedTemporaryFile(dir=nearest, prefix=".mien-"):
            pass
    except OSError as error:
        raise UserError(f"{path}: cannot be written, {nearest}: {error.strerror}; choose another place") from None


def write_atomically(path: Path, write: Callable[[Path], object]) -> None:
    """Call `write` with a temporary path beside `path`, then rename it into place: readers see all or nothing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name[:_KEPT_OF_NAME]}.", suffix=path.suffix[-20:])
    os.close(handle)
    temporary = Path(name)
    try:
        write(temporary)
        temporary.chmod(0o644)
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def write_json(path: Path, format_name: str, version: int, content: Mapping[str, Any]) -> None:
    """Write `content` as json behind its `format` and `version`."""
    text = json.dumps({"format": format_name, "version": version, **content}, indent=1, allow_nan=False)
    write_atomically(path, lambda temporary: temporary.write_text(text + "\n", encoding="utf-8"))


def read_json(path: Path, format_name: str, version: int) -> dict[str, Any]:
    """Read what `write_json` wrote.

    Raises:
        UserError: the file is missing, is no json, or has another format or version.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UserError(f"{path}: missing; run the stage that writes it again") from None
    except (OSError, ValueError, RecursionError) as error:
        raise UserError(
            f"{path}: cannot be read as json ({error}); delete its folder and run the stage again"
        ) from None
    found = (content.get("format"), content.get("version")) if isinstance(content, dict) else (None, None)
    if found != (format_name, version):
        raise UserError(
            f"{path}: has format {found[0]!r} version {found[1]!r}, expected {format_name!r} version {version}; "
            "run the stage that writes it again"
        )
    return content


def file_digest(path: Path) -> str:
    """SHA-256 of a file's bytes, as hex digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray], metadata: Mapping[str, str] | None = None) -> None:
    """Write numpy arrays as safetensors."""
    contiguous = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    kept = None if metadata is None else dict(metadata)
    write_atomically(path, lambda temporary: safetensors.numpy.save_file(contiguous, temporary, metadata=kept))


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read safetensors as numpy arrays.

    Raises:
        UserError: the file is missing or damaged.
    """
    return read_safetensors(path, safetensors.numpy.load_file)


def read_safetensors(path: Path, load: Callable[[Path], Any]) -> Any:
    """What `load` reads from a safetensors file, with the errors of a missing or damaged one in words.

    Raises:
        UserError: the file is missing or damaged.
    """
    if not path.is_file():
        raise UserError(f"{path}: missing; run the stage that writes it again")
    try:
        return load(path)
    except (safetensors.SafetensorError, OSError, ValueError) as error:
        raise UserError(f"{path}: damaged safetensors file ({error}); delete it and run its stage again") from None
