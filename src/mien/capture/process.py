"""The second pass over a source: crop every frame of a part, find its landmarks, make its matte, write both."""

import itertools
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8, UInt64

from mien.capture.crop import Crop
from mien.capture.faces import LANDMARKS, LandmarkDetector
from mien.capture.follow import LandmarkFollower
from mien.capture.frame_files import FRAMES, MATTES, FrameLayout, FrameWriter
from mien.capture.given import GivenMattes
from mien.capture.matting import MakeMatte, choose_matting
from mien.capture.people import Person
from mien.capture.quality import MEASURES, measure_face
from mien.capture.source import FrameSource, SourceFrame
from mien.capture.survey import Survey
from mien.errors import UserError
from mien.progress import Advance, progress_bar
from mien.storage import expect_whole, read_arrays, write_arrays

_CHUNK = 256
"""Frames after which progress is saved. Detectors start again at each chunk, even if nothing is interrupted."""
_LEAD_IN = 8
"""Frames before a chunk that set up the detectors' state. After four of them, results differ by 0.05 px."""


@dataclass(frozen=True, eq=False)
class Chunk:
    """The results of some consecutive frames, whose pictures have been written."""

    landmarks: Float[np.ndarray, "t l 2"]
    """Positions in pixels of the cropped frames; NaN where there is no face."""
    quality: Float[np.ndarray, "t m"]
    """Results of `measure_face`; NaN where there is no face."""
    frame_digests: UInt64[np.ndarray, "t 1"]
    matte_digests: UInt64[np.ndarray, "t 1"]

    @property
    def valid(self) -> Bool[np.ndarray, " t"]:
        """Frames in which a face was found."""
        return np.isfinite(self.landmarks[:, 0, 0])


@dataclass(frozen=True, eq=False)
class Part:
    """Consecutive frames of a source that become one capture."""

    name: str
    """Name of the sequence."""
    start: int
    """Index of its first frame, among the frames taken."""
    survey: Survey
    """Survey of the part's frames only."""
    person: Person
    crop: Crop

    @property
    def timesteps(self) -> int:
        """The number of frames."""
        return len(self.survey.timestamps)


@dataclass(frozen=True, eq=False)
class Means:
    """Clean plate, mattes and landmarks that the user gave with the source video."""

    plate: UInt8[np.ndarray, "h w 3"] | None = None
    mattes: GivenMattes | None = None
    landmarks: Float[np.ndarray, "n l 2"] | None = None
    """Positions in pixels of the source's pictures, a row for each frame of the source."""


class Reel:
    """The frames of a source, read once and in order."""

    def __init__(self, frames: FrameSource) -> None:
        self.path = frames.path
        self._stream = frames.frames()
        self._position = 0

    def from_frame(self, start: int) -> Iterator[SourceFrame]:
        """Yield the frames from index `start` (among those taken) on. They must not have been read yet."""
        assert start >= self._position, (start, self._position)
        for _ in itertools.islice(self._stream, start - self._position):
            self._position += 1
        for frame in self._stream:
            self._position += 1
            yield frame


