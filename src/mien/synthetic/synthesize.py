"""Whole synthetic captures: in memory with their truth, or as a video file."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from mien.capture import Capture
from mien.capture.video import write_video
from mien.progress import track_progress
from mien.synthetic.recipe import SyntheticRecipe
from mien.synthetic.scene import SyntheticScene
from mien.tracking import Tracking


def synthesize(recipe: SyntheticRecipe, seed: int) -> tuple[Capture, Tracking]:
    """A capture with its exact tracking (ground truth), from a seed; with a progress bar.

    The same recipe and seed give the same bytes on the same machine. Landmarks are the face model's own, projected;
    mattes are exact.

    Example:
        >>> capture, truth = synthesize(RECIPES["plain"], seed=3)
    """
    scene = SyntheticScene(recipe, seed)
    shape = (recipe.timesteps, 1, recipe.height, recipe.width)
    images, mattes = np.empty((*shape, 3), np.uint8), np.empty(shape, np.uint8)
    for timestep, frame in enumerate(track_progress(scene.frames(), f"Drawing {recipe.name}", recipe.timesteps)):
        images[timestep, 0], mattes[timestep, 0] = frame.image, frame.matte
    capture = Capture(
        name=recipe.name,
        camera_ids=("front",),
        fps=recipe.fps,
        timestamps=np.arange(recipe.timesteps) / recipe.fps,
        images=images,
        mattes=mattes,
        landmarks=scene.landmarks()[:, None],
        valid=np.ones((recipe.timesteps, 1), bool),
        principal_point=np.array([[recipe.width / 2, recipe.height / 2]], np.float32),
        source=scene.source,
    )
    return capture, scene.tracking()


def write_synthetic_video(recipe: SyntheticRecipe, path: Path, seed: int) -> None:
    """Draw a clip straight into a video file, a few frames in memory at a time; with a progress bar."""
    scene = SyntheticScene(recipe, seed)

    def images() -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        for frame in track_progress(scene.frames(), f"Drawing {recipe.name}", recipe.timesteps):
            yield frame.image

    write_video(path, images(), recipe.fps)
