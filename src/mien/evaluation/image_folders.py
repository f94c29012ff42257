"""Scores for pictures of any program, by the code that scores avatars. Folders match by name, videos by order."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from mien.camera import Box
from mien.disk.files import read_json, write_json
from mien.disk.reading import listed
from mien.errors import UserError
from mien.evaluation.scoring import (
    PIXELS,
    SSIM_WINDOW,
    Scores,
    ScoreSettings,
    lpips_metric,
    mean_scores,
    perceptual_metric,
    score_pictures,
    worker_threads,
)
from mien.machine.parallel import stream_in_threads
from mien.machine.progress import progress_bar, say
from mien.media.decoding import decode_picture
from mien.media.video import read_video_frames
from mien.tracking.scoring import head_crop
from mien.training.footage.frames import evenly_spread
from mien.training.footage.sequence import composite

_ENDINGS = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")
CROPS_NAME = "crops.json"
Background = Literal["white", "black"]
_COLORS = {"white": 255, "black": 0}


@dataclass(frozen=True)
class PictureSource:
    """A folder of pictures, or a video."""

    path: Path
    count: int
    files: dict[str, Path] | None
    """Files by their names without endings, in order. None for a video."""

    def read(self, names: Sequence[str]) -> Iterator[UInt8[np.ndarray, "h w _"]]:
        """Yield the pictures of these names, with 3 or 4 channels. A video's pictures come in order."""
        if self.files is None:
            yield from itertools.islice((picture for _, picture in read_video_frames(self.path)), len(names))
            return
        in_order = len(names) == self.count and any(name not in self.files for name in names)
        for name in self.files if in_order else names:
            yield read_picture(self.files[name])


def open_pictures(path: Path) -> PictureSource:
    """Open the pictures at a path."""
    if path.is_file():
        count = sum(1 for _ in read_video_frames(path))
        say(f"warning: {path}: video compression changes pixels; png pictures give more accurate figures")
        return PictureSource(path, count, None)
    if not path.is_dir():
        raise UserError(f"{path}: no such folder; name a folder of pictures, or a video")
    files: dict[str, Path] = {}
    for file in listed(path):
        if file.suffix.lower() not in _ENDINGS:
            continue
        if file.stem in files:
            raise UserError(
                f"{path}: contains both {files[file.stem].name} and {file.name}; keep one picture of each name"
            )
        files[file.stem] = file
    if not files:
        raise UserError(f"{path}: contains no picture; give files that end in {', '.join(_ENDINGS)}")
    return PictureSource(path, len(files), files)


def read_picture(path: Path) -> UInt8[np.ndarray, "h w _"]:
    """A picture of 8 bits per channel as RGB or RGBA. Grey becomes RGB."""
    try:
        # libpng would return the upper half of a truncated file.
        cut = path.suffix.lower() == ".png" and path.read_bytes()[-8:] != b"IEND\xaeB`\x82"
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); check the file") from None
    picture = None if cut else decode_picture(path, cv2.IMREAD_UNCHANGED)
    if picture is None:
        raise UserError(f"{path}: is not a complete picture; write it again")
    if picture.dtype != np.uint8:
        raise UserError(f"{path}: has {picture.dtype} values; convert it to 8 bits a channel")
    if picture.ndim == 2:
        return np.repeat(picture[..., None], 3, axis=2)
    order = [2, 1, 0, 3][: picture.shape[2]]
    return np.ascontiguousarray(picture[..., order])


@dataclass(frozen=True)
class ImageFolders:
    """The pictures to compare."""

    images: Path
    """Folder of pictures, or a video."""
    truth: Path
    """Folder of the true pictures, or a video."""
    mattes: Path | None = None
    """Folder of opacity pictures. The truth counts where they are white; elsewhere it is replaced by `background`."""
    crops: Path | None = None
    """crops.json with a head box for each picture. None means the file in the folder `truth`, or else the boxes of the
    mattes."""
    background: Background = "white"
    """Colour behind pictures with an alpha channel, and behind the truth outside the mattes."""