class PartProcessor:
    """Processes the frames of one part in order, a chunk at a time."""

    def __init__(self, reel: Reel, part: Part, means: Means, done: int) -> None:
        """Prepare to process the part, skipping its first `done` frames."""
        self._path, self._part, self._means = reel.path, part, means
        begin = done - _LEAD_IN if done >= _LEAD_IN else 0
        left = part.timesteps - begin
        self._stream = itertools.islice(reel.from_frame(part.start + begin), left)
        self._recent: deque[tuple[int, np.ndarray]] = deque(maxlen=_LEAD_IN)
        """Timesteps and pictures of the latest frames; before the first frame, of the next ones in reverse order."""
        if begin == 0:
            ahead = [self._cropped(frame) for frame in itertools.islice(self._stream, _LEAD_IN + 1)]
            self._recent.extend((index, image) for index, (_, image) in reversed(list(enumerate(ahead))[1:]))
            self._pictures = itertools.chain(ahead, map(self._cropped, self._stream))
        else:
            self._pictures = map(self._cropped, self._stream)
        before = itertools.islice(self._pictures, done - begin)
        self._recent.extend((begin + index, image) for index, (_, image) in enumerate(before))

    def process(self, start: int, count: int, writer: FrameWriter, advance: Advance) -> Chunk:
        """Process the next `count` frames, the first of which is the part's timestep `start`."""
        part = self._part
        landmarks = np.full((count, LANDMARKS, 2), np.nan, np.float32)
        quality = np.full((count, MEASURES), np.nan, np.float32)
        done = 0
        with ExitStack() as stack:
            follower = None
            if self._means.landmarks is None:
                detector = stack.enter_context(LandmarkDetector(bool(part.person.crowded.any())))
                follower = LandmarkFollower(detector, part.survey, part.person, part.crop)
            matting = choose_matting(stack, part.crop, self._means.plate, self._means.mattes)
            for timestep, image in self._recent:
                if follower is not None:
                    follower.find(timestep, image)
                matting.look(image)
            for index, (number, image) in enumerate(itertools.islice(self._pictures, count)):
                timestep = start + index
                found = self._given(timestep, number) if follower is None else follower.find(timestep, image)
                if found is not None:
                    landmarks[index] = found
                make = partial(_finish, image, matting.prepare(number, image), landmarks[index], quality[index])
                writer.submit(timestep, make)
                self._recent.append((timestep, image))
                advance()
                done += 1
            writer.flush()
        if done < count:
            raise UserError(f"{self._path}: gave fewer frames when it was read again; is it still being written?")
        span = slice(start, start + count)
        return Chunk(landmarks, quality, writer.digests[FRAMES][span], writer.digests[MATTES][span])

    def _cropped(self, frame: SourceFrame) -> tuple[int, np.ndarray]:
        return frame.number, self._part.crop.apply(frame.picture())

    def _given(self, timestep: int, number: int) -> Float[np.ndarray, "l 2"] | None:
        """Return the user's landmarks, or None if the followed person is not seen."""
        assert self._means.landmarks is not None
        return self._part.crop.to_output(self._means.landmarks[number]) if self._part.person.seen[timestep] else None


def _read(path: Path) -> Chunk:
    """Read a chunk that an interrupted call saved.

    Raises:
        UserError: it is damaged, or no chunk.
    """
    arrays = read_arrays(path)
    with expect_whole(path, "delete its folder and run `mien capture` again"):
        t = len(arrays["landmarks"])
        if (
            not 0 < t <= _CHUNK
            or arrays["landmarks"].shape[1:] != (LANDMARKS, 2)
            or arrays["quality"].shape != (t, MEASURES)
        ):
            raise ValueError("landmarks or quality of another size")
        if any(arrays[name].shape != (t, 1) for name in ("frame_digests", "matte_digests")):
            raise ValueError("digests of another number")
        if len({len(array) for array in arrays.values()}) > 1:
            raise ValueError("arrays of several lengths")
        return Chunk(**arrays)


def process_part(reel: Reel, part: Part, means: Means, layout: FrameLayout, memory: Path) -> list[Chunk]:
    """Process all frames of a part. Chunks that an interrupted call left in the folder `memory` are kept.

    Raises:
        UserError: the source cannot be decoded.
        OSError: the frames cannot be written.
    """
    memory.mkdir(exist_ok=True)
    paths = {start: memory / f"{start:06d}.safetensors" for start in range(0, layout.timesteps, _CHUNK)}
    chunks = [_read(path) for path in itertools.takewhile(Path.exists, paths.values())]
    done = sum(len(chunk.valid) for chunk in chunks)
    if done == layout.timesteps:
        return chunks
    processor = PartProcessor(reel, part, means, done)
    with FrameWriter(layout) as writer, progress_bar(f"capture {part.name}", layout.timesteps, done) as advance:
        for start, path in itertools.islice(paths.items(), len(chunks), None):
            chunk = processor.process(start, min(_CHUNK, layout.timesteps - start), writer, advance)
            write_arrays(path, vars(chunk))
            chunks.append(chunk)
    return chunks


def _finish(
    image: np.ndarray, make_matte: MakeMatte, landmarks: np.ndarray, quality: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return picture and matte for the disk, and write the picture's quality into `quality`."""
    if np.isfinite(landmarks[0, 0]):
        quality[:] = measure_face(image, landmarks)
    return image[None], make_matte()[None]
