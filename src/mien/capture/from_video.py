"""Turn a video into captures: crop the head out of every frame, find its landmarks and make its matte.

Only a few frames are in memory at a time.
"""

import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2

from mien.capture.capture import Capture
from mien.capture.finished import read_finished, read_source
from mien.capture.frame_files import FrameLayout
from mien.capture.given import GivenMattes, check_mattes, read_landmarks
from mien.capture.outcome import CAMERA_ID, Origin, finish_part
from mien.capture.parts import find_parts, whole_part
from mien.capture.process import Means, Part, Reel, process_part
from mien.capture.settings import CaptureSettings
from mien.capture.source import FrameSelection, FrameSource, open_source, read_image
from mien.capture.store import JSON_NAME, check_replaceable, partial_folder, read_capture
from mien.capture.survey import Survey, survey_source
from mien.capture.upright import check_upright
from mien.errors import UserError
from mien.inside import check_tree, has_other_names, remove_tree
from mien.locks import hold
from mien.progress import say
from mien.storage import cannot_write, file_digest, read_json, write_json
from mien.terminal import plain_name

_RECIPE = 4
"""Recipe version, raised whenever the same video would give another capture, so that old ones are made again."""
_STATE, _CHUNKS = "state.json", "chunks"


@dataclass(frozen=True)
class _Job:
    """Request of the user: a source, a name and settings."""

    frames: FrameSource
    settings: CaptureSettings
    name: str
    key: str
    replace: bool


def capture_video(
    source: Path, out: Path, settings: CaptureSettings | None = None, name: str | None = None, replace: bool = False
) -> Capture:
    """Capture the head in a video or in a folder of images into the folder `out`, as one capture even if it has cuts.

    An `out` that was made earlier from the same source with the same settings is read back. Unfinished work of an
    interrupted run is kept beside `out` and continued; the result does not depend on interruptions. Memory use does not
    grow with the length of the video.

    Args:
        source: video file or folder of images.
        out: the capture's folder. A capture of the same source in it is replaced; anything else is refused.
        settings: settings of the capture; the defaults if None.
        name: name of the sequence; by default the source's name without its ending.
        replace: whether a capture of another source may be replaced too.

    Raises:
        UserError: the source is no video or shows no face, or a folder cannot be written, is damaged or being written.
    """
    job = _job(source, settings or CaptureSettings(), name, replace)
    capture = read_finished(out, _part_key(job, 1, 1), tell=False)
    if capture is not None:
        return capture
    with hold(out):
        return _capture_whole(out, job)


def _capture_whole(out: Path, job: _Job) -> Capture:
    # Another process may have finished it before this one got the lock.
    capture = read_finished(out, _part_key(job, 1, 1))
    if capture is not None:
        return capture
    _check_place(out, job)
    scratch = partial_folder(out).with_suffix(".survey")
    with _tidy(out, scratch) as survey_folder:
        means = _means(job)
        survey = _survey(job, survey_folder, means)
        part = whole_part(survey, job.settings, job.frames.path, job.name)
        _process(job, Reel(job.frames), part, (1, 1), means, out)
    return read_capture(out)


def capture_video_parts(
    source: Path,
    sequences: Path,
    settings: CaptureSettings | None = None,
    name: str | None = None,
    replace: bool = False,
) -> list[Capture]:
    """Capture a video into `sequences`/NAME/capture, or, if it has cuts, each shot into NAME-1, NAME-2, ...

    Each part is captured as by `capture_video`. The source is read only twice, however many parts there are.

    Args:
        source: video file or folder of images.
        sequences: folder of the subject's sequences.
        settings: settings of the capture; `cuts` decides whether cuts are searched.
        name: NAME; by default the source's name without its ending.
        replace: whether captures of another source may be replaced too.

    Returns:
        The captures in the video's order. The `name` of each is the name of its folder.

    Raises:
        UserError: the source is no video or shows no face, or a folder cannot be written, is damaged or being written.
    """
    job = _job(source, settings or CaptureSettings(), name, replace)
    finished = _read_finished_parts(sequences, job, tell=False)
    if finished:
        return finished
    with hold(sequences / job.name):
        return _capture_parts(sequences, job)


