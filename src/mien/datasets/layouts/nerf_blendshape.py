"""NeRFBlendShape's layout: pictures, head parsing and landmarks by number, and one transforms.json with 46 numbers."""

from pathlib import Path

import numpy as np

from mien.datasets.flame_poses import AXES
from mien.datasets.layouts.filmed import Filmed, vectors
from mien.datasets.layouts.layout import Written
from mien.datasets.layouts.writing import write_jpg, write_plain_json
from mien.machine.progress import track_progress
from mien.media.picture_files import write_png

_NUMBERS = 46
_HEAD = (0, 0, 255)  # colour of the head in the parsing, as red, green and blue


def write(folder: Path, filmed: Filmed) -> Written:
    """Write the files of a person of NeRFBlendShape. What is held out comes last, because its split is a number."""
    order = [*filmed.trained, *filmed.held_out]
    rows = {timestep: index for index, timestep in enumerate(filmed.timesteps)}
    values, told = vectors(filmed, _NUMBERS)
    poses, frames, without = np.linalg.inv(filmed.head_to_camera()), [], 0
    poses[:, :3, :3] = poses[:, :3, :3] @ AXES
    for number, timestep in enumerate(track_progress(order, "write pictures", len(order))):
        write_jpg(folder / f"ori_imgs/{number}.jpg", filmed.image(timestep))
        write_jpg(folder / f"head_imgs/{number}.jpg", filmed.over_white(timestep))
        classes = np.zeros((*filmed.matte(timestep).shape, 3), np.uint8)
        classes[filmed.matte(timestep) > 127] = _HEAD
        write_png(folder / f"parsing/{number}.png", classes)
        points = filmed.sequence.capture.landmarks[timestep, 0]
        if np.isfinite(points).all():
            np.savetxt(folder / f"ori_imgs/{number}.lms", points, "%.3f")
        without += not np.isfinite(points).all()
        row = rows[timestep]
        frames.append({"img_id": number, "exp_ori": values[row].tolist(), "transform_matrix": poses[row].tolist()})
    K, (width, height) = filmed.K, filmed.size
    # Rays go through whole pixels there.
    camera = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2] - 0.5, "cy": K[1, 2] - 0.5}
    write_plain_json(folder / "transforms.json", {"h": height, "w": width, **camera, "frames": frames})
    write_jpg(folder / "bc.jpg", np.full((height, width, 3), 255, np.uint8))
    trained = values[[rows[timestep] for timestep in filmed.trained]]
    for name, bound in (("max", trained.max(0)), ("min", trained.min(0))):
        np.savetxt(folder / f"{name}_{_NUMBERS}.txt", bound)
    names = {(timestep, 0): str(len(filmed.trained) + index) for index, timestep in enumerate(filmed.held_out)}
    return Written(
        names,
        (
            f"The first {len(filmed.trained)} pictures are trained on: run its training with --test_start "
            f"{len(filmed.trained)}. Without it, the program holds out the last 500.",
            "head_imgs are over white, as bc.jpg is. The world has the head at rest; its unit is the metre.",
            "Lost: soft edges of mattes, and the last digits of pixels, because the program reads .jpg.",
            *[f"Not written: .lms of {without} pictures without landmarks, which the program needs."][: without > 0],
            *told,
        ),
    )
