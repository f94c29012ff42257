"""Compare two folders byte by byte, apart from what a clock or a meter has measured."""

import json
import re
from pathlib import Path
from typing import Any

from safetensors.numpy import load_file

_MEASURED = frozenset({"seconds", "seconds_per_frame", "step_ms_median", "peak_memory_mb", "fingerprint", "checksum"})
"""Entries of json files: times and memory, the times of files in a cache's fingerprint, and the sum over all."""
_MEASURED_TENSORS = frozenset({"step_ms", "curves.step_ms", "seconds", "peak_memory_mb"})
_MEASURED_TEXT = (
    (re.compile(r"<b>[\d.]+ (?:m?s|min \d+ s)</b>"), "<b>a time</b>"),
    (re.compile(r"Peak memory [\d,.]+ MB"), "Peak memory"),
    (re.compile(r"<h3>Step time, ms</h3>.*?</svg>", re.DOTALL), "a chart of times"),
)


def differing_files(one: Path, other: Path) -> list[str]:
    """Return the names of the files in which two folders differ. Hidden files do not count.

    A stop leaves a checkpoint of its own, so only checkpoints that both folders have are compared.
    """
    ours, theirs = visible_files(one), visible_files(other)
    alone = sorted(name for name in ours ^ theirs if "/checkpoints/" not in name)
    return alone + [name for name in sorted(ours & theirs) if not _same(one / name, other / name)]


def visible_files(folder: Path) -> set[str]:
    """Return the paths of all files without a hidden part."""
    paths = {path.relative_to(folder) for path in folder.rglob("*") if path.is_file()}
    return {str(path) for path in paths if not any(part.startswith(".") for part in path.parts)}


def hidden_files(folder: Path) -> set[str]:
    """Return the paths of what is hidden: unfinished files, locks and kept pieces."""
    return {str(path.relative_to(folder)) for path in folder.rglob(".*")}


def _same(one: Path, other: Path) -> bool:
    if one.read_bytes() == other.read_bytes():
        return True
    return _content(one) == _content(other)


def _content(path: Path) -> Any:
    if path.suffix == ".json":
        return _without_measured(json.loads(path.read_text()))
    if path.suffix == ".safetensors":
        tensors = load_file(path).items()
        return {name: (one.dtype, one.shape, one.tobytes()) for name, one in tensors if name not in _MEASURED_TENSORS}
    if path.suffix == ".html":
        text = path.read_text()
        for pattern, words in _MEASURED_TEXT:
            text = pattern.sub(words, text)
        return text
    return path.read_bytes()


def _without_measured(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _without_measured(each) for name, each in value.items() if name not in _MEASURED}
    return [_without_measured(each) for each in value] if isinstance(value, list) else value
