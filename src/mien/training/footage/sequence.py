"""Sequence: what training needs of one filmed sequence, and the target pictures."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from mien import _native
from mien.arrays import is_native
from mien.camera import Box, Camera
from mien.capture.capture import Capture
from mien.capture.store import read_capture, read_capture_hash
from mien.disk.locks import read_beside_writers
from mien.errors import UserError
from mien.face.head_parts import part_boxes
from mien.face.model import FaceModel
from mien.tracking.files import check_tracking_of, read_tracking
from mien.tracking.scoring import Scoring
from mien.tracking.scoring_files import read_scoring
from mien.tracking.settings import Cut
from mien.tracking.tracking import Tracking
from mien.training.footage.foreground import soft_colors
from mien.training.footage.hidden import hidden_triangles

CACHE_BYTES = 1 << 30
_ON_CPU = torch.zeros(())


@dataclass(frozen=True, eq=False)
class Sequence:
    """One sequence: pictures, the tracked face, and the frozen mask of the pixels that are trained on and scored."""

    name: str
    capture: Capture
    tracking: Tracking
    scoring: UInt8[np.ndarray, "t c h w"]
    """Opacity of the pixels that count (the matte above the cut at the neck). 255 is opaque."""
    folder: Path | None = None
    """Folder that it was read from, for messages."""
    cut: Cut = "plane"
    """Lower end of what counts (`ScoringSettings.cut`)."""

    def usable(self) -> np.ndarray:
        """Bool [t, c]: the face was tracked, and was found in this picture, or the cameras are calibrated.

        A calibrated camera sees the tracked head even if it finds no face, for example from behind.
        """
        tracked = self.tracking.valid.numpy()[:, None]
        return (self.capture.valid | (self.capture.calibration is not None)) & tracked

    def sharp(self) -> np.ndarray:
        """Bool [t, c]: the capture did not mark the picture as blurred."""
        quality = self.capture.quality
        return np.ones(self.capture.valid.shape, bool) if quality is None else ~quality.blurred

    def clear(self) -> np.ndarray:
        """Bool [t, c]: nothing that the tracking found covers a part of the face, such as a hand."""
        return ~self.tracking.covered_pictures().numpy()


def composite(
    image: UInt8[np.ndarray, "h w 3"],
    matte: UInt8[np.ndarray, "h w"],
    background: UInt8[np.ndarray, " 3"],
    box: Box | None = None,
) -> UInt8[np.ndarray, "h w 3"]:
    """`image` over `background`, blended by the matte and rounded to the nearest integer.

    `box` promises that the matte is 0 outside of it; the image is not read there.
    """
    height, width = matte.shape
    picture = np.empty((height, width, 3), np.uint8)
    image, matte = np.ascontiguousarray(image), np.ascontiguousarray(matte)
    _native.composite(image, matte, background.tolist(), box or (0, 0, width, height), picture)
    return picture


@dataclass(frozen=True, eq=False)
class Target:
    """The picture that a rendering is compared with."""

    picture: UInt8[Tensor, "h w 3"]
    """The picture, composited on the rendering's background."""
    matte: UInt8[Tensor, "h w"]
    """Opacity of the pixels that count."""
    box: Box
    """Left, top, width and height of a box, in pixels. Outside it there is only background."""
    background: Float[Tensor, " 3"]
    """Colour of the background, 0..1."""
    parts: tuple[Box, ...] = ()
    """Boxes around eyes and mouth, as far as they are seen. Empty if no loss needs them."""
    hidden: Bool[Tensor, " f"] | None = None
    """Whether the mesh hides each triangle inside the head (`hidden_triangles`). None if nothing needs it."""

    def pinned(self) -> "Target":
        """This target in pinned memory, which a GPU can read asynchronously."""
        return self._each(Tensor.pin_memory)

    def to(self, like: Tensor) -> "Target":
        """This target on the device of `like`, with a background of its dtype. The copies are asynchronous."""
        moved = self._each(lambda own: own.to(like.device, non_blocking=True))
        return replace(moved, background=self.background.to(like, non_blocking=True))

    def _each(self, change: Callable[[Tensor], Tensor]) -> "Target":
        hidden = None if self.hidden is None else change(self.hidden)
        tensors = (change(self.picture), change(self.matte), self.box, change(self.background))
        return Target(*tensors, self.parts, hidden)


