"""The folder of a layout: the writer's files, README.txt, and `scoring` with what the pictures are scored against."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from mien.camera import Box
from mien.datasets.layouts.filmed import Filmed
from mien.datasets.layouts.layout import Layout, Written, check_new_folder
from mien.disk.files import cannot_write, replace_folder
from mien.disk.reading import remove_tree
from mien.errors import UserError
from mien.evaluation.image_folders import CROPS_NAME, write_crops
from mien.machine.terminal import counted
from mien.media.picture_files import encode_picture, write_png
from mien.tracking.scoring import head_crop

README = "README.txt"
SCORING = "scoring"


def write_layout(folder: Path, filmed: Filmed, layout: Layout) -> str:
    """Write a capture into a new folder, and return what is told of it in one line.

    The folder appears as a whole. README.txt says what it holds, and `scoring/truth` has the held-out pictures.
    """
    check_new_folder(folder)
    _check_fit(filmed, layout)
    place = folder.absolute()
    partial = place.with_name(f".{place.name}.partial")
    aside = partial / place.name  # one level deeper, because a layout has the folder's name in it once more
    try:
        remove_tree(partial)
        aside.mkdir(parents=True)
        written = layout.write(aside, filmed)
        _write_truth(aside / SCORING / "truth", filmed, written)
        (aside / README).write_text(_readme(filmed, layout, written), encoding="utf-8")
        replace_folder(place, aside)
    except OSError as error:
        raise cannot_write(folder, error) from None
    except UserError as error:
        raise UserError(str(error).replace(str(aside), str(folder))) from None
    finally:
        remove_tree(partial)
    cameras = len(filmed.sequence.capture.camera_ids)
    seen = f", {cameras} cameras" if cameras > 1 else ""
    return f"{counted(len(filmed.trained), 'training frame')}, {len(filmed.held_out)} held out{seen}; see {README}"


def write_jpg(path: Path, picture: UInt8[np.ndarray, "h w *c"]) -> None:
    """Write a grey or an RGB picture as .jpg, with as little loss as that has."""
    path.parent.mkdir(parents=True, exist_ok=True)
    best = (cv2.IMWRITE_JPEG_QUALITY, 100, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)
    path.write_bytes(encode_picture(picture, ".jpg", best))


def write_plain_json(path: Path, content: Any) -> None:
    """Write json as other programs read it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=1), encoding="utf-8")


def _check_fit(filmed: Filmed, layout: Layout) -> None:
    capture, model = filmed.sequence.capture, filmed.face_model
    if layout.one_camera and len(capture.camera_ids) > 1:
        raise UserError(
            f"{capture.name}: has {len(capture.camera_ids)} cameras, and the layout {layout.name} holds one; use "
            "--format nersemble, or capture the video of one camera by itself"
        )
    if layout.needs_flame and model.flame_origin is None:
        raise UserError(
            f"{capture.name}: is tracked on {model.name!r}, and programs of the layout {layout.name} pose FLAME "
            "themselves; track it with `mien track DIR --face-model FILE.pkl` (docs/face_models.md), or use --format "
            "insta or nerface"
        )


def _write_truth(folder: Path, filmed: Filmed, written: Written) -> None:
    crops: dict[str, Box] = {}
    for place in filmed.scored():
        name = written.names[place]
        left, top, width, height = (int(each) for each in head_crop(np.asarray(filmed.sequence.scoring[place])))
        crops[name] = (left, top, width, height)
        write_png(folder / f"{name}.png", filmed.truth(*place))
    if crops:
        write_crops(folder / CROPS_NAME, crops)


def _readme(filmed: Filmed, layout: Layout, written: Written) -> str:
    capture, model = filmed.sequence.capture, filmed.face_model
    left_out = capture.timesteps - len(filmed.timesteps)
    kind = "the head above mien's cut at the neck" if filmed.matte_kind == "head" else "the person"
    flame = "FLAME, as far as its schema tells" if model.flame_origin is not None else "not FLAME"
    lines = [
        f"The capture {capture.name}, written by mien in the layout of {layout.about}.",
        "",
        f"Frames: {len(filmed.trained)} for training, {len(filmed.held_out)} held out, {capture.fps:g} per second.",
        f"Left out: {counted(left_out, 'frame')} without a face, blurred or covered, which mien does not train on.",
        f"Face model: {model.name} ({flame}; content hash {model.content_hash}).",
        f"Mattes: {kind}.",
        *written.told,
    ]
    if filmed.scored():
        lines += [
            "",
            f"Score pictures of another program as mien's own ({SCORING}/truth has the held-out pictures over white):",
            f"    mien evaluate images PICTURES {SCORING}/truth",
            "PICTURES is a folder of pictures over white, with the same names.",
        ]
    return "\n".join(lines) + "\n"
