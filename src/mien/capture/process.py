"""The second pass over a source: crop every frame, find its landmarks, cut its matte, write it."""

import itertools
from collections import deque
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt64

from mien.capture.crop import Crop
from mien.capture.faces import LANDMARKS, LandmarkDetector
from mien.capture.frame_files import FRAMES, MATTES, FrameLayout, FrameWriter
from mien.capture.matte import Segmenter, refine_matte
from mien.capture.source import FrameSource
from mien.capture.survey import Survey
from mien.errors import UserError
from mien.progress import Advance, progress_bar
from mien.storage import read_arrays, write_arrays

_CHUNK = 256
"""Frames after which progress is kept. Detectors start anew at each chunk, also when nothing is interrupted."""
_LEAD_IN = 8
"""Frames before a chunk from which the detectors gather their state; after four they differ by 0.05 px."""


@dataclass(frozen=True, eq=False)
class Chunk:
    """What was found in some consecutive frames, whose pictures are written."""

    landmarks: Float[np.ndarray, "t l 2"]
    """Pixels of the cropped frames; NaN where there is no face."""
    valid: Bool[np.ndarray, " t"]
    frame_digests: UInt64[np.ndarray, "t 1"]
    matte_digests: UInt64[np.ndarray, "t 1"]


class FrameProcessor:
    """Processes the cropped frames of one clip in order, a chunk at a time."""

    def __init__(self, frames: FrameSource, survey: Survey, crop: Crop) -> None:
        self._path = frames.path
        self._survey = survey
        self._crop = crop
        self._stream = (crop.apply(image) for _, image in frames.frames())
        self._recent: deque[np.ndarray] = deque(maxlen=_LEAD_IN)
        """What came before; before the first frame, the next ones backwards."""

    def skip(self, count: int) -> None:
        """Pass over the first `count` frames, which are done; to be called once, before any chunk."""
        ahead = list(itertools.islice(self._stream, _LEAD_IN + 1))
        self._recent.extend(ahead[:0:-1])
        self._stream = itertools.chain(ahead, self._stream)
        self._recent.extend(itertools.islice(self._stream, count))

    def process(self, start: int, count: int, writer: FrameWriter, advance: Advance) -> Chunk:
        """The next `count` frames, the first of which is number `start`."""
        several_faces = bool(self._survey.crowded[0])
        landmarks = np.full((count, LANDMARKS, 2), np.nan, np.float32)
        with ExitStack() as stack:
            detector = stack.enter_context(LandmarkDetector(several_faces))
            segmenter = stack.enter_context(Segmenter())
            for image in self._recent:
                detector.detect(image)
                segmenter.segment(image)
            done = 0
            for index, image in enumerate(itertools.islice(self._stream, count)):
                found = detector.detect(image, self._face_centre(start + index) if several_faces else None)
                if found is not None:
                    landmarks[index] = found
                writer.submit(start + index, partial(_picture_and_matte, image, segmenter.segment(image)))
                self._recent.append(image)
                advance()
                done += 1
            writer.flush()
        if done < count:
            raise UserError(f"{self._path}: gave fewer frames when it was read again; is it still being written?")
        span = slice(start, start + count)
        return Chunk(
            landmarks=landmarks,
            valid=np.isfinite(landmarks[:, 0, 0]),
            frame_digests=writer.digests[FRAMES][span],
            matte_digests=writer.digests[MATTES][span],
        )

    def _face_centre(self, timestep: int) -> Float[np.ndarray, " 2"] | None:
        """Where the survey saw the followed face, in pixels of the crop."""
        left, top, right, bottom = self._survey.boxes[timestep]
        centre = np.array([(left + right) / 2, (top + bottom) / 2])
        return self._crop.to_output(centre * self._survey.picture_size) if np.isfinite(centre).all() else None


def process_frames(frames: FrameSource, survey: Survey, crop: Crop, layout: FrameLayout, memory: Path) -> list[Chunk]:
    """Process all frames; chunks whose results an earlier, interrupted call left in the folder `memory` are kept.

    Raises:
        UserError: the source cannot be decoded.
        OSError: the frames cannot be written.
    """
    memory.mkdir(exist_ok=True)
    paths = {start: memory / f"{start:06d}.safetensors" for start in range(0, layout.timesteps, _CHUNK)}
    chunks = [Chunk(**read_arrays(path)) for path in itertools.takewhile(Path.exists, paths.values())]
    done = sum(len(chunk.valid) for chunk in chunks)
    processor = FrameProcessor(frames, survey, crop)
    title = f"capture {frames.path.name}"
    with FrameWriter(layout) as writer, progress_bar(title, layout.timesteps, done) as advance:
        processor.skip(done)
        for start, path in itertools.islice(paths.items(), len(chunks), None):
            chunk = processor.process(start, min(_CHUNK, layout.timesteps - start), writer, advance)
            write_arrays(path, vars(chunk))
            chunks.append(chunk)
    return chunks


def _picture_and_matte(image: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return image[None], refine_matte(image, mask)[None]