class Targets:
    """The pictures of one sequence at training resolution, composited.

    Pictures over a fixed background are cached, and of cleaned pictures over changing ones the soft pixels.
    `resolution` is the longer side in pixels, or 0 for the capture's own. `share` sequences share the memory of the
    cache. Cameras and targets have dtype and device of `like`. With a face model, targets have the boxes around eyes
    and mouth; with the triangles `inside` a head, they say which of these are hidden. `cleaned` soft edges have the
    colours of the person alone.
    """

    def __init__(
        self,
        sequence: Sequence,
        resolution: int,
        share: int = 1,
        like: Tensor = _ON_CPU,
        face_model: FaceModel | None = None,
        inside: Bool[Tensor, " f"] | None = None,
        *,
        cleaned: bool = False,
    ):
        self._sequence, self._cleaned = sequence, cleaned
        longest = max(sequence.capture.width, sequence.capture.height)
        scale = min(1.0, resolution / longest) if resolution > 0 else 1.0
        self.width = max(1, round(sequence.capture.width * scale))
        self.height = max(1, round(sequence.capture.height * scale))
        self.cameras_on_cpu = tuple(camera.resized(self.width, self.height) for camera in sequence.tracking.cameras)
        self.cameras = tuple(camera.to(like) for camera in self.cameras_on_cpu)
        self._like, self._share = like, share
        self._on_cpu = is_native(like)
        self._cache: dict[tuple[int, int, bytes], Target] = {}
        self._soft: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = {}
        """Indices of soft pixels, in rows, and their cleaned colours, by timestep and camera."""
        self._soft_room = CACHE_BYTES // share
        self._face_model, self._inside = face_model, inside
        self._boxes: dict[tuple[int, int], tuple[Box, tuple[Box, ...], Tensor | None]] = {}
        """Boxes of the mattes and of the parts, and hidden triangles, by timestep and camera."""
        self._max_cached = CACHE_BYTES // (share * self.width * self.height * 4)

    def halved(self) -> "Targets":
        """The same pictures at half the size."""
        half = (max(self.width, self.height) + 1) // 2
        how = (self._share, self._like, self._face_model, self._inside)
        return Targets(self._sequence, half, *how, cleaned=self._cleaned)

    def forget(self) -> None:
        """Free the cached pictures."""
        self._cache.clear()
        self._soft.clear()

    def camera(self, camera: int) -> Camera:
        """A camera at training resolution."""
        return self.cameras[camera]

    def target(self, timestep: int, camera: int, background: UInt8[np.ndarray, " 3"], keep: bool) -> Target:
        """The picture over a background. `keep` caches it, for use with the same background again."""
        kept = self.kept(timestep, camera, background)
        return self.moved(self.composed(timestep, camera, background, keep) if kept is None else kept)

    def kept(self, timestep: int, camera: int, background: UInt8[np.ndarray, " 3"]) -> Target | None:
        """The cached target in the CPU's memory, or None."""
        return self._cache.get((timestep, camera, background.tobytes()))

    def composed(self, timestep: int, camera: int, background: UInt8[np.ndarray, " 3"], keep: bool) -> Target:
        """The target, made anew in the CPU's memory. `keep` caches it. One other thread may do this."""
        target = self._compose(timestep, camera, background, again=not keep)
        if keep and len(self._cache) < self._max_cached:
            self._cache[timestep, camera, background.tobytes()] = target
        return target

    def moved(self, target: Target) -> Target:
        """The target with the dtype and device of the cameras."""
        return target if self._on_cpu else target.to(self._like)

    def _compose(self, timestep: int, camera: int, background: UInt8[np.ndarray, " 3"], *, again: bool) -> Target:
        image = self._image(timestep, camera, again=again)
        # A copy: the pages of a mapped file are given back.
        matte = np.array(self._resize(self._sequence.scoring[timestep, camera]))
        boxes = self._boxes.get((timestep, camera))
        if boxes is None:
            left, top, width, height = cv2.boundingRect(matte)
            boxes = self._boxes[timestep, camera] = (left, top, width, height), *self._tracked(timestep, camera)
        picture = composite(image, matte, background, boxes[0])
        color = torch.from_numpy(background.astype(np.float32) / np.float32(255))
        target = Target(torch.from_numpy(picture), torch.from_numpy(matte), boxes[0], color, *boxes[1:])
        return target if self._like.is_cpu else target.pinned()

    def _image(self, timestep: int, camera: int, *, again: bool) -> UInt8[np.ndarray, "h w 3"]:
        """The picture at training resolution. `again` says that another background will need it."""
        capture = self._sequence.capture
        image = self._resize(capture.images[timestep, camera])
        if not self._cleaned:
            return image
        image, kept = np.array(image), self._soft.get((timestep, camera))
        if kept is None:
            # A copy: the pages of a mapped file are given back.
            matte = np.array(self._resize(capture.mattes[timestep, camera]))
            kept = soft_colors(image, matte)
            size = sum(part.nbytes for part in kept)
            if again and size <= self._soft_room:
                self._soft_room -= size
                self._soft[timestep, camera] = kept
        place, colors = kept
        image.reshape(-1, 3)[place] = colors
        return image

    @torch.no_grad()
    def _tracked(self, timestep: int, camera: int) -> tuple[tuple[Box, ...], Tensor | None]:
        """The boxes around eyes and mouth, and hidden triangles, by the tracking. Its corrections change neither."""
        if self._face_model is None:
            return (), None
        tracking = self._sequence.tracking
        vertices = self._face_model(tracking.face[timestep])[0]
        view = tracking.cameras[camera].resized(self.width, self.height)
        boxes = tuple(part_boxes(self._face_model, vertices, view).values())
        inside = self._inside
        return boxes, None if inside is None else hidden_triangles(vertices, self._face_model, inside, view)

    def _resize(self, picture: np.ndarray) -> np.ndarray:
        if picture.shape[:2] == (self.height, self.width):
            return picture
        return cv2.resize(np.array(picture), (self.width, self.height), interpolation=cv2.INTER_AREA)


def read_sequence(folder: Path) -> Sequence:
    """The sequence in FOLDER/{capture,tracking,scoring}. Its name is that of the folder."""
    parts = [folder / name for name in ("capture", "tracking", "scoring")]
    return read_beside_writers(lambda: _read_parts(folder), parts, [folder])


def _read_parts(folder: Path) -> Sequence:
    capture_hash = read_capture_hash(folder / "capture")
    sequence = sequence_of(folder, read_scoring(folder / "scoring", capture_hash))
    if read_capture_hash(folder / "capture") != capture_hash:
        raise UserError(f"{folder / 'capture'}: was replaced while it was read; run the same command again")
    return sequence


def sequence_of(folder: Path, scoring: Scoring) -> Sequence:
    """Like `read_sequence`, with a scoring that was read before."""
    capture, tracking = read_capture(folder / "capture"), read_tracking(folder / "tracking")
    check_tracking_of(capture, tracking, folder / "tracking")
    if scoring.masks.shape != capture.mattes.shape:
        raise UserError(
            f"{folder / 'scoring'}: does not belong to the capture beside it; delete it and run `mien track` again"
        )
    return Sequence(folder.name, capture, tracking, scoring.masks, folder, scoring.cut)
