"""Step 4, the second pass over the source: crop each frame, find its landmarks, make its matte, and write both."""

import itertools
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8, UInt64

from mien.capture.capture import Capture
from mien.capture.frame_files import CACHE, FRAMES, MATTES, FrameLayout, FrameWriter
from mien.capture.parts import Part
from mien.capture.person.backend import DetectorChoice
from mien.capture.person.crop import Crop
from mien.capture.person.faces import LANDMARKS, LandmarkDetector
from mien.capture.person.given import GivenInputs
from mien.capture.person.matte import MakeMatte, choose_matting, held, without_others
from mien.capture.person.people import Person
from mien.capture.person.plate import screen_of, without_screen
from mien.capture.person.survey import Survey, read_saved
from mien.capture.quality import MEASURES, FrameQuality, measure_face, quality_report, relative_quality
from mien.capture.store import finish_capture
from mien.disk.files import write_arrays
from mien.disk.reading import remove_tree
from mien.errors import UserError
from mien.machine.progress import Advance, progress_bar, say
from mien.media.display import brought_to
from mien.media.video import LazyFrame

_MATTE_HELD_FRAMES = 12  # frames before and after in which another face still counts where it is not found
_LEAD_IN = 8
"""Frames before a chunk that set up the detectors' state. Measured: landmarks are off by 0.8 to 1.6 px in the first
frame, by 0.1 px after 2, and by no more than their noise after 4 (log)."""
_FACE_MOST_DISTANCE = 0.6
"""Largest distance between the centres of landmarks and of the followed face, as a part of the face's longer side: it
refuses no good face (log)."""
_FACE_MOST_AGE = 12  # frames for which the last landmarks predict the face's position if the survey did not find it
CHUNK = 256  # frames after which progress is saved. Detectors start again at each, even if nothing is interrupted


@dataclass(frozen=True, eq=False)
class Chunk:
    """The results of some consecutive frames, whose pictures have been written."""

    landmarks: Float[np.ndarray, "t l 2"]
    """Positions in pixels of the cropped frames; NaN where there is no face."""
    quality: Float[np.ndarray, "t m"]
    """Results of `measure_face`; NaN where there is no face."""
    taken_off: Float[np.ndarray, " t"]
    """Pixels of the matte that are not the person's, and were taken off."""
    frame_digests: UInt64[np.ndarray, "t 1"]
    matte_digests: UInt64[np.ndarray, "t 1"]


Stream = Iterator[tuple[int, LazyFrame]]
"""The frames taken from a source with their numbers among these, read once and in order by one part after another."""


class LandmarkFollower:
    """Picks the landmarks of the person that the survey follows, frame by frame."""

    def __init__(self, detector: LandmarkDetector, survey: Survey, person: Person, crop: Crop) -> None:
        self._detector = detector
        size = np.tile(survey.picture_size, 2)
        self._boxes = _to_crop(person.boxes * size, crop)
        self._others = _to_crop(person.others * size, crop)
        self._is_alone = not person.crowded.any()
        self._last: tuple[int, np.ndarray] | None = None

    def find(self, timestep: int, image: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "l 2"] | None:
        """Return the person's landmarks in the next picture, in pixels, or None if the face is not found."""
        faces, chosen = self._detector.detect(image), None
        # The box where the face should be: the survey's, or else that of the last landmarks if they are recent.
        if np.isfinite(self._boxes[timestep, 0]):
            chosen = self._nearest(faces, self._boxes[timestep], self._others[timestep])
        elif self._last is not None and abs(timestep - self._last[0]) <= _FACE_MOST_AGE:
            chosen = self._nearest(faces, _box(self._last[1]), self._others[timestep])
        elif self._is_alone and len(faces):
            # The two detectors differ. If the clip never shows anybody else, any face that is detected here is the
            # person.
            chosen = faces[0]
        if chosen is not None:
            self._last = timestep, chosen
        return chosen

    @staticmethod
    def _nearest(faces: np.ndarray, expected: np.ndarray, others: np.ndarray) -> Float[np.ndarray, "l 2"] | None:
        if not len(faces):
            return None
        centers = (faces.min(axis=1) + faces.max(axis=1)) / 2
        distances = np.linalg.norm(centers - (expected[:2] + expected[2:]) / 2, axis=1)
        best = int(np.argmin(distances))
        if distances[best] > _FACE_MOST_DISTANCE * (expected[2:] - expected[:2]).max():
            return None
        to_others = np.linalg.norm(centers[best] - (others[:, :2] + others[:, 2:]) / 2, axis=1)
        # Missing faces are NaN, which never compares as smaller.
        return None if (to_others < distances[best]).any() else faces[best]


