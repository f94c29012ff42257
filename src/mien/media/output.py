"""Endings of files: of sound, and of pictures that are written. They are checked before any work, without libraries."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from mien.disk.files import check_writable
from mien.errors import UserError

SOUND_ENDINGS = (".wav", ".mp3", ".flac", ".ogg", ".opus", ".m4a", ".aac", ".aif", ".aiff")
ENDINGS = ".png (one picture), a folder or NAME_%06d.png (numbered pictures), .mp4 or .webm"
_NUMBER = re.compile(r"%0?\d*d")


@dataclass(frozen=True)
class Output:
    """A checked output for pictures."""

    path: Path
    """A file, or for `sequence` a folder or a pattern."""
    kind: Literal["still", "sequence", "mp4", "webm"]
    transparent: bool

    def numbered(self, index: int) -> Path:
        """The file of one picture in a sequence."""
        if _NUMBER.search(self.path.name):
            return self.path.with_name(_NUMBER.sub(lambda match: match.group() % index, self.path.name))
        return self.path / f"{index:06d}.png"


def plan_output(path: Path, frames: int, transparent: bool = False) -> Output:
    """The output for the ending of `path`, checked before any work."""
    ending = path.suffix.lower()
    if ending == ".png" and _NUMBER.search(path.name):
        output = Output(path, "sequence", transparent)
        check_writable(output.numbered(0))
    elif ending == "":
        output = Output(path, "sequence", transparent)
        check_writable(path, folder=True)
    elif ending == ".png":
        output = Output(path, "still", transparent)
        check_writable(path)
        if frames != 1:
            numbered = path.with_name(f"{path.stem}_%06d.png")
            raise UserError(f"{path}: is one picture, but there are {frames}; use --out {numbered}, or a folder")
    elif ending in (".mp4", ".webm"):
        output = Output(path, "mp4" if ending == ".mp4" else "webm", transparent)
        check_writable(path)
    else:
        raise UserError(f"{path}: cannot write {path.suffix}; use {ENDINGS}")
    if output.kind == "mp4" and transparent:
        raise UserError(f"{path}: an .mp4 cannot be transparent; use .webm or .png, or choose a --background")
    if output.kind == "sequence" and output.numbered(frames).exists():
        raise UserError(f"{output.numbered(frames)}: belongs to a longer sequence; delete it, or choose another name")
    return output
