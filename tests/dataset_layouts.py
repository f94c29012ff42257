"""The layouts of datasets that are tracked on FLAME: who writes each, and which heads and cameras come back.

None was tried with real files of variants. Their folders follow the loaders of the programs that they are named after.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

import dataset_scene
import dataset_writers as writers
from dataset_scene import Scene, draw, head_view
from mien.training.settings.splits import OwnSplit

View = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Intrinsics, and the rotation and translation from the world to a camera with OpenCV's axes."""


def draw_at(factor: float, patch: pytest.MonkeyPatch) -> None:
    """Let writers draw so many times as many pixels on each side."""
    side = round(factor * writers.SIDE)
    for module in (dataset_scene, writers):
        patch.setattr(module, "SIDE", side)
    for name in ("OFF_CENTRE", "UNEQUAL"):
        patch.setattr(writers, name, enlarged(getattr(writers, name), factor))


def write_gaussian_blendshapes(folder: Path, scene: Scene) -> Path:
    """Write a subject of GaussianBlendshapes or RGBAvatar: pictures with opacities, and checkpoints."""
    writers.write_insta(folder, scene)
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
        writers.write_picture(folder / f"image_mask/mask_{name}", np.repeat(matte[..., None], channels, -1))
    assert cv2.imwrite(str(folder / "bc.jpg"), np.full((writers.SIDE, writers.SIDE, 3), 255, np.uint8))
    return folder


def enlarged(K: np.ndarray, factor: float) -> np.ndarray:
    """Return intrinsics for pictures with `factor` times as many pixels on each side."""
    return K * np.array([[factor], [factor], [1.0]])


