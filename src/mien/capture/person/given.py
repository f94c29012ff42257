"""Step 1: read the clean plate, mattes and landmarks that the user gives, and check them against their source."""

import csv
import itertools
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from mien.capture.person.backend import Detector, FoundBy
from mien.capture.person.crop import Crop, whole_picture
from mien.capture.person.faces import IBUG68, LANDMARKS
from mien.disk.files import read_arrays
from mien.disk.limits import MAX_NUMBER
from mien.disk.reading import open_ordinary
from mien.disk.tables import split_lines, with_point
from mien.errors import UserError
from mien.machine.progress import say
from mien.machine.terminal import counted
from mien.media.decoding import decode_picture
from mien.media.lens import Lens
from mien.media.source import FrameSelection, FrameSource, list_images, open_source, read_image

_MAX_LINE = 2 * LANDMARKS * 64  # characters of a csv line: more than a number of any precision takes


class GivenMattes:
    """Mattes of a source's frames, read once and in order."""

    def __init__(
        self, path: Path, picture_size: tuple[int, int], lens: Lens | None = None, own: FrameSource | None = None,
    ) -> None:  # fmt: skip
        """Prepare to read a video or a folder. `own` is the source itself, if its alpha is the matte."""
        self._path, self._lens = path, lens
        self._size, self._is_own = picture_size, own is not None
        self._files = list_images(path) if own is None and path.is_dir() else None
        whole = FrameSelection()
        source = replace(own, selection=whole, lens=None) if own else None
        self._stream = iter(()) if self._files else (source or open_source(path, whole, 25.0)).frames()

    def matte(self, number: int, crop: Crop) -> UInt8[np.ndarray, "h w"]:
        """Return the matte of the source's frame `number`, cropped like its picture. Numbers must increase."""
        if self._files:
            if number >= len(self._files):
                raise UserError(f"{self._path}: ends before its frame {number}; give a matte for each frame")
            name, matte = self._files[number], _read_matte(self._files[number])
        else:
            frame = next(itertools.dropwhile(lambda frame: frame.number < number, self._stream), None)
            if frame is None:
                raise UserError(f"{self._path}: ends before its frame {number}; give a matte for each frame")
            name, matte = self._path, frame.alpha()
            if matte is None:
                matte = np.full(self._size[::-1], 255, np.uint8) if self._is_own else frame.picture()[..., 1]
        if matte.shape[::-1] != self._size:
            raise UserError(
                f"{name}: is {matte.shape[1]}x{matte.shape[0]}, but the source's pictures are "
                f"{self._size[0]}x{self._size[1]}; give mattes of that size"
            )
        return crop.apply(matte if self._lens is None else self._lens.straighten(matte))


@dataclass(frozen=True, eq=False)
class GivenInputs:
    """Clean plate, mattes and landmarks that the user gave with the source video."""

    plate: UInt8[np.ndarray, "h w 3"] | None = None
    mattes: GivenMattes | None = None
    landmarks: Float[np.ndarray, "n l 2"] | None = None
    """Positions in pixels of the source's pictures (straightened, if a lens is known), a row for each frame."""
    points: Float[np.ndarray, "n 68 2"] | None = None
    """The same of the 68 points of 300-W, which take the places of detected landmarks."""

    def found_by(self, detector: Detector) -> FoundBy:
        """Return what finds the landmarks, if `detector` runs where none are given."""
        return "other" if self.points is not None else detector if self.landmarks is None else "mediapipe"

    def with_points(
        self, found: Float[np.ndarray, "l 2"] | None, crop: Crop, number: int
    ) -> Float[np.ndarray, "l 2"] | None:
        """Return landmarks in a crop with the points of the source's frame `number`; None where there are none.

        The contour stays as it was found, because that of 300-W is a silhouette.
        """
        if found is None or self.points is None:
            return found
        merged = np.array(found)
        merged[list(IBUG68[17:])] = crop.to_output(self.points[number])[17:]
        return merged if np.isfinite(merged).all() else None


def read_given(frames: FrameSource, plate: Path | None, mattes: Path | None, landmarks: Path | None) -> GivenInputs:
    """Read and check what the user gave besides the source, before anything that takes long.

    It belongs to the pictures as they were filmed, so it is straightened like them, and the clean plate's colours are
    corrected like theirs.
    """
    if plate is None and mattes is None and landmarks is None:
        return GivenInputs()
    first = next(frames.frames())
    height, width = first.picture().shape[:2]
    given = GivenInputs()
    if plate is not None:
        scene = read_image(plate)
        if scene.shape[:2] != (height, width):
            raise UserError(
                f"--capture.clean-plate {plate}: is {scene.shape[1]}x{scene.shape[0]}, but the video's "
                f"pictures are {width}x{height}; give a picture from the same camera in the same mode"
            )
        given = replace(given, plate=frames.calibrated(scene))
    if mattes is not None:
        count, expected = open_source(mattes, FrameSelection(), 25.0).count(), frames.count()
        if count != expected:
            raise UserError(
                f"{mattes}: has {counted(count, 'matte')}, but {frames.path} has {counted(expected, 'frame')}; "
                "give one matte for each frame"
            )
        # A first one is read to find mistakes before anything that takes long.
        GivenMattes(mattes, (width, height)).matte(first.number, whole_picture(width, height, max(width, height)))
        given = replace(given, mattes=GivenMattes(mattes, (width, height), frames.lens))
    if landmarks is not None:
        points = read_landmarks(landmarks, frames.count())
        points = points if frames.lens is None else frames.lens.straighten_points(points, width, height)
        whole = points.shape[1] == LANDMARKS
        given = replace(given, landmarks=points) if whole else replace(given, points=points)
    return given


