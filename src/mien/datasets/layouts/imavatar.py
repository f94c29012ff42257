"""IMavatar's layout: clips `train` and `test` with flame_params.json, in a world four times as large as FLAME."""

from pathlib import Path
from typing import Any

import numpy as np

from mien.datasets.layouts.filmed import Filmed, as_flame, lost_words
from mien.datasets.layouts.layout import Written
from mien.datasets.layouts.writing import write_plain_json
from mien.errors import UserError
from mien.machine.progress import track_progress
from mien.media.picture_files import write_png

_SHAPES, _EXPRESSIONS = 100, 50
_SCALE = 4.0
_POSES = ("rotation", "neck_pose", "jaw_pose", "eyes_pose")


def write(folder: Path, filmed: Filmed) -> Written:
    """Write the files of a subject of IMavatar."""
    if "image" in folder.name:
        raise UserError(
            f"{folder}: programs of this layout replace every 'image' in a path by 'mask'; give --out another name"
        )
    whole, arrays, _, shifts = as_flame(folder, filmed, filmed.face(), _POSES, _SHAPES, _EXPRESSIONS)
    lost = [*lost_words("identity", whole["shape"], _SHAPES), *lost_words("expression", whole["expr"], _EXPRESSIONS)]
    if whole["static_offset"].any():
        lost.append("Lost: the offsets of the mesh, for which the layout has no place.")
    rows = {timestep: index for index, timestep in enumerate(filmed.timesteps)}
    poses = np.concatenate([arrays[name] for name in _POSES], axis=1)
    subject = folder / folder.name
    for clip, timesteps in (("train", filmed.trained), ("test", filmed.held_out)):
        frames = []
        for number, timestep in enumerate(track_progress(timesteps, f"write {clip}", len(timesteps)), 1):
            row = rows[timestep]
            write_png(subject / clip / "image" / f"{number}.png", filmed.image(timestep))
            write_png(subject / clip / "mask" / f"{number}.png", filmed.matte(timestep))
            world = np.concatenate([np.eye(3), _SCALE * shifts[row][:, None]], axis=1)
            frames.append(
                {
                    "file_path": f"./image/{number}",
                    "world_mat": world.tolist(),
                    "expression": arrays["expr"][row].tolist(),
                    "pose": poses[row].tolist(),
                    "bbox": _box(filmed, timestep),
                }
            )
        if frames:
            content = {"intrinsics": _intrinsics(filmed), "shape_params": arrays["shape"].tolist(), "frames": frames}
            write_plain_json(subject / clip / "flame_params.json", content)
    names = {(timestep, 0): str(number) for number, timestep in enumerate(filmed.held_out, 1)}
    told = (
        f"{folder.name}/train is trained on; {folder.name}/test is held out. The subject's name is that of the folder.",
        "Parameters are those of the face model above. They are right for IMavatar only if it is FLAME 2020.",
        "world_mat has another translation in each frame, because the head moves.",
        "Loaders replace every 'image' in a path by 'mask', so no folder above may have 'image' in its name.",
        "Not written: semantic, iris.json, keypoint.json, code.json and flame_keypoints.",
        *lost,
    )
    return Written(names, told)


def _intrinsics(filmed: Filmed) -> list[float]:
    """Relative to the size of the picture, with a negative first one. Rays go through whole pixels."""
    K, (width, height) = filmed.K, filmed.size
    return [-K[0, 0] / width, K[1, 1] / height, (K[0, 2] - 0.5) / width, (K[1, 2] - 0.5) / height]


def _box(filmed: Filmed, timestep: int) -> list[float]:
    """The box of the detected landmarks in -1..1: left, top, right, bottom. The whole picture if no face was found."""
    points: Any = filmed.sequence.capture.landmarks[timestep, 0] / np.array(filmed.size) * 2 - 1
    if not np.isfinite(points).all():
        return [-1.0, -1.0, 1.0, 1.0]
    return [float(each) for each in np.clip([*points.min(0), *points.max(0)], -1, 1)]
