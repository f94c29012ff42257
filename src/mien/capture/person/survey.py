"""Step 2, the first pass over the source: find all faces in every frame, and make thumbnails for finding cuts.

It also finds out whether the video lies on its side, and explains why no face was found in it.
"""

import contextlib
import itertools
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, fields, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int64, UInt8

from mien.capture.person.backend import DetectorChoice
from mien.capture.person.faces import MAX_FACES, FaceFinder
from mien.disk.files import expect_whole, read_arrays, write_arrays
from mien.errors import UserError
from mien.machine.progress import Advance, progress_bar, say
from mien.media.display import same_shape
from mien.media.source import FrameSource, SourceFrame

_CUT_THUMBNAIL = (32, 18)
"""Width and height in pixels of the thumbnails that are compared, whatever the picture's shape."""
_PERSON_COLOR_CELLS = 3  # cells along each side of the grid on which a face's mean colours are computed
_SURVEY_SIDE = 512  # longest side in pixels of the pictures in which faces are searched

_CHUNK = 1000
"""Frames after which progress is saved."""
_COMB_STRIDE = 5
"""Combs are measured in every fifth frame."""
_STORED_NAMES = {"colors": "looks"}
"""Names of arrays in the file, if they differ from the names of the fields."""
_MAX_TURNED = 8
"""Most pictures that are turned each way..."""
_BEGINNING = 500
"""...taken from this many at the beginning, preferably with a face."""
_MIN_GAIN = 0.06
"""Smallest mean gain in confidence (0..1) by turning the pictures. In four clips, upright faces had 0.10 to 0.13 more
than the same faces lying on their side, and at least 0.15 more than upside down."""
_MIN_LEVEL, _MAX_LEVEL = 0.12, 0.93
"""Range of the mean level (0..1). Below it a video is too dark, above it over-exposed."""


@dataclass(frozen=True, eq=False)
class Survey:
    """The results of the first pass for some or all frames."""

    numbers: Int64[np.ndarray, " t"]
    """Indices of the frames in the source."""
    timestamps: Float[np.ndarray, " t"]
    """Time since the first frame taken, in seconds."""
    boxes: Float[np.ndarray, "t f 4"]
    """Left, top, right, bottom of the faces as fractions of the picture, largest first. NaN where there are fewer."""
    colors: Float[np.ndarray, "t f p"]
    """Mean colours of each face, 0..1."""
    thumbnails: UInt8[np.ndarray, "t h w 3"]
    deinterlaced: Bool[np.ndarray, " t"]
    """Frames whose picture is made of an interlaced frame."""
    combs: Float[np.ndarray, " t"]
    """Part of each frame as stored in which lines alternate between two moments, 0..1; NaN where it is not measured."""
    transparent: Bool[np.ndarray, " t"]
    """Pictures with alpha that is not opaque."""
    sizes: Int64[np.ndarray, "t 2"]
    """Width and height of each picture in pixels, before it is shrunk."""

    @property
    def picture_size(self) -> Int64[np.ndarray, " 2"]:
        """Width and height in pixels of the largest picture, to which the others of its shape are brought."""
        return self.sizes[np.argmax(self.sizes.prod(axis=1))]

    def changes_of_shape(self) -> list[int]:
        """Return the numbers of the frames whose aspect ratio differs from that of the frame before."""
        sizes = [(int(width), int(height)) for width, height in self.sizes]
        return [index for index in range(1, len(sizes)) if not same_shape(sizes[index - 1], sizes[index])]


def survey_source(
    frames: FrameSource,
    work: Path,
    landmarks: Float[np.ndarray, "n l 2"] | None = None,
    detector: DetectorChoice = "auto",
) -> Survey:
    """Survey all frames. Results that an earlier call left in the folder `work` are kept.

    Args:
        frames: the source.
        work: the folder for the results.
        landmarks: landmarks for every frame of the source in pixels, NaN for no face. If they are given, faces are not
            searched.
        detector: what runs the networks.
    """
    work.mkdir(parents=True, exist_ok=True)
    whole, done = work / "survey.safetensors", []
    if whole.is_file():
        return _read(whole)
    for path in itertools.takewhile(Path.exists, (_chunk_path(work, index) for index in itertools.count())):
        done.append(_read(path))
    stream = itertools.islice(frames.frames(_SURVEY_SIDE), len(done) * _CHUNK, None)
    title = f"find the face in {frames.path.name}"
    with ExitStack() as stack:
        find = _search(stack.enter_context(FaceFinder(detector))) if landmarks is None else _look_up(landmarks)
        advance = stack.enter_context(progress_bar(title, frames.expected_frames, len(done) * _CHUNK))
        while seen := _observe(itertools.islice(stream, _CHUNK), find, advance):
            _write(_chunk_path(work, len(done)), seen)
            done.append(seen)
    survey = _join(done)
    _write(whole, survey)
    for index in range(len(done)):
        _chunk_path(work, index).unlink()
    return survey