def _capture_parts(sequences: Path, job: _Job) -> list[Capture]:
    # Another process may have finished them before this one got the lock.
    finished = _read_finished_parts(sequences, job)
    if finished:
        return finished
    for first in (job.name, f"{job.name}-1"):
        _check_place(_place(sequences, first), job)
    with _tidy(_place(sequences, job.name), sequences / f".{job.name}.survey") as survey_folder:
        means = _means(job)
        survey = _survey(job, survey_folder, means)
        parts = find_parts(survey, job.settings, job.frames.path, job.name)
        with hold(*(sequences / part.name for part in parts if part.name != job.name)):
            for part in parts:
                _check_place(_place(sequences, part.name), job)
            reel = Reel(job.frames)
            for number, part in enumerate(parts, 1):
                _process(job, reel, part, (number, len(parts)), means, _place(sequences, part.name))
    _tell_leftovers(sequences, job, {part.name for part in parts})
    return [read_capture(_place(sequences, part.name)) for part in parts]


def _job(source: Path, settings: CaptureSettings, name: str | None, replace_others: bool) -> _Job:
    settings.check()
    selection = FrameSelection(settings.start, settings.end, settings.stride, settings.max_frames)
    frames = open_source(source, selection, settings.fps, settings.turn // 90)
    name = name or plain_name(source.resolve().stem)
    # Files enter the key by their content, not by their path.
    contents = {
        "clean_plate": file_digest(settings.clean_plate) if settings.clean_plate else None,
        "landmarks": file_digest(settings.landmarks) if settings.landmarks else None,
        "mattes": open_source(settings.mattes, FrameSelection(), 25.0).content_hash if settings.mattes else None,
    }
    content = {
        "recipe": _RECIPE,
        "source": frames.content_hash,
        "name": name,
        "settings": asdict(settings) | contents,
    }
    key = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
    return _Job(frames, settings, name, key, replace_others)


def _part_key(job: _Job, number: int, count: int) -> str:
    return f"{job.key}-{number}-{count}"


def _place(sequences: Path, name: str) -> Path:
    return sequences / name / "capture"


def _read_finished_parts(sequences: Path, job: _Job, tell: bool = True) -> list[Capture]:
    """Return all parts if all of them are finished, else an empty list."""
    whole = read_finished(_place(sequences, job.name), _part_key(job, 1, 1), tell)
    if whole is not None:
        return [whole]
    source = read_source(_place(sequences, f"{job.name}-1")) or {}
    part = source.get("part")
    count = part.get("count") if isinstance(part, dict) else None
    if not isinstance(count, int):
        return []
    found: list[Capture] = []
    for number in range(1, count + 1):
        capture = read_finished(_place(sequences, f"{job.name}-{number}"), _part_key(job, number, count), tell)
        if capture is None:
            return []
        found.append(capture)
    return found


def _check_place(out: Path, job: _Job) -> None:
    """Refuse to replace anything but a capture of the same source, or of any source if the user allows it.

    Raises:
        UserError: the folder holds something else, or a capture of another source.
    """
    try:
        check_replaceable(out)
    except OSError as error:
        raise cannot_write(out, error) from None
    if job.replace or not (out / JSON_NAME).exists():
        return
    source = read_source(out)
    if source is None:
        say(f"{out}: the capture in it is damaged or of another version; it is made again")
    elif source.get("content_hash") != job.frames.content_hash:
        raise UserError(
            f"{out}: holds a capture of something else ({source.get('file', 'not made from a video')}); choose another "
            "name with --name, or add --replace to `mien capture`"
        )


@contextmanager
def _tidy(out: Path, survey_folder: Path) -> Iterator[Path]:
    """Yield the folder for the survey and remove it at the end. After a UserError, remove new empty folders too."""
    missing = [folder for folder in (out.parent, *out.parent.parents) if not folder.exists()]
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # one thread detects and another refines and writes; more would slow them down
    try:
        yield survey_folder
    except OSError as error:
        raise cannot_write(out, error) from None
    except UserError:
        remove_tree(survey_folder)
        for folder in missing:
            if folder.is_dir() and not any(folder.iterdir()):
                folder.rmdir()
        raise
    finally:
        cv2.setNumThreads(threads)
    remove_tree(survey_folder)


def _prepare(work: Path, key: str) -> Path:
    """Prepare a folder for unfinished work. Its content is kept only if it belongs to the same key."""
    try:
        kept = read_json(work / _STATE, "mien.capture_state", 1).get("key") == key
    except UserError:
        kept = False
    if not kept or _leads_out(work):
        remove_tree(work)
        work.mkdir(parents=True)
        write_json(work / _STATE, "mien.capture_state", 1, {"key": key})
    return work


def _leads_out(work: Path) -> bool:
    """Whether links in the unfinished work could make mien write somewhere else. Such a folder is not mien's own."""
    try:
        check_tree(work)
        return work.is_symlink() or has_other_names(work)
    except UserError:
        return True


def _means(job: _Job) -> Means:
    """Read and check what the user gave besides the source, before anything that takes long."""
    settings, frames = job.settings, job.frames
    if settings.clean_plate is None and settings.mattes is None and settings.landmarks is None:
        return Means()
    first = next(frames.frames())
    height, width = first.picture().shape[:2]
    plate, mattes, landmarks = None, None, None
    if settings.clean_plate is not None:
        plate = read_image(settings.clean_plate)
        if plate.shape[:2] != (height, width):
            raise UserError(
                f"--capture.clean-plate {settings.clean_plate}: is {plate.shape[1]}x{plate.shape[0]}, the video's "
                f"pictures are {width}x{height}; give a picture by the same camera in the same mode"
            )
    if settings.mattes is not None:
        check_mattes(settings.mattes, frames)
        GivenMattes(settings.mattes, (width, height)).check(first.number)
        mattes = GivenMattes(settings.mattes, (width, height))
    if settings.landmarks is not None:
        landmarks = read_landmarks(settings.landmarks, frames.count())
    return Means(plate, mattes, landmarks)


def _survey(job: _Job, folder: Path, means: Means) -> Survey:
    if job.frames.hdr:
        say(f"{job.frames.path}: HDR video ({job.frames.hdr}); its pictures are tone-mapped to sRGB")
    survey = survey_source(job.frames, _prepare(folder, job.key), means.landmarks)
    if means.landmarks is None:
        check_upright(job.frames, survey, job.settings.turn)
    return survey


def _process(job: _Job, reel: Reel, part: Part, place: tuple[int, int], means: Means, out: Path) -> None:
    """Capture one part, unless that has been done."""
    key = _part_key(job, *place)
    if read_finished(out, key) is not None:
        return
    work = _prepare(partial_folder(out), key)
    layout = FrameLayout(work, (CAMERA_ID,), part.timesteps, part.crop.height, part.crop.width)
    chunks = process_part(reel, part, means, layout, work / _CHUNKS)
    finish_part(layout, out, chunks, part, Origin(job.frames, key, job.name, place), (_STATE, _CHUNKS))


def _tell_leftovers(sequences: Path, job: _Job, names: set[str]) -> None:
    """Warn about sequences that an earlier capture of the same video left under other names."""
    for path in sorted(sequences.glob(f"*/capture/{JSON_NAME}")):
        source = read_source(path.parent) or {}
        part = source.get("part")
        is_ours = isinstance(part, dict) and part.get("of") == job.name
        if is_ours and path.parent.parent.name not in names:
            say(f"warning: {path.parent.parent}: left from an earlier capture of {job.name}; delete it unless needed")
