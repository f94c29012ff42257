"""What pictures of avatars look like, as several sub-commands ask: size, background."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8

from mien.camera import Camera
from mien.errors import UserError
from mien.evaluation.cameras import LARGEST_SIDE, fitted
from mien.export.pictures import Output, plan_output, to_rgb, to_rgba
from mien.gaussians import Gaussians
from mien.progress import say
from mien.render import rasterize
from mien.training import read_run_config

_NAMED = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0), "grey": (0.5, 0.5, 0.5), "green": (0.0, 1.0, 0.0)}
_SMALLEST_SIDE = 16
_HEX = re.compile(r"#?([0-9a-fA-F]{6})")


@dataclass(frozen=True)
class PictureOptions:
    """Size and background of pictures."""

    size: int = 512
    """Width and height, pixels, 16..8192."""
    width: int | None = None
    """Pixels, instead of --size; the head keeps its shape."""
    height: int | None = None
    """Pixels, instead of --size."""
    background: str = "white"
    """white, black, grey, green, a colour like #3060a0, or transparent (for .png and .webm; colours are straight)."""

    def plan(self, out: Path, frames: int) -> Output:
        """Where pictures go, checked before any work.

        Raises:
            UserError: a size, the background or the place is not possible.
        """
        wide, high = self.shape()
        if not (_SMALLEST_SIDE <= wide <= LARGEST_SIDE and _SMALLEST_SIDE <= high <= LARGEST_SIDE):
            given = f"--size {self.size}" if wide == high == self.size else f"--width {wide} --height {high}"
            raise UserError(f"{given}: pictures are {_SMALLEST_SIDE}..{LARGEST_SIDE} pixels wide and high")
        self.colour()
        return plan_output(out, frames, self.background == "transparent")

    def warn_of_white(self, run_dir: Path) -> None:
        """Say so where transparency is asked of a run that has learned to lean on white."""
        if self.background == "transparent" and read_run_config(run_dir)["settings"].get("background") == "white":
            say(
                "this avatar was trained over white, and bright skin and outlines may let light through; "
                "`mien train --background random` makes one that does not"
            )

    def shape(self) -> tuple[int, int]:
        """Width and height."""
        wide, high = (self.size if given is None else given for given in (self.width, self.height))
        return wide, high

    def camera(self, camera: Camera, zoom: float = 1.0) -> Camera:
        """The view in pictures of this size."""
        return fitted(camera, *self.shape(), zoom)

    def colour(self) -> tuple[float, float, float]:
        """The background's colour; black for transparent.

        Raises:
            UserError: it is no colour.
        """
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

    @torch.no_grad()
    def picture(self, gaussians: Gaussians, camera: Camera) -> UInt8[np.ndarray, "h w _"]:
        """RGB over the background, or RGBA with straight colours."""
        rendering = rasterize(gaussians, camera, torch.tensor(self.colour()))
        if self.background == "transparent":
            return to_rgba(rendering.image.numpy(), rendering.alpha.numpy())
        return to_rgb(rendering.image.numpy())