def _to_crop(boxes: Float[np.ndarray, "*b 4"], crop: Crop) -> Float[np.ndarray, "*b 4"]:
    return crop.to_output(boxes.reshape(-1, 2, 2)).reshape(boxes.shape)


def _box(landmarks: Float[np.ndarray, "l 2"]) -> Float[np.ndarray, " 4"]:
    return np.concatenate([landmarks.min(axis=0), landmarks.max(axis=0)])


class PartProcessor:
    """Processes the frames of one part in order, a chunk at a time."""

    def __init__(self, stream: Stream, part: Part, given: GivenInputs, done: int, detector: DetectorChoice) -> None:
        """Prepare to process the part, skipping its first `done` frames."""
        self._part, self._given = part, given
        self._detector: DetectorChoice = detector
        others = held(part.person.others, _MATTE_HELD_FRAMES) * np.tile(part.survey.picture_size, 2)
        self._others = _to_crop(others, part.crop)
        begin = max(done - _LEAD_IN, 0)
        own = (frame for number, frame in stream if number >= part.start + begin)
        self._pictures = map(self._cropped, itertools.islice(own, part.timesteps - begin))
        self._recent: deque[tuple[int, np.ndarray]] = deque(maxlen=_LEAD_IN)
        """Timesteps and pictures of the latest frames; before the first frame, of the next ones in reverse order."""
        self._keys = given.plate is None and given.mattes is None
        if begin == 0:
            ahead = list(itertools.islice(self._pictures, _LEAD_IN + 1))
            self._recent.extend((index, ahead[index][1]) for index in range(len(ahead) - 1, 0, -1))
            self._pictures = itertools.chain(ahead, self._pictures)
            screen = screen_of(ahead[0][1]) if self._keys else None
            if screen is not None:
                red, green, blue = (round(255 * float(level)) for level in screen)
                say(
                    f"{part.name}: the background is an even screen (red {red}, green {green}, blue {blue} of 255); it "
                    "gives the mattes, and its light is taken off the edges; give --capture.mattes if they are wrong"
                )
        before = itertools.islice(self._pictures, done - begin)
        self._recent.extend((begin + index, image) for index, (_, image) in enumerate(before))

    def process(self, start: int, count: int, writer: FrameWriter, camera: int, advance: Advance) -> Chunk:
        """Process the next `count` frames, of the writer's camera; the first is the part's timestep `start`."""
        part = self._part
        landmarks = np.full((count, LANDMARKS, 2), np.nan, np.float32)
        quality = np.full((count, MEASURES), np.nan, np.float32)
        taken_off = np.zeros(count, np.float32)
        index = -1
        with ExitStack() as stack:
            follower = None
            if self._given.landmarks is None:
                detector = stack.enter_context(LandmarkDetector(bool(part.person.crowded.any()), self._detector))
                follower = LandmarkFollower(detector, part.survey, part.person, part.crop)
            prepare = choose_matting(stack, part.crop, self._given.plate, self._given.mattes, self._detector)
            for timestep, image in self._recent:
                if follower is not None:
                    follower.find(timestep, image)
                if self._given.mattes is None:
                    prepare(0, image)
            for index, (number, image) in enumerate(itertools.islice(self._pictures, count)):
                timestep = start + index
                found = None
                if follower is not None:
                    found = follower.find(timestep, image)
                elif self._given.landmarks is not None and part.person.seen[timestep]:
                    found = part.crop.to_output(self._given.landmarks[number])
                found = self._given.with_points(found, part.crop, number)
                if found is not None:
                    landmarks[index] = found
                make_matte = prepare(number, image)
                if self._given.mattes is None and found is not None:
                    make_matte = partial(_own_matte, make_matte, found, self._others[timestep], taken_off[index:][:1])
                screen = screen_of(image) if self._keys else None
                make = partial(_finish, image, make_matte, landmarks[index], quality[index], screen)
                writer.submit(timestep, make)
                self._recent.append((timestep, image))
                advance()
            writer.flush()
        if index + 1 < count:
            raise UserError(f"{part.name}: has fewer frames than before; wait until it is complete, then run it again")
        span = slice(start, start + count), slice(camera, camera + 1)
        return Chunk(landmarks, quality, taken_off, writer.digests[FRAMES][span], writer.digests[MATTES][span])

    def _cropped(self, frame: LazyFrame) -> tuple[int, np.ndarray]:
        width, height = self._part.survey.picture_size.tolist()
        return frame.number, self._part.crop.apply(brought_to(frame.picture(), (width, height)))