_Pair = tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w 3"], Box | None]
"""A picture, its truth, and the box of the head."""


def score_folders(folders: ImageFolders, settings: ScoreSettings | None = None) -> dict[str, Any]:
    """Score pictures against their truth, matched by name, or for a video by order.

    The result has the means `psnr, ssim, l1, perceptual`, the same on the `head` crop (None if no crop is known), how
    they were computed, and `per_frame` figures.
    """
    settings = settings or ScoreSettings()
    pairs = _Pairs(folders)
    metric, lpips = perceptual_metric(settings), lpips_metric(settings)
    judged = set(evenly_spread(range(len(pairs.names)), settings.perceptual_frames))

    def score(job: tuple[int, _Pair]) -> Scores:
        index, (image, truth, crop) = job
        judges = (metric, lpips) if index in judged else (None, None)
        return score_pictures({"image": _floats(image)}, _floats(truth), crop, judges[0], lpips=judges[1])["image"]

    rows: list[Scores] = []
    with progress_bar("score", len(pairs.names)) as advance:
        for row in stream_in_threads(score, enumerate(pairs.read()), worker_threads(settings.threads)):
            rows.append(row)
            advance()
    return {
        **mean_scores(rows),
        "perceptual_backbone": settings.backbone if settings.perceptual else None,
        "perceptual_frames": sum("perceptual" in row for row in rows),
        **({} if lpips is None else {"lpips_backbone": lpips.backbone}),
        "frames": len(rows),
        "crop": pairs.crop_source,
        "mask": "none: whole pictures" if folders.mattes is None else f"mattes, over {folders.background}",
        "ssim_window": SSIM_WINDOW,
        "pixels": PIXELS,
        "per_frame": {"name": pairs.names, **{key: [row.get(key) for row in rows] for key in rows[0]}},
    }


def write_scores(path: Path, scores: dict[str, Any]) -> None:
    """Write the result of `score_folders`."""
    write_json(path, "mien.scores", 1, scores)


def write_crops(path: Path, crops: dict[str, Box]) -> None:
    """Write the head boxes (left, top, width, height) of named pictures."""
    write_json(path, "mien.crops", 1, {"crops": {name: list(box) for name, box in crops.items()}})


def read_crops(path: Path) -> dict[str, Box]:
    """Read what `write_crops` wrote."""
    try:
        crops = read_json(path, "mien.crops", 1).get("crops")
    except UserError as error:
        # The file is beside the user's own pictures, so there is no folder to delete and no stage to run.
        raise UserError(f"{str(error).split('; ')[0]}; write it again, or leave it out") from None
    boxes: dict[str, Box] = {}
    given: Any = crops.items() if isinstance(crops, dict) else [("", None)]
    for name, box in given:
        whole = isinstance(box, list) and all(type(each) is int and abs(each) <= 1_000_000 for each in box)
        if not whole or len(box) != 4 or min(box[2:]) < 1:
            raise UserError(f"{path}: {name!r} has no box of 4 numbers (left, top, width, height); write it again")
        boxes[name] = (box[0], box[1], box[2], box[3])
    return boxes


