"""Write landmarks, mattes, crops, cameras and motion as other programs do, without checksums."""

import json
from pathlib import Path

import cv2
import numpy as np
import safetensors.numpy

from mien.driving.motion import ARKIT_NAMES
from mien.evaluation.image_folders import write_crops


def write_what_users_give(folder: Path, picture: np.ndarray) -> None:
    """Write one file of each kind, for three pictures of 32x32 pixels."""
    points = np.random.default_rng(0).uniform(0, 32, (3, 478, 2)).astype(np.float32)
    points[1] = np.nan
    folder.mkdir()
    safetensors.numpy.save_file({"landmarks": points}, folder / "points.safetensors")
    rows = [",".join(f"{value:.3f}" for value in row) for row in points.reshape(3, -1)]
    (folder / "points.csv").write_text("\n".join(rows) + "\n")
    (folder / "mattes").mkdir()
    for index in range(3):
        assert cv2.imwrite(str(folder / f"mattes/{index}.png"), picture[..., 0])
    write_crops(folder / "crops.json", {f"{index}.png": (4, 4, 20, 20) for index in range(3)})
    camera = {"K": [[40, 0, 16], [0, 40, 16], [0, 0, 1]], "viewmat": np.eye(4).tolist(), "width": 32, "height": 32}
    cameras = {"format": "mien.cameras", "version": 1, "cameras": [camera, camera]}
    (folder / "cameras.json").write_text(json.dumps(cameras))
    columns = ["Timecode", "BlendshapeCount", *(name[0].upper() + name[1:] for name in ARKIT_NAMES), "HeadYaw"]
    takes = [[f"0:00:0{frame}:00.0", "61", *["0.25"] * 53] for frame in range(4)]
    (folder / "take.csv").write_text("\n".join(",".join(cells) for cells in (columns, *takes)) + "\n")
    plain = [{"timestamp_ms": 40 * frame, "blendshapes": {"jawOpen": 0.5}} for frame in range(3)]
    (folder / "take.json").write_text(json.dumps(plain))
    categories = [{"categoryName": "jawOpen", "score": 0.5}]
    matrix = {"rows": 4, "columns": 4, "data": np.eye(4).flatten().tolist()}
    result = {"faceBlendshapes": [{"categories": categories}], "facialTransformationMatrixes": [matrix]}
    (folder / "landmarker_take.json").write_text(json.dumps(result))