def _write(path: Path, survey: Survey) -> None:
    write_arrays(path, {_STORED_NAMES.get(name, name): array for name, array in vars(survey).items()})


def _read(path: Path) -> Survey:
    """Read the saved results of an earlier call."""
    arrays = read_arrays(path)
    t, side, colors = len(arrays.get("numbers", ())), _CUT_THUMBNAIL[::-1], 3 * _PERSON_COLOR_CELLS**2
    kinds = {
        "numbers": ((t,), np.int64), "timestamps": ((t,), np.float64), "boxes": ((t, MAX_FACES, 4), np.float64),
        "looks": ((t, MAX_FACES, colors), np.float64), "thumbnails": ((t, *side, 3), np.uint8),
        "deinterlaced": ((t,), np.bool_), "combs": ((t,), np.float64), "transparent": ((t,), np.bool_),
        "sizes": ((t, 2), np.int64),
    }  # fmt: skip
    with expect_whole(path, "delete its folder and run `mien capture` again"):
        for name, (shape, dtype) in kinds.items():
            if arrays[name].shape != shape or arrays[name].dtype != dtype or t == 0:
                raise ValueError(f"{name} is {arrays[name].dtype} {arrays[name].shape}")
        return Survey(**{field.name: arrays[_STORED_NAMES.get(field.name, field.name)] for field in fields(Survey)})


def slice_survey(survey: Survey, span: slice) -> Survey:
    """Return some consecutive frames. Their times still count from the start of the whole."""
    return Survey(**{field.name: getattr(survey, field.name)[span] for field in fields(survey)})


_Find = Callable[[SourceFrame, np.ndarray], np.ndarray]
"""Returns the boxes [n, 4] of the faces in a frame, given the frame and its picture."""


def _search(finder: FaceFinder) -> _Find:
    return lambda frame, image: finder.find(image)


def _look_up(landmarks: Float[np.ndarray, "n l 2"]) -> _Find:
    """Return boxes around landmarks that are given in pixels."""

    def find(frame: SourceFrame, image: np.ndarray) -> np.ndarray:
        face = landmarks[frame.number] / frame.size()
        return (
            np.concatenate([face.min(axis=0), face.max(axis=0)])[None] if np.isfinite(face).all() else np.zeros((0, 4))
        )

    return find


def _observe(stream: Iterator[SourceFrame], find: _Find, advance: Advance) -> Survey | None:
    """Survey the frames of a stream; None if it is at its end."""
    rows: list[tuple[int, float, np.ndarray, np.ndarray, np.ndarray, bool, float, bool, tuple[int, int]]] = []
    for frame in stream:
        image = frame.picture()
        found = find(frame, image)
        largest = np.argsort(-np.prod(found[:, 2:] - found[:, :2], axis=1))[:MAX_FACES]
        boxes = np.full((MAX_FACES, 4), np.nan)
        boxes[: len(largest)] = found[largest]
        colors = np.stack([_mean_colors(image, box) for box in boxes])
        thumbnail = cv2.resize(image, _CUT_THUMBNAIL, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)
        measured = frame.combs() if len(rows) % _COMB_STRIDE == 0 else np.nan
        seen = frame.is_deinterlaced, measured, frame.alpha() is not None, frame.size()
        rows.append((frame.number, frame.seconds, boxes, colors, thumbnail, *seen))
        advance()
    if not rows:
        return None
    numbers, timestamps, boxes, colors, thumbnails, deinterlaced, combs, transparent, sizes = (
        np.array(column) for column in zip(*rows, strict=True)
    )
    whole = numbers.astype(np.int64), sizes.astype(np.int64)
    return Survey(whole[0], timestamps, boxes, colors, thumbnails, deinterlaced, combs, transparent, whole[1])


