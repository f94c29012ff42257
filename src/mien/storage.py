"""Files: everything from `mien.disk.files`, and torch tensors as safetensors. Nothing here depends on what is stored."""

from collections.abc import Mapping
from pathlib import Path

import safetensors.torch
from torch import Tensor

from mien.disk.files import (
    cannot_write,
    check_writable,
    expect_whole,
    file_digest,
    read_arrays,
    read_json,
    read_safetensors,
    replace_folder,
    write_arrays,
    write_atomically,
    write_json,
    write_safetensors,
)

__all__ = [
    "cannot_write",
    "check_writable",
    "expect_whole",
    "file_digest",
    "read_arrays",
    "read_json",
    "read_tensors",
    "replace_folder",
    "write_arrays",
    "write_atomically",
    "write_json",
    "write_tensors",
]


def write_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str] | None = None) -> None:
    """Write torch tensors as safetensors."""
    contiguous = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    write_safetensors(path, safetensors.torch.save(contiguous), metadata)


def read_tensors(path: Path, stage: str = "the stage that writes it", remedy: str | None = None) -> dict[str, Tensor]:
    """Read safetensors as torch tensors on the CPU; error messages give `remedy`, or else name `stage`."""
    return read_safetensors(path, safetensors.torch.load_file, stage, remedy)
