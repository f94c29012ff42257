"""Files: atomic writes, json with format and version, arrays and tensors, and checks that a path is writable.

Nothing here depends on what is stored. torch is imported only for tensors.
"""

import ctypes
import errno
import hashlib
import json
import os
import secrets
import tempfile
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import safetensors
import safetensors.numpy

from mien.disk.reading import open_new, open_ordinary, parse_json, read_bytes, remove_tree
from mien.errors import CannotWriteError, UserError

if TYPE_CHECKING:
    from torch import Tensor

_KEPT_OF_NAME = 100  # characters of a file's name that its temporary name keeps; file systems allow 255 bytes in all
_UNREADABLE = (safetensors.SafetensorError, OSError, ValueError, LookupError, TypeError, RuntimeError, AttributeError)
"""Errors of a damaged safetensors file. An AttributeError is a type of number that numpy lacks, such as float8."""
_CHECKSUM = "checksum"
"""Key of the checksum, which covers everything else in a json file, or the header and data of a safetensors file."""
_ANY_STAGE = "the stage that writes it"
_MAX_JSON_BYTES, _MAX_HEADER_BYTES, _MAX_TENSORS_BYTES = 32 << 20, 8 << 20, 1 << 30
"""Largest json file, header of a safetensors file, and such file that are read. The largest that mien writes have some
megabytes, some kilobytes, and some hundred megabytes."""


