"""NeRFace's layout: pictures over white, a mirrored world with the head at rest, and one vector for each frame."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from mien.datasets.layouts.filmed import Filmed, vectors
from mien.datasets.layouts.layout import Written
from mien.datasets.layouts.writing import write_plain_json
from mien.datasets.overlay import spread_out
from mien.machine.progress import track_progress
from mien.media.picture_files import write_png

_MEAN_DISTANCE = 0.5  # mean distance of the camera from the head in its world; near and far planes are at 0.2 and 0.8
_NUMBERS = 76
_VALIDATED = 5  # number of training pictures that val holds once more
_MIRROR = np.diag([-1.0, 1.0, 1.0])


def write(folder: Path, filmed: Filmed) -> Written:
    """Write the files of a person of NeRFace."""
    poses, scale = _poses(filmed)
    values, told = vectors(filmed, _NUMBERS)
    rows = {timestep: index for index, timestep in enumerate(filmed.timesteps)}
    spread = spread_out(len(filmed.trained), _VALIDATED)
    parts = {"train": filmed.trained, "val": tuple(filmed.trained[index] for index in spread), "test": filmed.held_out}
    for part, timesteps in parts.items():
        frames = []
        for number, timestep in enumerate(track_progress(timesteps, f"write {part}", len(timesteps))):
            write_png(folder / part / f"f_{number:04d}.png", filmed.over_white(timestep))
            frames.append(
                {
                    "file_path": f"./{part}/f_{number:04d}",
                    "transform_matrix": poses[rows[timestep]].tolist(),
                    "expression": values[rows[timestep]].tolist(),
                    "bbox": _box(filmed, timestep),
                }
            )
        if frames:
            write_plain_json(folder / f"transforms_{part}.json", {**_intrinsics(filmed), "frames": frames})
    np.save(folder / "index_map.npy", np.repeat(np.arange(len(filmed.trained), dtype=float)[:, None], 2, axis=1))
    write_png(folder / "bg" / "00050.png", np.full((filmed.size[1], filmed.size[0], 3), 255, np.uint8))
    names = {(timestep, 0): f"f_{number:04d}" for number, timestep in enumerate(filmed.held_out)}
    told = (
        "Pictures are over white by their mattes, and bg is white, so nothing of the filmed background is left.",
        f"The world has the head at rest; its unit is {1 / scale:.9g} m. train and test are in the order of time.",
        f"val holds {len(spread)} training pictures once more, so that nothing held out is looked at.",
        *told,
    )
    return Written(names, told)


def _poses(filmed: Filmed) -> tuple[np.ndarray, float]:
    """Camera-to-world matrices of the mirrored world, and its scale in units for each metre."""
    to_camera = filmed.head_to_camera()
    turned = to_camera[:, :3, :3].transpose(0, 2, 1)
    centers = -(turned @ to_camera[:, :3, 3:])[..., 0]
    scale = _MEAN_DISTANCE / float(np.linalg.norm(centers, axis=1).mean())
    poses = np.tile(np.eye(4), (len(centers), 1, 1))
    poses[:, :3, :3] = -_MIRROR @ turned
    poses[:, :3, 3] = scale * centers @ _MIRROR
    return poses, scale


def _intrinsics(filmed: Filmed) -> dict[str, Any]:
    """The camera: fx is negative, and rays go through whole pixels."""
    K, (width, height) = filmed.K, filmed.size
    fx, fy = float(K[0, 0]), float(K[1, 1])
    centre = [(float(K[0, 2]) - 0.5) / width, (float(K[1, 2]) - 0.5) / height]
    return {"camera_angle_x": -2 * math.atan(width / (2 * fx)), "intrinsics": [-fx, fy, *centre]}


def _box(filmed: Filmed, timestep: int) -> list[float]:
    """Top, bottom, left and right of what the matte shows, as shares of the picture."""
    seen = filmed.matte(timestep) > 0
    if not seen.any():
        return [0.0, 1.0, 0.0, 1.0]
    rows, columns = np.flatnonzero(seen.any(1)), np.flatnonzero(seen.any(0))
    (width, height) = filmed.size
    return [rows[0] / height, (rows[-1] + 1) / height, columns[0] / width, (columns[-1] + 1) / width]
