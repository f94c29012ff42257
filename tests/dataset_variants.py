"""Variants of layouts that other programs read, made of what `dataset_writers` writes. Nothing calls the importers."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch

import dataset_writers
from dataset_scene import Scene, draw, head_view
from dataset_writers import npz, write_imavatar, write_insta, write_picture, write_vhap


def write_gaussian_blendshapes(folder: Path, scene: Scene) -> Path:
    """Write a subject of GaussianBlendshapes or RGBAvatar: pictures with opacities, and checkpoints."""
    write_insta(folder, scene)
    (folder / "transforms.json").unlink()
    return folder


def _split_opacity(folder: Path) -> dict[str, np.ndarray]:
    """Take the opacity out of all pictures of a folder, and return it by their names."""
    found = {}
    for file in sorted(folder.glob("*.png")):
        pixels = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        assert pixels is not None
        assert cv2.imwrite(str(file), pixels[..., :3])
        found[file.name] = pixels[..., 3]
    return found


def write_tracker_output(folder: Path, scene: Scene) -> Path:
    """Write what metrical-tracker leaves: pictures without opacities, and checkpoints."""
    write_gaussian_blendshapes(folder, scene)
    (folder / "images").rename(folder / "input")
    _split_opacity(folder / "input")
    return folder


def write_masked(folder: Path, scene: Scene, channels: int = 1) -> Path:
    """Write GaussianBlendshapes' copy of a person of NeRFBlendShape: masks beside the pictures, and the empty scene."""
    write_gaussian_blendshapes(folder, scene)
    for name, matte in _split_opacity(folder / "images").items():
        write_picture(folder / f"image_mask/mask_{name}", np.repeat(matte[..., None], channels, -1))
    assert cv2.imwrite(str(folder / "bc.jpg"), np.full((dataset_writers.SIDE, dataset_writers.SIDE, 3), 255, np.uint8))
    return folder


def enlarged(K: np.ndarray, factor: int) -> np.ndarray:
    """Return intrinsics for pictures with `factor` times as many pixels on each side."""
    return K * np.array([[factor], [factor], [1.0]])