def check_writable(path: Path, *, folder: bool = False) -> None:
    """Check before any long work that `path` can be written as a file (or, with `folder`, as a folder).

    Missing parent folders are fine, because `write_atomically` makes them. The check leaves nothing behind.
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
        raise UserError(f"{path}: is not an ordinary file; give the name of a file to write")
    nearest = path if there and folder else path.parent
    while not nearest.exists() and nearest != nearest.parent:
        if nearest.is_symlink():
            raise UserError(f"{path}: {nearest} is a link to nowhere; choose another place")
        nearest = nearest.parent
    if not nearest.is_dir():
        raise UserError(f"{path}: {nearest} is a file, not a folder; choose another place")
    try:
        # Test by writing instead of asking for permissions: root has every permission, yet cannot write to /proc or to
        # a read-only disk.
        with tempfile.NamedTemporaryFile(dir=nearest, prefix=".mien-"):
            pass
    except OSError as error:
        raise UserError(f"{path}: cannot be written, {nearest}: {error.strerror}; choose another place") from None


def write_atomically(path: Path, write: Callable[[Path], object]) -> None:
    """Call `write` with a temporary path beside `path`, then rename it to `path`. Readers see either all or nothing.

    A CannotWriteError says that the disk is full or read-only, or the folder is not writable.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.parent / f".{path.name[:_KEPT_OF_NAME]}.{secrets.token_hex(4)}{path.suffix[-20:]}"
        open_new(temporary).close()
        try:
            write(temporary)
            temporary.replace(path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise cannot_write(path, error) from None


def remove_leftovers(path: Path) -> None:
    """Remove temporary files of `write_atomically` that killed writers of `path` left.

    Only for what a single process writes at a time, such as one that holds the workspace's lock.
    """
    start, end = f".{path.name[:_KEPT_OF_NAME]}.", path.suffix[-20:]
    for other in path.parent.iterdir() if path.parent.is_dir() else ():
        if other.name.startswith(start) and other.name.endswith(end):
            other.unlink(missing_ok=True)


def replace_folder(path: Path, finished: Path) -> None:
    """Move the folder `finished`, which is on the same disk, to `path`, and remove the folder that was there.

    This is a single step if the system can exchange two names. Readers then find either the old folder or the new one.
    """
    if not path.exists():
        finished.rename(path)
        return
    if not _exchange(path, finished):
        old = path.parent / f".{path.name}.old"
        remove_tree(old)
        path.rename(old)
        finished.rename(path)
        finished = old
    remove_tree(finished)


def _exchange(one: Path, other: Path) -> bool:
    """Exchange two paths (Linux); False if the system or the file system cannot."""
    try:
        rename = ctypes.CDLL(None).renameat2
    except (OSError, AttributeError, TypeError):  # TypeError: Windows
        return False
    at, exchange = -100, 2  # AT_FDCWD and RENAME_EXCHANGE of renameat2(2)
    return rename(at, os.fsencode(one), at, os.fsencode(other), exchange) == 0


def cannot_write(path: Path, error: OSError) -> CannotWriteError:
    """The error for a failed write of `path`, with a remedy that fits the cause."""
    if isinstance(error, CannotWriteError):
        return error
    full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
    remedy = "free disk space and run the same command again" if full else "choose another place"
    return CannotWriteError(f"{path}: cannot be written ({error.strerror or error}); {remedy}", error)


def write_json(path: Path, format_name: str, version: int, content: Mapping[str, Any]) -> None:
    """Write `content` as json after its `format` and `version`, with a checksum that `read_json` removes again."""
    whole = {"format": format_name, "version": version, **content}
    checksum = _json_checksum(json.loads(json.dumps(whole)))
    text = json.dumps({**whole, _CHECKSUM: checksum}, indent=1, allow_nan=False)
    write_atomically(path, lambda temporary: temporary.write_text(text + "\n", encoding="utf-8"))


def read_json(
    path: Path,
    format_name: str,
    version: int,
    stage: str = _ANY_STAGE,
    remedy: str | None = None,
    most: int = _MAX_JSON_BYTES,
) -> dict[str, Any]:
    """Read what `write_json` wrote; error messages name the command `stage` as the remedy.

    `remedy` replaces that advice. A missing file still asks for its stage, if there is one. A larger file than `most`
    bytes is refused.
    """
    anew = remedy or f"delete its folder and run {stage} again"
    try:
        content = parse_json(read_bytes(path, most).decode("utf-8"))
    except FileNotFoundError:
        asked = remedy if remedy and stage == _ANY_STAGE else f"run {stage} again"
        raise UserError(f"{path}: missing; {asked}") from None
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: cannot be read as json ({error}); {anew}") from None
    found = (content.get("format"), content.get("version")) if isinstance(content, dict) else (None, None)
    if found != (format_name, version):
        raise UserError(
            f"{path}: has format {found[0]!r:.80} version {found[1]!r:.80}, expected {format_name!r} version {version}"
            "; " + (remedy or f"run {stage} again")
        )
    if _CHECKSUM in content and content.pop(_CHECKSUM) != _json_checksum(content):
        raise UserError(
            f"{path}: was damaged or edited after it was written; {anew} "
            f"(or, if you know what you changed, remove its {_CHECKSUM!r})"
        )
    return content


def _json_checksum(content: Any) -> str:
    """The checksum of content parsed from json, in which tuples are lists and keys are strings."""
    canonical = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()[:32]


def file_digest(path: Path) -> str:
    """SHA-256 of a file's bytes, as hex digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray], metadata: Mapping[str, str] | None = None) -> None:
    """Write numpy arrays as safetensors."""
    contiguous = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    write_safetensors(path, safetensors.numpy.save(contiguous), metadata)


def write_safetensors(path: Path, data: bytes, metadata: Mapping[str, str] | None = None) -> None:
    """Write the bytes of a safetensors file, with a checksum of header and data in its metadata."""
    size = int.from_bytes(data[:8], "little")
    header, body = json.loads(data[8 : 8 + size]), memoryview(data)[8 + size :]
    checksum = _tensor_checksum(header, [body])
    text = json.dumps({"__metadata__": {**(metadata or {}), _CHECKSUM: checksum}, **header}, separators=(",", ":"))
    packed = text.encode()
    packed += b" " * (-len(packed) % 8)

    def write(temporary: Path) -> None:
        with temporary.open("wb") as file:
            for part in (len(packed).to_bytes(8, "little"), packed, body):
                file.write(part)

    write_atomically(path, write)


def read_arrays(path: Path, stage: str = _ANY_STAGE) -> dict[str, np.ndarray]:
    """Read safetensors as numpy arrays; error messages name the command `stage` as the remedy.

    No number is infinite. NaN means that a number is not known.
    """
    return read_safetensors(path, lambda file: _finite(safetensors.numpy.load_file(file)), stage)


def _finite(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    for name, array in arrays.items():
        if np.isinf(array).any():
            raise ValueError(f"{name!r} holds infinite numbers")
    return arrays


def read_safetensors(
    path: Path, load: Callable[[Path], Any], stage: str = _ANY_STAGE, remedy: str | None = None
) -> Any:
    """Read a safetensors file by `load`; a missing or damaged file is one line, as in `read_json`."""
    if not path.is_file():
        raise UserError(f"{path}: missing; {remedy or f'run {stage} again'}")
    try:
        _check_safetensors(path)
        return load(path)
    except _UNREADABLE as error:
        reason = " ".join(str(error).split())[:200]
        remedy = remedy or f"delete it and run {stage} again"
        raise UserError(f"{path}: damaged safetensors file ({reason}); {remedy}") from None


def _check_safetensors(path: Path) -> None:
    """Check a file against the checksum that `write_safetensors` stored. Files of other programs have none."""
    with open_ordinary(path) as file:
        whole = os.fstat(file.fileno()).st_size
        if whole > _MAX_TENSORS_BYTES:
            raise ValueError(f"it has {whole:,} bytes, and at most {_MAX_TENSORS_BYTES:,} are read")
        size = int.from_bytes(file.read(8), "little")
        if not 2 <= size <= min(_MAX_HEADER_BYTES, whole - 8):
            raise ValueError("its header does not fit into the file")
        header = parse_json(file.read(size).decode("utf-8"))
        metadata = header.pop("__metadata__", {}) if isinstance(header, dict) else None
        if not isinstance(header, dict) or not isinstance(metadata, dict):
            raise ValueError("its header or metadata is not an object")
        stored = metadata.get(_CHECKSUM)
        if stored is not None and stored != _tensor_checksum(header, iter(partial(file.read, 1 << 20), b"")):
            raise ValueError("its content differs from what was written")


def _tensor_checksum(header: Mapping[str, Any], body: Iterable[bytes | memoryview]) -> str:
    digest = hashlib.sha256(json.dumps(header, sort_keys=True, separators=(",", ":")).encode())
    for part in body:
        digest.update(part)
    return digest.hexdigest()


def write_tensors(path: Path, tensors: "Mapping[str, Tensor]", metadata: Mapping[str, str] | None = None) -> None:
    """Write torch tensors as safetensors."""
    import safetensors.torch

    contiguous = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    write_safetensors(path, safetensors.torch.save(contiguous), metadata)


def read_tensors(path: Path, stage: str = _ANY_STAGE, remedy: str | None = None) -> "dict[str, Tensor]":
    """Read safetensors as torch tensors on the CPU; error messages give `remedy`, or `stage`."""
    import safetensors.torch

    return read_safetensors(path, safetensors.torch.load_file, stage, remedy)