class _Pairs:
    """Pictures and their truth in order, read one after the other."""

    def __init__(self, folders: ImageFolders) -> None:
        self._folders = folders
        self._images, self._truth = open_pictures(folders.images), open_pictures(folders.truth)
        self._mattes = None if folders.mattes is None else open_pictures(folders.mattes)
        self.names = _matched(self._truth, self._images)
        if self._mattes is not None:
            _matched(self._truth, self._mattes)
        own = folders.truth / CROPS_NAME
        crops_path = folders.crops or (own if own.is_file() else None)
        self._crops = None if crops_path is None else read_crops(crops_path)
        without = [name for name in self.names if self._crops is not None and name not in self._crops]
        if without:
            raise UserError(f"{crops_path}: has no head box for {_listed(without)}; write one for every picture")
        known = "box of each matte" if self._mattes is not None else None
        self.crop_source = known if crops_path is None else "frozen head box of each frame"

    def read(self) -> Iterator[_Pair]:
        """Yield every picture with its truth."""
        color = np.full(3, _COLORS[self._folders.background], np.uint8)
        images = self._images.read(self.names)
        truths = self._truth.read(self.names)
        mattes = None if self._mattes is None else self._mattes.read(self.names)
        surround: list[float] = []
        for name in self.names:
            image, truth = _flat(next(images), color), _flat(next(truths), color)
            self._check_size(name, image, truth, self._folders.images)
            crop = None if self._crops is None else self._crops[name]
            if mattes is not None:
                picture = next(mattes)
                matte = np.ascontiguousarray(picture[..., 3 if picture.shape[2] == 4 else 1])  # opacity, or brightness
                self._check_size(name, matte, truth, self._folders.mattes)
                truth = composite(truth, matte, color)
                crop = crop or _box(matte)
                if (matte == 0).any():
                    surround.append(float(np.abs(image[matte == 0].astype(np.int16) - int(color[0])).mean()))
            if crop is not None and not _meets(crop, truth):
                raise UserError(f"{name}: the head box {crop} is outside the picture; write {CROPS_NAME} again")
            yield image, truth, crop
        if surround and float(np.mean(surround)) > 64:
            say(
                f"warning: {self._folders.images}: pictures are not {self._folders.background} where the mattes are "
                "empty, which lowers PSNR; render them over that colour, or set --background"
            )

    def _check_size(self, name: str, picture: np.ndarray, truth: np.ndarray, folder: Path | None) -> None:
        if picture.shape[:2] != truth.shape[:2]:
            sizes = [f"{shape[1]}x{shape[0]}" for shape in (picture.shape, truth.shape)]
            raise UserError(
                f"{folder}: {name} has {sizes[0]} pixels, and its truth has {sizes[1]}; give them one size (mien "
                "does not resize pictures, because that would change the figures)"
            )


def _matched(truth: PictureSource, images: PictureSource) -> list[str]:
    """The names to score, in order. They are the names of the truth."""
    if truth.files is None or images.files is None:
        # Frames of a video have no names, so they match by order.
        if truth.count != images.count:
            raise UserError(
                f"{images.path}: has {images.count} pictures, {truth.path} has {truth.count}; videos are matched by "
                "order, so give equal numbers"
            )
        return list(truth.files or images.files or (f"{index:06d}" for index in range(truth.count)))
    missing = sorted(set(truth.files) - set(images.files))
    if missing:
        raise UserError(
            f"{images.path}: lacks {len(missing)} of the {truth.count} pictures of {truth.path} ({_listed(missing)}; "
            f"it has {_listed([*images.files])}); give pictures the names of their truths"
        )
    extra = len(images.files) - len(truth.files)
    if extra:
        say(f"warning: {images.path}: {extra} pictures have no truth in {truth.path} and are left out")
    return list(truth.files)


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")


def _floats(image: UInt8[np.ndarray, "h w 3"]) -> Float[Tensor, "h w 3"]:
    return torch.from_numpy(image).float() / 255


def _flat(picture: UInt8[np.ndarray, "h w _"], color: UInt8[np.ndarray, " 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """The picture over a colour, without its alpha channel if it has one."""
    if picture.shape[2] == 4:
        return composite(picture[..., :3], picture[..., 3], color)
    return picture


def _box(matte: UInt8[np.ndarray, "h w"]) -> Box:
    left, top, width, height = (int(value) for value in head_crop(matte))
    return left, top, width, height


def _meets(box: Box, picture: np.ndarray) -> bool:
    left, top, width, height = box
    return left < picture.shape[1] and top < picture.shape[0] and left + width > 0 and top + height > 0
