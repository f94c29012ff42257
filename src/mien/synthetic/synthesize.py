"""Draw whole synthetic captures: in memory with their truth, or as a video file."""

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
    """Draw a capture and return it with its exact tracking (ground truth), with a progress bar.

    The same recipe and seed give the same bytes on the same machine. Landmarks are the face model's own, projected.
    Mattes are exact.

    Example:
        >>> capture, truth = synthesize(RECIPES["plain"], seed=3)
    """
    scene = SyntheticScene(recipe, seed)
    cameras = len(scene.cameras)
    shape = (recipe.timesteps, cameras, recipe.height, recipe.width)
    images, mattes = np.empty((*shape, 3), np.uint8), np.empty(shape, np.uint8)
    drawn = track_progress(scene.all_frames(range(recipe.timesteps)), f"Drawing {recipe.name}", recipe.timesteps)
    for timestep, frames in enumerate(drawn):
        for camera, frame in enumerate(frames):
            images[timestep, camera], mattes[timestep, camera] = frame.image, frame.matte
    capture = Capture(
        name=recipe.name,
        camera_ids=recipe.camera_ids,
        fps=recipe.fps,
        timestamps=np.arange(recipe.timesteps) / recipe.fps,
        images=images,
        mattes=mattes,
        landmarks=np.stack([scene.landmarks(camera) for camera in range(cameras)], axis=1),
        valid=np.ones((recipe.timesteps, cameras), bool),
        principal_point=np.tile(np.array([recipe.width / 2, recipe.height / 2], np.float32), (cameras, 1)),
        source=scene.source,
        calibration=scene.cameras if cameras > 1 else None,
    )
    return capture, scene.tracking()


def write_synthetic_video(recipe: SyntheticRecipe, path: Path, seed: int) -> None:
    """Draw a clip into a video file with a few frames in memory at a time, with a progress bar."""
    scene = SyntheticScene(recipe, seed)

    def images() -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        for frame in track_progress(scene.frames(), f"Drawing {recipe.name}", recipe.timesteps):
            yield frame.image

    write_video(path, images(), recipe.fps, recipe.detail.compression)
