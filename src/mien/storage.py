"""Files: atomic writes, json with format and version, safetensors. Nothing here knows what is stored."""

import hashlib
import json
import os
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy
import safetensors.torch
from torch import Tensor

from mien.errors import UserError


def write_atomically(path: Path, write: Callable[[Path], object]) -> None:
    """Call `write` with a temporary path beside `path`, then rename it into place: readers see all or nothing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=path.suffix)
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
    except (OSError, ValueError) as error:
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


def write_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str] | None = None) -> None:
    """Write torch tensors as safetensors."""
    contiguous = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    write_atomically(
        path, lambda temporary: safetensors.torch.save_file(contiguous, temporary, metadata=dict(metadata or {}))
    )


def read_tensors(path: Path) -> dict[str, Tensor]:
    """Read safetensors as torch tensors on the CPU.

    Raises:
        UserError: the file is missing or damaged.
    """
    return _read(path, safetensors.torch.load_file)


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write numpy arrays as safetensors."""
    contiguous = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    write_atomically(path, lambda temporary: safetensors.numpy.save_file(contiguous, temporary))


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read safetensors as numpy arrays.

    Raises:
        UserError: the file is missing or damaged.
    """
    return _read(path, safetensors.numpy.load_file)


def _read(path: Path, load: Callable[[Path], Any]) -> Any:
    if not path.is_file():
        raise UserError(f"{path}: missing; run the stage that writes it again")
    try:
        return load(path)
    except (safetensors.SafetensorError, OSError, ValueError) as error:
        raise UserError(f"{path}: damaged safetensors file ({error}); delete it and run its stage again") from None
