"""`--config FILE.json`: settings from a file, such as a run's config.json. The file may hold only some settings."""

import difflib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mien.avatar.methods import has_method, method_names
from mien.disk.config import no_such_setting, shown
from mien.disk.reading import parse_json, read_bytes
from mien.errors import UserError

_FORMAT, _VERSION = "mien.run", 1
_TAKEN = ("method", "settings")
_NOT_TAKEN = ("format", "version", "checksum", "data", "mien", "command_line")
"""Other entries of a run's config.json: what it was trained on, by which version, with which command."""
_MAX_BYTES = 16 << 20
"""Largest file that is read, in bytes. A run's config.json has some kilobytes."""


@dataclass(frozen=True)
class ConfigFile:
    """The settings that a file asks for. Their names and values are not checked yet."""

    path: Path
    method: str | None
    """Name of the method, if the file gives one."""
    method_changes: dict[str, Any]
    """The method's settings by name, without `kind`."""
    settings_changes: dict[str, Any]
    """Settings of the run by name."""
    sequences: tuple[str, ...]
    """Sequences that the run of this file was trained on. They are not taken over."""


def read_config_file(path: Path) -> ConfigFile:
    """Read the config.json of a run, which may be edited (its checksum is not checked), or one written by hand."""
    content = _read(path)
    for name in content:
        if name not in _TAKEN + _NOT_TAKEN:
            short = shown(name)
            near = difflib.get_close_matches(short, _TAKEN, 1)
            raise UserError(no_such_setting(f"{path}: {short}", "a file of settings", near, _TAKEN))
    found = (content.get("format", _FORMAT), content.get("version", _VERSION))
    if found != (_FORMAT, _VERSION):
        wanted = f"a run's config.json ({_FORMAT!r} version {_VERSION})"
        told = f"has format {found[0]!r:.80} version {found[1]!r:.80}"
        raise UserError(f"{path}: {told}; give {wanted}, or leave out format and version")
    parts = {name: content.get(name, {}) for name in _TAKEN}
    for name, part in parts.items():
        if not isinstance(part, dict):
            raise UserError(f"{path}: {name} is not an object of settings; give {{...}}")
    method = parts["method"].get("kind")
    if method is not None and (not isinstance(method, str) or not has_method(method)):
        raise UserError(f"{path}: method.kind {shown(method)}: give the name of a method: {', '.join(method_names())}")
    changes = {name: value for name, value in parts["method"].items() if name != "kind"}
    return ConfigFile(path, method, changes, parts["settings"], _sequences(content.get("data")))


def _sequences(data: Any) -> tuple[str, ...]:
    entries = data if isinstance(data, list) else []
    return tuple(shown(entry["sequence"]) for entry in entries if isinstance(entry, dict) and "sequence" in entry)


def _read(path: Path) -> dict[str, Any]:
    if path.is_dir():
        inside = path / "config.json"
        raise UserError(f"--config {path}: is a folder; " + (f"give {inside}" if inside.is_file() else "give a file"))
    if not path.exists():
        raise UserError(f"--config {path}: no such file; give a json file, such as DIR/runs/NAME/config.json")
    if not path.is_file():
        raise UserError(f"--config {path}: is not an ordinary file; give a json file")
    try:
        text = read_bytes(path, _MAX_BYTES).decode("utf-8-sig")  # editors on Windows write a byte order mark
        content = parse_json(text, unique_names=True, any_size=True)
    except (OSError, ValueError) as error:
        raise UserError(f"--config {path}: cannot be read as json ({error}); correct it or give another file") from None
    if not isinstance(content, dict):
        raise UserError(f'--config {path}: is not an object; give {{"method": {{...}}, "settings": {{...}}}}')
    return content
