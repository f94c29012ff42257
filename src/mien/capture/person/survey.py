"""Step 2, the first pass over the source: find all faces in every frame, and make thumbnails for finding cuts.

It also finds out whether the video lies on its side, and explains why no face was found in it.
"""

import contextlib
import itertools
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int64, UInt8

from mien.capture.person.backend import DetectorChoice
from mien.capture.person.faces import MAX_FACES, FaceFinder
from mien.disk.files import read_arrays, write_arrays
from mien.disk.reading import expect_whole
from mien.errors import UserError
from mien.machine.progress import Advance, progress_bar, say
from mien.media.display import same_shape
from mien.media.source import FrameSource
from mien.media.video import LazyFrame

_CUT_THUMBNAIL = (32, 18)
"""Width and height in pixels of the thumbnails that are compared, whatever the picture's shape."""
_PERSON_COLOR_CELLS = 3  # cells along each side of the grid on which a face's mean colours are computed
_SURVEY_SIDE = 512  # longest side in pixels of the pictures in which faces are searched

_Saved = TypeVar("_Saved")
_CHUNK = 1000  # frames after which progress is saved
_MAX_TURNED = 8  # most pictures that are turned each way...
_BEGINNING = 500  # ...taken from this many at the beginning, preferably with a face
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
    frames: FrameSource, work: Path, landmarks: Float[np.ndarray, "n l 2"] | None = None,
    detector: DetectorChoice = "auto",
) -> Survey:  # fmt: skip
    """Survey all frames. Results that an earlier call left in the folder `work` are kept.

    If landmarks are given for every frame of the source, in pixels and NaN for no face, faces are not searched.
    """
    work.mkdir(parents=True, exist_ok=True)
    whole, done = work / "survey.safetensors", []
    if whole.is_file():
        return read_saved(whole, Survey)
    for path in itertools.takewhile(Path.exists, (_chunk_path(work, index) for index in itertools.count())):
        done.append(read_saved(path, Survey))
    stream = itertools.islice(frames.frames(_SURVEY_SIDE), len(done) * _CHUNK, None)
    title = f"find the face in {frames.path.name}"
    finder = FaceFinder(detector)
    with ExitStack() as stack:
        if landmarks is None:
            stack.enter_context(finder)
        advance = stack.enter_context(progress_bar(title, frames.expected_frames, len(done) * _CHUNK))
        while seen := _observe(itertools.islice(stream, _CHUNK), finder, landmarks, advance):
            write_arrays(_chunk_path(work, len(done)), vars(seen))
            done.append(seen)
    survey = Survey(**{name: np.concatenate([vars(chunk)[name] for chunk in done]) for name in vars(done[0])})
    write_arrays(whole, vars(survey))
    for index in range(len(done)):
        _chunk_path(work, index).unlink()
    return survey


def read_saved(path: Path, kind: type[_Saved]) -> _Saved:
    """Read arrays that an interrupted call saved as the fields of a class."""
    arrays = read_arrays(path)
    with expect_whole(path, "delete its folder and run `mien capture` again"):
        return kind(**arrays)


def slice_survey(survey: Survey, span: slice) -> Survey:
    """Return some consecutive frames. Their times still count from the start of the whole."""
    return Survey(**{name: values[span] for name, values in vars(survey).items()})


def _boxes_of(landmarks: Float[np.ndarray, "n l 2"], frame: LazyFrame) -> Float[np.ndarray, "n 4"]:
    face = landmarks[frame.number] / frame.size()
    box = np.concatenate([face.min(axis=0), face.max(axis=0)])
    return box[None] if np.isfinite(face).all() else np.zeros((0, 4))


def _observe(
    stream: Iterator[LazyFrame], finder: FaceFinder, landmarks: Float[np.ndarray, "n l 2"] | None, advance: Advance
) -> Survey | None:
    """Survey the frames of a stream; None if it is at its end."""
    rows: list[tuple[Any, ...]] = []
    for frame in stream:
        image = frame.picture()
        found = finder.find(image) if landmarks is None else _boxes_of(landmarks, frame)
        largest = np.argsort(-np.prod(found[:, 2:] - found[:, :2], axis=1))[:MAX_FACES]
        boxes = np.full((MAX_FACES, 4), np.nan)
        boxes[: len(largest)] = found[largest]
        colors = np.stack([_mean_colors(image, box) for box in boxes])
        thumbnail = cv2.resize(image, _CUT_THUMBNAIL, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)
        combs = frame.combs() if len(rows) % 5 == 0 else np.nan
        seen = frame.is_deinterlaced, combs, frame.alpha() is not None, frame.size()
        rows.append((frame.number, frame.seconds, boxes, colors, thumbnail, *seen))
        advance()
    if not rows:
        return None
    columns = dict(zip((field.name for field in fields(Survey)), map(np.array, zip(*rows, strict=True)), strict=True))
    return Survey(**{**columns, **{name: columns[name].astype(np.int64) for name in ("numbers", "sizes")}})


def _mean_colors(image: UInt8[np.ndarray, "h w 3"], box: Float[np.ndarray, " 4"]) -> Float[np.ndarray, " p"]:
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


def check_upright(frames: FrameSource, survey: Survey, turned: int, detector: DetectorChoice = "auto") -> None:
    """Warn if faces lie on their side after a turn by some degrees, and refuse a video without a face."""
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
    for stream in frames.video.other_streams:
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


_MIN_COMBS = 0.004
"""Part of the picture with combs (`mien.media.fields.combs`) from which a video counts as interlaced. Seven
progressive clips have at most 0.0008, with noise of 8 levels 0.0027. Woven from two frames each, they have 0.0066."""


def tell_kind(frames: FrameSource) -> None:
    """Say what the file states, before it is read."""
    if frames.video.other_streams:
        others = ", ".join(map(str, frames.video.other_streams))
        say(
            f"{frames.path}: has several streams of pictures; stream {frames.stream} is captured, and --capture.stream "
            f"chooses another ({others})"
        )
    if frames.video.hdr:
        say(f"{frames.path}: HDR video ({frames.video.hdr}); its pictures are tone-mapped to sRGB")
    if frames.video.has_field_pictures:
        say(
            f"warning: {frames.path}: each picture is a single field of interlaced video, of half the height (HEVC); "
            "mien does not join them: deinterlace it with a video program and give the result"
        )


def tell_fields(frames: FrameSource, survey: Survey) -> None:
    """Say how many frames were deinterlaced, and whether the file seems to be marked wrongly."""
    count, total, has_combs = int(survey.deinterlaced.sum()), len(survey.numbers), _has_combs(survey)
    if count:
        told = f"{frames.path}: interlaced; {count} of {total} frames are deinterlaced, each to one picture"
        if not has_combs and frames.deinterlace == "auto":
            told += "; they show no combs: if filmed progressively, --capture.deinterlace never keeps more detail"
        say(told)
    elif has_combs and frames.deinterlace == "auto":
        say(
            f"warning: {frames.path}: its lines alternate between two moments, but it is not marked as interlaced; if "
            "moving edges look like combs, add --capture.deinterlace always"
        )


def kind_report(frames: FrameSource, survey: Survey) -> dict[str, Any]:
    """Return the entries for the capture's report."""
    return {
        "hdr": frames.video.hdr or None,
        "frames_deinterlaced": int(survey.deinterlaced.sum()),
        "combs": _has_combs(survey),
    }


def _has_combs(survey: Survey) -> bool:
    # A still head has none, so the frames with the most count.
    measured = survey.combs[np.isfinite(survey.combs)]
    return bool(len(measured)) and float(np.quantile(measured, 0.9)) > _MIN_COMBS