def draw_larger(scene: Scene, timestep: int, factor: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a picture and its matte with `factor` times as many pixels on each side as the tracker saw."""
    vertices, side = scene.vertices(timestep, root=False, neck=False), factor * writers.SIDE
    return draw(scene, vertices, enlarged(writers.OFF_CENTRE, factor), *head_view(timestep), (side, side))


def write_larger(folder: Path, scene: Scene, factor: int = 2) -> Path:
    """Write a subject whose pictures are larger than those that were tracked."""
    write_gaussian_blendshapes(folder, scene)
    for timestep, file in enumerate(sorted((folder / "images").glob("*.png"))):
        writers.write_picture(folder / f"images.HQ/{file.name}", *draw_larger(scene, timestep, factor))
        file.unlink()
    (folder / "images").rmdir()
    return folder


def write_splatting_avatar(subject: Path, scene: Scene) -> Path:
    """Write a subject of SplattingAvatar: one clip of IMavatar's layout, whose pictures have opacities."""
    clip = writers.write_imavatar(subject.with_name("x"), scene, ("clip",)) / "x/clip"
    for file in sorted((clip / "image").glob("*.png")):
        pixels, matte = (cv2.imread(str(each)) for each in (file, clip / "mask" / file.name))
        assert pixels is not None
        assert matte is not None
        writers.write_picture(subject / "images" / file.name, pixels[..., ::-1], matte[..., 0])
    content = json.loads((clip / "flame_params.json").read_text())
    for frame in content["frames"]:
        frame["file_path"] = frame["file_path"].replace("image/", "images/")
    (subject / "flame_params.json").write_text(json.dumps(content))
    return subject


UNITED = ("306_EMO-1", "306_EXP-2")


def write_union(union: Path, scene: Scene) -> Path:
    """Write a UNION folder, and beside it two exports of VHAP, whose timesteps go on in the second.
    The second sequence is held out, and of the first the last camera."""
    parts: dict[str, list[dict]] = {"train": [], "val": [], "test": []}
    for index, name in enumerate(UNITED):
        export = writers.write_vhap(union.with_name(name), scene)
        for frame in json.loads((export / "transforms.json").read_text())["frames"]:
            frame["timestep_index"] += index * len(scene)
            for key in ("file_path", "fg_mask_path", "flame_param_path"):
                frame[key] = f"../{name}/{frame[key]}"
            parts["test" if index else "val" if frame["camera_index"] else "train"].append(frame)
    union.mkdir()
    for part, frames in parts.items():
        (union / f"transforms_{part}.json").write_text(json.dumps({"frames": frames}))
    return union


def with_static_offset(scene: Scene) -> tuple[Scene, np.ndarray]:
    """Return the scene of a person whose head at rest differs from the model's, and by how much [v, 3]."""
    template = scene.arrays["v_template"]
    offset = (1e-3 * np.random.default_rng(0).standard_normal(template.shape)).astype(np.float32)
    return replace(scene, arrays={**scene.arrays, "v_template": template + offset}), offset


def write_offset(folder: Path, scene: Scene) -> Path:
    shown, offset = with_static_offset(scene)
    writers.write_vhap(folder, shown)
    for file in sorted((folder / "flame_param").glob("*.npz")):
        file.write_bytes(writers.npz({**np.load(file), "static_offset": offset[None]}))
    return folder


# The table -----------------------------------------------------------------------------------------------------------


def _tracker_view(timestep: int, _: int, factor: int = 1) -> View:
    return enlarged(writers.OFF_CENTRE, factor), *head_view(timestep)


@dataclass(frozen=True)
class Layout:
    """A layout, what its writer means by it, and what comes back. The writer's folder is called `me`."""

    write: Callable[[Path, Scene], Path]
    reads: str = "insta"
    """The importer that recognises it."""
    vertices: Callable[[Scene, int], np.ndarray] = lambda scene, timestep: scene.vertices(timestep, False, False)
    """Vertices of a timestep in the writer's world."""
    view: Callable[[int, int], View] = _tracker_view
    """The camera of a timestep."""
    clips: dict[str, range] = field(default_factory=lambda: {"me": range(6)})
    """Sequences, with the timesteps of each."""
    splits: tuple[OwnSplit | None, ...] = (None,)
    """Frames that the authors hold out of each sequence."""
    cameras: tuple[str, ...] = ("0",)
    size: tuple[int, int] | None = None
    """Width and height of the pictures, if they are not the usual ones."""
    shown: Callable[[Scene], Scene] = lambda scene: scene
    """The scene of the person in the pictures."""
    retracked: bool = False
    """Whether it has the tracker's camera, for the pictures to be tracked again."""


_RIG = ("222200036", "222200037")
_TALL = (writers.SIDE, 136)
_PART = OwnSplit(((5, 6),), _RIG[1:])
_VHAP = Layout(
    writers.write_vhap, "vhap", Scene.vertices, lambda _, camera: (writers.UNEQUAL, *head_view(2 + camera, 1.0)),
    splits=(_PART,), cameras=_RIG, size=_TALL,
)  # fmt: skip
_IMAVATAR = Layout(
    write_splatting_avatar, "imavatar", lambda scene, timestep: scene.vertices(timestep) - scene.translation[timestep],
    lambda *_: (writers.UNEQUAL, writers.MIRROR, writers.MIRROR @ writers.IMAVATAR_PLACE / 4),
)  # fmt: skip

TRACKED = {
    "insta": Layout(writers.write_insta),
    "flash-avatar": Layout(writers.write_flash_avatar, retracked=True),
    "gaussian-blendshapes": Layout(write_gaussian_blendshapes, retracked=True),
    "masks": Layout(write_masked, retracked=True),
    "masks of three channels": Layout(partial(write_masked, channels=3), retracked=True),
    "imavatar": replace(
        _IMAVATAR, write=writers.write_imavatar, clips={"MVI_1810": range(3), "MVI_1812": range(3, 6)},
        splits=(OwnSplit(), OwnSplit(((0, 3),))),
    ),
    "splatting-avatar": _IMAVATAR,
    "vhap": _VHAP,
    "vhap, from below": replace(_VHAP, write=partial(writers.write_vhap, from_below=True)),
    "vhap, one camera": replace(
        _VHAP, write=partial(writers.write_vhap, cameras=("0",)), cameras=("0",), splits=(OwnSplit(((5, 6),)),)
    ),
    "vhap, a union": replace(
        _VHAP, write=write_union, clips=dict.fromkeys(UNITED, range(6)),
        splits=(OwnSplit((), _RIG[1:]), OwnSplit(((0, 6),))),
    ),
    "vhap, static offsets": replace(_VHAP, write=write_offset, shown=lambda scene: with_static_offset(scene)[0]),
    **{
        f"pictures {factor} times as large": Layout(
            partial(write_larger, factor=factor), view=partial(_tracker_view, factor=factor), retracked=True,
            size=(factor * writers.SIDE, factor * writers.SIDE),
        ) for factor in (2, 3)
    },
}  # fmt: skip