def process_part(
    stream: Stream, part: Part, given: GivenInputs, layout: FrameLayout, work: Path, camera: int = 0,
    detector: DetectorChoice = "auto",
) -> list[Chunk]:  # fmt: skip
    """Process a part as one camera of the layout. Chunks that an interrupted call left in `work` are kept."""
    work.mkdir(exist_ok=True)
    paths = {start: work / f"{start:06d}.safetensors" for start in range(0, layout.timesteps, CHUNK)}
    chunks = [read_saved(path, Chunk) for path in itertools.takewhile(Path.exists, paths.values())]
    done = sum(len(chunk.landmarks) for chunk in chunks)
    if done == layout.timesteps:
        return chunks
    processor = PartProcessor(stream, part, given, done, detector)
    with FrameWriter(layout, camera) as writer, progress_bar(f"capture {part.name}", layout.timesteps, done) as advance:
        for start, path in itertools.islice(paths.items(), len(chunks), None):
            chunk = processor.process(start, min(CHUNK, layout.timesteps - start), writer, camera, advance)
            write_arrays(path, vars(chunk))
            chunks.append(chunk)
    return chunks


def _own_matte(make: MakeMatte, landmarks: np.ndarray, others: np.ndarray, taken_off: np.ndarray) -> np.ndarray:
    """Make the matte of the person with these landmarks, and write how many pixels that takes off."""
    matte = make()
    own = without_others(matte, _box(landmarks).astype(np.float64), others)
    taken_off[:] = ((matte > 0) & (own == 0)).sum()
    return own


def _finish(
    image: np.ndarray, make_matte: MakeMatte, landmarks: np.ndarray, quality: np.ndarray, screen: np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return picture (without a screen) and matte for the disk, and write the picture's quality into `quality`."""
    if np.isfinite(landmarks[0, 0]):
        quality[:] = measure_face(image, landmarks)
    matte = make_matte()
    return (image if screen is None else without_screen(image, matte, screen))[None], matte[None]


def join_chunks(chunks: Sequence[Sequence[Chunk]], name: str) -> np.ndarray:
    """Join an array of the chunks of each camera over time, and of all cameras along the second axis."""
    return np.stack([np.concatenate([getattr(chunk, name) for chunk in camera]) for camera in chunks], axis=1)


def origin_of(part: Part) -> dict[str, Any]:
    """Return what a capture's `source` says about the pictures of a camera."""
    crop = part.crop
    return {
        "picture_size": part.survey.picture_size.tolist(),
        "crop": {"left": crop.left, "top": crop.top, "width": crop.crop_width, "height": crop.crop_height},
        "first_frame": int(part.survey.numbers[0]),
    }


def finish(
    layout: FrameLayout, out: Path, chunks: Sequence[Sequence[Chunk]], report: dict[str, Any], **facts: Any
) -> None:
    """Step 5: write the results of all frames beside them, remove the unfinished work, and rename the folder to `out`.

    `chunks` are those of each camera. `facts` are what the fields of the `Capture` are that do not follow from these.
    """
    measured = join_chunks(chunks, "quality")
    # The quality of each picture is relative to those of its own camera.
    each = [vars(relative_quality(measured[:, camera])) for camera in range(len(chunks))]
    quality = FrameQuality(**{name: np.concatenate([one[name] for one in each], axis=1) for name in each[0]})
    capture = Capture(
        camera_ids=layout.camera_ids, images=layout.blank(FRAMES), mattes=layout.blank(MATTES),
        valid=np.isfinite(facts["landmarks"][..., 0, 0]), quality=quality, **facts,
    )  # fmt: skip
    report |= quality_report(capture.name, quality, measured.reshape(-1, MEASURES))
    for entry in layout.folder.iterdir():
        if entry.name not in (FRAMES, MATTES, CACHE):
            remove_tree(entry)
    names = {FRAMES: "frame_digests", MATTES: "matte_digests"}
    digests = {kind: join_chunks(chunks, name)[..., 0] for kind, name in names.items()}
    finish_capture(layout, out, capture, digests, report)
