"""Captures of a video and of several cameras share these parts: the request, its key, and the folders of its work.

A capture that is finished is found by its key. Unfinished work is kept beside it, under the same key.
"""

import hashlib
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

import cv2

from mien.capture.capture import Capture
from mien.capture.person.backend import Detector, choose_detector, detector_entry
from mien.capture.person.given import GivenInputs, read_given
from mien.capture.settings import CaptureSettings
from mien.capture.store import FORMAT, JSON_NAME, VERSION, check_replaceable, read_capture
from mien.disk.files import cannot_write, file_digest, read_json, write_json
from mien.disk.locks import hold
from mien.disk.reading import check_tree, has_other_names, remove_tree
from mien.errors import UserError
from mien.machine.progress import say
from mien.machine.terminal import plain_name
from mien.media.source import FrameSelection, FrameSource, open_source

RECIPE = 7
"""Recipe version, raised whenever the same video would give another capture, so that old ones are made again."""
STATE = "state.json"
_Result = TypeVar("_Result", Capture, list[Capture])


@dataclass(frozen=True)
class CaptureJob:
    """Request of the user: a source, a name and settings."""

    frames: FrameSource
    settings: CaptureSettings
    name: str
    key: str
    replace: bool
    """Whether a capture of another source may be replaced."""
    detector: Detector = "mediapipe"

    def given(self) -> GivenInputs:
        """Read what the user gave besides the source."""
        settings = self.settings
        return read_given(self.frames, settings.clean_plate, settings.mattes, settings.landmarks)


def open_job(source: Path, settings: CaptureSettings, name: str | None, replace_others: bool) -> CaptureJob:
    """Open a source and compute the key of its capture. Its frames are not read."""
    settings.check()
    selection = FrameSelection(settings.start, settings.end, settings.stride, settings.max_frames)
    turns = settings.turn // 90
    frames = open_source(source, selection, settings.fps, turns, settings.deinterlace, settings.stream)
    name = name or plain_name(source.resolve().stem)
    # Files enter the key by their content, not by their path.
    contents = {
        "clean_plate": file_digest(settings.clean_plate) if settings.clean_plate else None,
        "landmarks": file_digest(settings.landmarks) if settings.landmarks else None,
        "mattes": open_source(settings.mattes, FrameSelection(), 25.0).content_hash if settings.mattes else None,
    }
    detector = "mediapipe" if settings.landmarks and settings.mattes else choose_detector(settings.detector)
    own = asdict(settings) | contents
    del own["detector"]
    content = {
        "recipe": RECIPE, "source": frames.content_hash, "name": name, "settings": own | detector_entry(detector),
    }  # fmt: skip
    key = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
    return CaptureJob(frames, settings, name, key, replace_others, detector)


def capture_once(folder: Path, read: Callable[[bool], _Result | None], work: Callable[[], _Result]) -> _Result:
    """Return what is finished already, or else do the work under the folder's lock. `read` may tell of damage."""
    finished = read(False)
    if finished:
        return finished
    with hold(folder):
        # Another process may have finished it before this one got the lock.
        return read(True) or work()


def check_place(out: Path, job: CaptureJob) -> None:
    """Refuse to replace anything but a capture of the same source, or of any source if the user allows it."""
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
            f"{out}: holds a capture of another source ({source.get('file', 'not made from a video')}); choose another "
            "name with --name, or add --replace to `mien capture`"
        )


@contextmanager
def cleaning_up(out: Path, survey_folder: Path) -> Iterator[Path]:
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


def prepare(work: Path, key: str) -> Path:
    """Prepare a folder for unfinished work. Its content is kept only if it belongs to the same key."""
    try:
        kept = read_json(work / STATE, "mien.capture_state", 1).get("key") == key
        # Links could make mien write somewhere else, and mien never makes any.
        check_tree(work)
        kept = kept and not work.is_symlink() and not has_other_names(work)
    except UserError:
        kept = False
    if not kept:
        remove_tree(work)
        work.mkdir(parents=True)
        write_json(work / STATE, "mien.capture_state", 1, {"key": key})
    return work


def read_source(out: Path) -> dict[str, Any] | None:
    """Return the `source` entry of the capture in a folder, or None if there is no readable capture."""
    try:
        source = read_json(out / JSON_NAME, FORMAT, VERSION).get("source")
    except UserError:
        return None
    return source if isinstance(source, dict) else None


def part_in(source: dict[str, Any] | None) -> dict[str, Any]:
    """Return the entry of a capture's `source` about the video that it is a part of, if it has one."""
    part = (source or {}).get("part")
    return part if isinstance(part, dict) else {}


def read_finished(out: Path, key: str, tell: bool = True) -> Capture | None:
    """Return the capture in a folder if it has this `key` and is intact. `tell` reports a damaged one."""
    source = read_source(out)
    if source is None or source.get("key") != key:
        return None
    try:
        return read_capture(out)
    except UserError as error:
        if tell:
            say(f"{str(error).split('; ')[0]}; it is captured again")
        return None