def draw_larger(scene: Scene, timestep: int, factor: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a picture and its matte with `factor` times as many pixels on each side as the tracker saw."""
    vertices, side = scene.vertices(timestep, root=False, neck=False), factor * dataset_writers.SIDE
    return draw(scene, vertices, enlarged(dataset_writers.OFF_CENTRE, factor), *head_view(timestep), (side, side))


def write_larger(folder: Path, scene: Scene, factor: int = 2) -> Path:
    """Write a subject whose pictures are larger than those that were tracked."""
    write_gaussian_blendshapes(folder, scene)
    for timestep, file in enumerate(sorted((folder / "images").glob("*.png"))):
        write_picture(folder / f"images.HQ/{file.name}", *draw_larger(scene, timestep, factor))
        file.unlink()
    (folder / "images").rmdir()
    return folder


def write_splatting_avatar(folder: Path, scene: Scene, name: str = "bala") -> Path:
    """Write a subject of SplattingAvatar: one clip of IMavatar's layout, whose pictures have opacities."""
    clip = write_imavatar(folder / "x", scene, ("clip",)) / "x/clip"
    subject = folder / name
    for file in sorted((clip / "image").glob("*.png")):
        pixels, matte = (cv2.imread(str(each)) for each in (file, clip / "mask" / file.name))
        assert pixels is not None
        assert matte is not None
        write_picture(subject / "images" / file.name, pixels[..., ::-1], matte[..., 0])
    content = json.loads((clip / "flame_params.json").read_text())
    for frame in content["frames"]:
        frame["file_path"] = frame["file_path"].replace("image/", "images/")
    (subject / "flame_params.json").write_text(json.dumps(content))
    return subject


def write_union(folder: Path, scene: Scene, names: tuple[str, str] = ("306_EMO-1", "306_EXP-2")) -> Path:
    """Write two exports of VHAP, and beside them a UNION folder, whose timesteps go on in the second.

    The second sequence is held out, and of the first the last camera.
    """
    parts: dict[str, list[dict]] = {"train": [], "val": [], "test": []}
    for index, name in enumerate(names):
        export = write_vhap(folder / name, scene)
        for frame in json.loads((export / "transforms.json").read_text())["frames"]:
            frame["timestep_index"] += index * len(scene)
            for key in ("file_path", "fg_mask_path", "flame_param_path"):
                frame[key] = f"../{name}/{frame[key]}"
            parts["test" if index else "val" if frame["camera_index"] else "train"].append(frame)
    union = folder / "UNION2_306"
    union.mkdir()
    for part, frames in parts.items():
        (union / f"transforms_{part}.json").write_text(json.dumps({"frames": frames}))
    return union


def with_static_offset(scene: Scene, metres: float = 1e-3) -> tuple[Scene, np.ndarray]:
    """Return the scene of a person whose head at rest differs from the model's, and by how much [v, 3]."""
    template = scene.arrays["v_template"]
    random = np.random.default_rng(0)
    offset = (metres * random.standard_normal(template.shape)).astype(np.float32)
    return replace(scene, arrays={**scene.arrays, "v_template": template + offset}), offset


def write_offset(folder: Path, scene: Scene, metres: float = 1e-3) -> tuple[Path, Scene]:
    """Write an export of VHAP with `static_offset`. Return it and the scene of the person that it shows."""
    shown, offset = with_static_offset(scene, metres)
    write_vhap(folder, shown)
    for file in sorted((folder / "flame_param").glob("*.npz")):
        file.write_bytes(npz({**np.load(file), "static_offset": offset[None]}))
    return folder, shown


TEETH = 120


def lip_rings(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return 15 vertices of the upper and of the lower lip, from the subject's left to the right."""
    template = scene.arrays["v_template"]
    middle = scene.marks(template)[13]
    rings = []
    for above in (0.006, -0.006):
        wanted = middle + np.stack([np.linspace(0.02, -0.02, 15), np.full(15, above), np.zeros(15)], axis=1)
        rings.append(np.linalg.norm(template[:, None] - wanted, axis=-1).argmin(0))
    return rings[0], rings[1]


def with_teeth(scene: Scene, triangles: np.ndarray) -> Scene:
    """Return the scene of a model with GaussianAvatars' teeth: eight rows of 15 vertices, made from rings of the lips.

    The upper rows (0, 2, 4, 5) move with the neck joint, the others with the jaw. The colours are those of skin.
    """
    arrays = scene.arrays
    upper, lower = lip_rings(scene)
    top, bottom = (arrays["v_template"][ring] for ring in (upper, lower))
    size = float(np.mean(np.linalg.norm(top - bottom, axis=1)))
    edge = 0.5 * (top + bottom)
    edge[:, 1] = edge[:, 1].mean()
    edge[:, 2] -= 1.5 * size
    high, low = edge + np.array([0, 0.1, 0]) * size, edge - np.array([0, 0.1, 0.4]) * size
    front = {0: high + np.array([0, 2, 0]) * size, 1: low - np.array([0, 2, 0]) * size, 2: high, 3: low}
    back = {4: front[0], 5: front[2], 6: front[1], 7: front[3]}
    rows = [*front.values(), *(row - np.array([0, 0, size]) for row in back.values())]
    shapes = np.tile((arrays["shapedirs"][upper] + arrays["shapedirs"][lower]) / 2, (8, 1, 1))
    shapes[..., int(arrays["identities"]) :] = 0
    weights = np.zeros((TEETH, 5))
    for row in range(8):
        weights[15 * row : 15 * row + 15, 1 if row in (0, 2, 4, 5) else 2] = 1
    grown = {
        "v_template": np.concatenate([arrays["v_template"], *rows]),
        "f": np.concatenate([arrays["f"], triangles + len(arrays["v_template"])]).astype(np.uint32),
        "shapedirs": np.concatenate([arrays["shapedirs"], shapes]),
        "posedirs": np.concatenate([arrays["posedirs"], np.zeros((TEETH, *arrays["posedirs"].shape[1:]))]),
        "J_regressor": np.concatenate([arrays["J_regressor"], np.zeros((5, TEETH))], axis=1),
        "weights": np.concatenate([arrays["weights"], weights]),
    }
    colors = torch.cat([scene.colors, torch.full((TEETH, 3), 0.7)])
    return replace(scene, arrays={**arrays, **grown}, colors=colors)
