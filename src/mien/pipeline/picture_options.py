"""Options for pictures of avatars that several sub-commands share: size and background."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from mien.disk.reading import MAX_SIDE
from mien.errors import UserError

if TYPE_CHECKING:
    import mien.media.output

_NAMED = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0), "grey": (0.5, 0.5, 0.5), "green": (0.0, 1.0, 0.0)}
_MIN_SIDE, _SIDE = 16, 512
_HEX = re.compile(r"#?([0-9a-fA-F]{6})")


@dataclass(frozen=True)
class PictureOptions:
    """Size and background of pictures."""

    size: int | None = None
    """Width and height in pixels, from 16 to 8192 (default: 512)."""
    width: int | None = None
    """Width in pixels, instead of --size. The head keeps its shape."""
    height: int | None = None
    """Height in pixels, instead of --size. The head keeps its shape."""
    background: str = "white"
    """Background: white, black, grey, green, a colour like #3060a0, or transparent (for .png and .webm, with straight
    colours)."""

    def plan(self, out: Path, frames: int) -> "mien.media.output.Output":
        """The output of the pictures, checked before any work."""
        from mien.media.output import plan_output

        wide, high = self.shape()
        if not (_MIN_SIDE <= wide <= MAX_SIDE and _MIN_SIDE <= high <= MAX_SIDE):
            given = f"--size {self.size}" if wide == high == self.size else f"--width {wide} --height {high}"
            raise UserError(f"{given}: give numbers from {_MIN_SIDE} to {MAX_SIDE}")
        self.color()
        return plan_output(out, frames, self.background == "transparent")

    def shape(self) -> tuple[int, int]:
        """Width and height in pixels."""
        size = _SIDE if self.size is None else self.size
        wide, high = (size if given is None else given for given in (self.width, self.height))
        return wide, high

    def color(self) -> tuple[float, float, float]:
        """The background's colour. It is black for transparent pictures."""
        if self.background == "transparent":
            return _NAMED["black"]
        if self.background in _NAMED:
            return _NAMED[self.background]
        match = _HEX.fullmatch(self.background)
        if match is None:
            names = ", ".join(_NAMED)
            raise UserError(f"--background {self.background}: use {names}, transparent, or a colour like #3060a0")
        red, green, blue = bytes.fromhex(match.group(1))
        return red / 255, green / 255, blue / 255
