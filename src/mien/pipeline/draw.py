"""From posed Gaussians to pictures, with the options of the command line."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, UInt8

from mien.avatar.avatar import Avatar
from mien.camera import Camera
from mien.face.params import FaceParams
from mien.gaussians import Gaussians
from mien.machine.progress import say
from mien.media.pixels import to_rgb, to_rgba
from mien.pipeline.picture_options import PictureOptions
from mien.render import rasterize
from mien.render.rasterize import close_holes
from mien.render.validation import drawable
from mien.runtime.camera_paths import zoom_for_all
from mien.training.footage.filmed import filmed_words, read_coverage
from mien.training.run import read_run_config
from mien.training.whole_head.soft_cut import shares_left


@torch.no_grad()
def posed_softly(avatar: Avatar) -> Callable[[FaceParams], Gaussians]:
    """How an avatar is posed for pictures that people look at: it fades towards the neck cut, as in pages and files.

    The returned function takes a face of one timestep.
    """
    shares = shares_left(avatar)

    @torch.no_grad()
    def posed(face: FaceParams) -> Gaussians:
        gaussians = avatar.pose(face).gaussians.timestep(0)
        return replace(gaussians, opacities=gaussians.opacities * shares)

    return posed


@torch.no_grad()
def draw(options: PictureOptions, gaussians: Gaussians, camera: Camera, closing: int = 0) -> UInt8[np.ndarray, "h w _"]:
    """The picture as RGB over the background, or as RGBA with straight colours.

    Holes are closed by `closing` pixels (`close_holes`), but not in transparent pictures.
    """
    background = torch.tensor(options.color()).to(gaussians.means)
    with drawable("the avatar posed like this", "choose another pose or camera, or train it again"):
        rendering = rasterize(gaussians, camera, background)
    if options.background == "transparent":
        return to_rgba(*(tensor.float().cpu().numpy() for tensor in (rendering.image, rendering.alpha)))
    return to_rgb(close_holes(rendering.image.float(), closing).cpu().numpy())


@torch.no_grad()
def whole(camera: Camera, gaussians: Gaussians) -> Camera:
    """The camera, or one that shows more if its picture cuts the avatar off, which a small picture tells."""
    side = 128 / max(camera.width, camera.height)
    size = max(8, round(side * camera.width)), max(8, round(side * camera.height))

    def drawn(zoom: float) -> Bool[np.ndarray, "h w"]:
        return rasterize(gaussians, camera.fitted(*size, zoom)).alpha.numpy() > 0.1

    zoom = zoom_for_all(drawn)
    return camera if zoom == 1 else camera.fitted(camera.width, camera.height, zoom)


def warn_of_white(options: PictureOptions, run_dir: Path, avatar: Avatar) -> None:
    """Warn if transparent pictures are asked for but the run was trained over white."""
    if options.background != "transparent":
        return
    settings = read_run_config(run_dir)["settings"]
    # `auto` is random where avatar and settings can fill sides.
    may_fill = avatar.extras.surface is not None and settings.get("unseen") != "trained"
    if settings.get("background") == "white" or (settings.get("background") == "auto" and not may_fill):
        say(
            "warning: this avatar was trained over white, so bright skin and outlines may be partly transparent; "
            "`mien train --background random` avoids that"
        )


def sides_filmed(run_dir: Path, avatar: Avatar) -> str | None:
    """How far to each side the head was filmed, in words, if that is known. Beyond, it is completed."""
    covered, model = read_coverage(run_dir, avatar.face_model), avatar.face_model
    return None if covered is None else filmed_words(model, model.head_vertices(avatar.subject)[0].detach(), covered)