def with_own_alpha(given: GivenInputs, frames: FrameSource, transparent: Bool[np.ndarray, " t"]) -> GivenInputs:
    """Return the inputs with the source's alpha as mattes, if most of its pictures have some and none are given."""
    opaque = int((~transparent).sum())
    if given.mattes is not None or 2 * opaque > len(transparent):
        return given
    unused = ", and the clean plate is not used" if given.plate is not None else ""
    say(f"{frames.path}: its alpha is the matte{unused}")
    if opaque:
        say(
            f"warning: {frames.path}: {opaque} of {len(transparent)} frames are opaque, so all that they show counts "
            "as the person; give them alpha, or leave them out"
        )
    width, height = next(frames.frames()).size()
    return replace(given, mattes=GivenMattes(frames.path, (width, height), frames.lens, frames))


def read_landmarks(path: Path, source_frames: int) -> Float[np.ndarray, "n l 2"]:
    """Read landmarks in pixels of the source's pictures as displayed, a row for each frame; NaN for no face.

    Args:
        path: a .safetensors file with `landmarks` [n, 478, 2], or a .csv file with n lines of x0, y0, x1, y1, ... (956
            numbers; empty or nan means no face; a first line of column names is skipped). With 68 in place of 478, they
            are the points of 300-W.
        source_frames: the number of frames in the source, n.
    """
    if path.suffix == ".safetensors":
        _check_size(path, source_frames)
        landmarks = read_arrays(path).get("landmarks")
        if landmarks is None:
            raise UserError(f"{path}: has no array `landmarks`; write one of [{source_frames}, {LANDMARKS}, 2] pixels")
    elif path.suffix == ".csv":
        landmarks = _read_csv(path, source_frames)
    else:
        raise UserError(f"--capture.landmarks {path}: cannot be read; give a .csv or .safetensors file")
    if landmarks.shape not in [(source_frames, count, 2) for count in (LANDMARKS, len(IBUG68))]:
        raise UserError(
            f"{path}: has landmarks of shape {list(landmarks.shape)}, expected {[source_frames, LANDMARKS, 2]}: "
            "a row for each frame of the source (or 68 points of 300-W in each)"
        )
    if landmarks.dtype.kind not in "iuf":
        raise UserError(f"{path}: `landmarks` is {landmarks.dtype}; write numbers, pixels, as float32")
    landmarks = landmarks.astype(np.float64)
    if any((np.abs(frame) > MAX_NUMBER).any() for frame in landmarks):
        raise UserError(
            f"{path}: has numbers that are infinite or beyond {MAX_NUMBER:g} pixels; write nan where there is no face"
        )
    landmarks[~np.isfinite(landmarks).all(axis=(1, 2))] = np.nan
    return landmarks


def _check_size(path: Path, frames: int) -> None:
    """Refuse a file that is far larger than the landmarks of a number of frames, before it is read."""
    most = (1 << 20) + 2 * frames * LANDMARKS * 2 * np.dtype(np.float64).itemsize
    size = path.stat().st_size if path.is_file() else 0
    if size > most:
        raise UserError(
            f"{path}: has {size:,} bytes, and landmarks of {counted(frames, 'frame')} have at most {most:,}; write "
            "`landmarks` alone, as float32"
        )


def _read_csv(path: Path, most: int) -> np.ndarray:
    """Read the rows, at most one beyond `most`, which is enough to see that there are too many."""
    rows: list[np.ndarray] = []
    count = 2 * LANDMARKS
    try:
        for index, (number, line) in enumerate(split_lines(open_ordinary(path), _MAX_LINE)):
            words = (cell.strip().lower() for cell in line)
            if index == 0 and any(word[:1].isalpha() and word != "nan" for word in words):
                continue
            if len(line) == 2 * len(IBUG68) and all(np.isnan(row).all() for row in rows):
                count, rows = len(line), [row[: len(line)] for row in rows]
            if len(line) not in (0, count):
                raise UserError(f"{path}: line {number} has {len(line)} numbers, expected {count}")
            rows.append(np.array([_number(path, number, cell) for cell in line] or [np.nan] * count))
            if len(rows) > most:
                break
    except (OSError, ValueError, csv.Error) as error:
        raise UserError(f"{path}: cannot be read as csv ({error}); write it again") from None
    return np.array(rows).reshape(len(rows), count // 2, 2)


def _number(path: Path, line: int, cell: str) -> float:
    try:
        return float(with_point(cell)) if cell.strip() else np.nan
    except ValueError:
        shown = repr(cell if len(cell) <= 40 else f"{cell[:40]}...")
        raise UserError(f"{path}: line {line}: {shown} is not a number; write pixels, or nan for no face") from None


def _read_matte(path: Path) -> UInt8[np.ndarray, "h w"]:
    """Read a grey picture, or the alpha channel of a picture that has one, as 8 bit."""
    matte = decode_picture(path, cv2.IMREAD_UNCHANGED)
    if matte is None or matte.dtype not in (np.uint8, np.uint16):
        raise UserError(f"{path}: cannot be read as a matte; write a grey picture of 8 or 16 bit")
    if matte.ndim == 3:
        has_alpha = matte.shape[2] == 4 and matte[..., 3].min() < matte[..., 3].max()
        matte = matte[..., 3 if has_alpha else 1]
    return np.ascontiguousarray(matte if matte.dtype == np.uint8 else (matte // 257).astype(np.uint8))