def _mean_colors(image: UInt8[np.ndarray, "h w 3"], box: Float[np.ndarray, " 4"]) -> Float[np.ndarray, " p"]:
    """Return the mean colours of a face; NaN for no face."""
    cells = _PERSON_COLOR_CELLS
    if not np.isfinite(box).all():
        return np.full(3 * cells**2, np.nan)
    height, width = image.shape[:2]
    left, top, right, bottom = np.clip(box * [width, height, width, height], 0, [width, height, width, height])
    # A box at the border, or a false one, may contain no pixel.
    left, top = min(int(left), width - 1), min(int(top), height - 1)
    part = image[top : max(int(bottom), top + 1), left : max(int(right), left + 1)]
    return cv2.resize(part, (cells, cells), interpolation=cv2.INTER_AREA).ravel() / 255.0


def _chunk_path(work: Path, index: int) -> Path:
    return work / f"survey-{index:04d}.safetensors"


def _join(chunks: list[Survey]) -> Survey:
    names = [field.name for field in fields(Survey)]
    return Survey(**{name: np.concatenate([getattr(chunk, name) for chunk in chunks]) for name in names})


def check_upright(frames: FrameSource, survey: Survey, turned: int, detector: DetectorChoice = "auto") -> None:
    """Warn if faces lie on their side, and refuse a video without a face.

    Args:
        frames: the source.
        survey: the source's survey.
        turned: degrees by which the pictures have been turned already.
        detector: what runs the networks.
    """
    turn = _best_turn(frames, survey, detector)
    option = f"--capture.turn {(turned + turn) % 360}"
    if not np.isfinite(survey.boxes).any():
        raise _no_face_because(frames, survey, option if turn else "", detector)
    if turn:
        lies = "upside down" if turn == 180 else "on its side"
        say(f"warning: {frames.path}: the face seems to lie {lies}; if it does, add {option}")


def _best_turn(frames: FrameSource, survey: Survey, detector: DetectorChoice) -> int:
    """Return the degrees clockwise after which faces are found with the most confidence."""
    seen = np.flatnonzero(np.isfinite(survey.boxes[:_BEGINNING, 0, 0]))
    numbers = seen if len(seen) else np.arange(min(_BEGINNING, len(survey.boxes)))
    chosen = set(numbers[:: -(-len(numbers) // _MAX_TURNED)].tolist())
    totals = np.zeros(4)
    with FaceFinder(detector) as finder:
        for index, frame in enumerate(itertools.islice(frames.frames(_SURVEY_SIDE), max(chosen) + 1)):
            if index in chosen:
                picture = frame.picture()
                totals += [finder.surest(np.ascontiguousarray(np.rot90(picture, -quarter))) for quarter in range(4)]
    best = int(totals.argmax())
    return 90 * best if totals[best] > totals[0] + _MIN_GAIN * len(chosen) else 0


def no_face(path: Path, frames: int, remedy: str = "give a video that shows a face clearly") -> UserError:
    """Return the error for a video in which no face was found."""
    return UserError(
        f"{path}: no face found in {'its only frame' if frames == 1 else f'any of its {frames} frames'}; {remedy}"
    )


def _stream_with_face(frames: FrameSource, detector: DetectorChoice) -> int | None:
    """Return the first of the file's other streams that shows a face in some pictures at its beginning."""
    for stream in frames.other_streams:
        other, stride = replace(frames, stream=stream), _BEGINNING // _MAX_TURNED
        pictures = itertools.islice(other.frames(_SURVEY_SIDE), 0, _BEGINNING, stride)
        with FaceFinder(detector) as finder, contextlib.suppress(UserError):
            if any(len(finder.find(frame.picture())) for frame in pictures):
                return stream
    return None


def _no_face_because(frames: FrameSource, survey: Survey, option: str, detector: DetectorChoice) -> UserError:
    """Return the error for a video without a face, with the cause if the pictures show it."""
    path, count, level = frames.path, len(survey.timestamps), float(survey.thumbnails.mean()) / 255
    stream = _stream_with_face(frames, detector)
    if stream is not None:
        return no_face(path, count, f"stream {stream} of the file shows one: add --capture.stream {stream}")
    if option:
        return no_face(path, count, f"there is one if the pictures are turned: add {option}")
    if level < _MIN_LEVEL:
        return no_face(path, count, f"it is very dark (mean level {level:.0%}): film again with light on the face")
    if level > _MAX_LEVEL:
        return no_face(path, count, f"it is over-exposed (mean level {level:.0%}): film again with less exposure")
    return no_face(path, count)
