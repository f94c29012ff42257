"""Turn a video into captures. This file runs the five steps that the docstring of `mien.capture` lists.

Only a few frames are in memory at a time.
"""

import hashlib
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
from jaxtyping import UInt8

from mien.capture.capture import Capture
from mien.capture.frame_files import FRAMES, FrameLayout
from mien.capture.parts import Part, check_one_size, find_parts, number_parts, tell_who, whole_part
from mien.capture.person.backend import Detector, choose_detector, detector_entry
from mien.capture.person.faces import second_difference_jitter
from mien.capture.person.given import GivenInputs, read_given, with_own_alpha
from mien.capture.person.people import face_shapes, group_people, shape_difference
from mien.capture.person.survey import (
    Survey,
    check_upright,
    kind_report,
    no_face,
    survey_source,
    tell_fields,
    tell_kind,
)
from mien.capture.process import Chunk, Stream, finish, join_chunks, origin_of, process_part
from mien.capture.quality import frame_rate, pace_report
from mien.capture.settings import CaptureSettings
from mien.capture.store import FORMAT, JSON_NAME, VERSION, check_replaceable, check_room, partial_folder, read_capture
from mien.disk.files import cannot_write, file_digest, read_json, write_json
from mien.disk.locks import hold
from mien.disk.reading import check_tree, has_other_names, remove_tree
from mien.errors import UserError
from mien.machine.progress import say
from mien.machine.terminal import plain_name
from mien.media.source import FrameSelection, FrameSource, open_source

RECIPE = 7
"""Recipe version, raised whenever the same video would give another capture, so that old ones are made again."""
STATE, _CHUNKS = "state.json", "chunks"
_NEIGHBORS = 4  # most captures of a workspace that a new one is compared with
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


@dataclass(frozen=True, eq=False)
class Draft:
    """A part whose frames and mattes are written, but not the files beside them."""

    part: Part
    layout: FrameLayout
    chunks: list[Chunk]

    def pictures(self) -> np.ndarray:
        """Frames [t, h, w, 3] as a memory map."""
        return np.memmap(self.layout.raw(FRAMES), np.uint8, "r", shape=self.layout.shape(FRAMES))[:, 0]


def capture_video(
    source: Path, out: Path, settings: CaptureSettings | None = None, name: str | None = None, replace: bool = False
) -> Capture:
    """Capture the head in a video or in a folder of images into the folder `out`, as one capture even if it has cuts.

    An `out` that was made earlier from the same source with the same settings is read back. Unfinished work of an
    interrupted run is kept beside `out` and continued; the result does not depend on interruptions. Memory use does not
    grow with the length of the video. A capture of the same source in `out` is replaced, and with `replace` one of
    another source; anything else is refused. `name` is by default the source's name without its ending.
    """
    job = open_job(source, settings or CaptureSettings(), name, replace)
    return capture_once(out, partial(read_finished, out, _part_key(job, 1, 1)), partial(_capture_whole, out, job))


def capture_once(folder: Path, read: Callable[[bool], _Result | None], work: Callable[[], _Result]) -> _Result:
    """Return what is finished already, or else do the work under the folder's lock. `read` may tell of damage."""
    finished = read(False)
    if finished:
        return finished
    with hold(folder):
        # Another process may have finished it before this one got the lock.
        return read(True) or work()


def _capture_whole(out: Path, job: CaptureJob) -> Capture:
    check_place(out, job)
    with cleaning_up(out, partial_folder(out).with_suffix(".survey")) as survey_folder:
        survey, given = _run_survey(job, survey_folder)
        part = whole_part(survey, job.settings, job.frames.path, job.name)
        draft = _draft(job, enumerate(job.frames.frames()), part, (1, 1), given, out)
        if draft is not None:
            _finish(job, draft, (1, 1), given, out)
    return read_capture(out)


def capture_video_parts(
    source: Path, sequences: Path, settings: CaptureSettings | None = None, name: str | None = None,
    replace: bool = False,
) -> list[Capture]:  # fmt: skip
    """Capture a video into `sequences`/NAME/capture, or, if it has cuts, each shot into NAME-1, NAME-2, ...

    Each part is captured as by `capture_video`. The source is read only twice, however many parts there are. The
    captures are returned in the video's order; the `name` of each is the name of its folder.
    """
    job = open_job(source, settings or CaptureSettings(), name, replace)
    read, work = (partial(each, sequences, job) for each in (_read_finished_parts, _capture_parts))
    return capture_once(sequences / job.name, read, work)


def is_captured(source: Path, sequences: Path, settings: CaptureSettings, name: str) -> bool:
    """Whether `capture_video_parts` would find all captures of a video finished."""
    return bool(_read_finished_parts(sequences, open_job(source, settings, name, False), tell=False))


def _capture_parts(sequences: Path, job: CaptureJob) -> list[Capture]:
    for first in (job.name, f"{job.name}-1"):
        check_place(_capture_dir(sequences, first), job)
    with cleaning_up(_capture_dir(sequences, job.name), sequences / f".{job.name}.survey") as survey_folder:
        survey, given = _run_survey(job, survey_folder)
        parts = find_parts(survey, job.settings, job.frames.path, job.name)
        with hold(*(sequences / part.name for part in parts if part.name != job.name)):
            for part in parts:
                check_place(_capture_dir(sequences, part.name), job)
            parts = _capture_one_person(sequences, job, parts, given)
    _tell_leftovers(sequences, job, {part.name for part in parts})
    return [read_capture(_capture_dir(sequences, part.name)) for part in parts]


def _capture_one_person(sequences: Path, job: CaptureJob, parts: list[Part], given: GivenInputs) -> list[Part]:
    """Capture the parts that show the person of the settings, and return them under their final names."""
    stream, drafts = enumerate(job.frames.frames()), []
    for number, part in enumerate(parts, 1):
        out = _capture_dir(sequences, part.name)
        drafts.append(_draft(job, stream, part, (number, len(parts)), given, out))
    unfinished = [draft for draft in drafts if draft is not None]
    if len(unfinished) == len(parts) and job.settings.person:
        # Parts that are finished were compared by the call that was interrupted.
        try:
            parts = _kept(sequences, job, unfinished)
        except UserError:
            _discard(unfinished)
            raise
        drafts = [draft for draft in drafts if any(draft.part.start == part.start for part in parts)]
    for number, (draft, part) in enumerate(zip(drafts, parts, strict=True), 1):
        if draft is not None:
            place, out = (number, len(parts)), _capture_dir(sequences, part.name)
            out.parent.mkdir(exist_ok=True)
            _finish(job, replace(draft, part=part), place, given, out)
    _discard(unfinished)
    return parts


def _discard(drafts: list[Draft]) -> None:
    for draft in drafts:
        remove_tree(draft.layout.folder)
        with suppress(OSError):  # a capture is in it
            draft.layout.folder.parent.rmdir()


def _kept(sequences: Path, job: CaptureJob, drafts: list[Draft]) -> list[Part]:
    parts, person = [draft.part for draft in drafts], job.settings.person
    shapes = [face_shapes(draft.pictures(), job.detector) for draft in drafts] if len(drafts) > 1 else []
    people = group_people(shapes, [part.timesteps for part in parts]) if shapes else [[0]]
    tell_who(job.frames.path, parts, people, person)
    kept = people[person - 1]
    first = drafts[max(kept, key=lambda index: parts[index].timesteps)]
    check_neighbors(sequences, job.name, job.frames.path, first.pictures(), job.detector)
    return number_parts([parts[index] for index in kept], job.name)


def check_neighbors(
    sequences: Path, name: str, path: Path, pictures: UInt8[np.ndarray, "t h w 3"], detector: Detector
) -> None:
    """Check that other captures of a workspace show the person of the pictures of the new capture `name`."""
    shapes = None
    for json_path in sorted(sequences.glob(f"*/capture/{JSON_NAME}"))[:_NEIGHBORS]:
        folder = json_path.parent.parent
        try:
            other = read_capture(json_path.parent)
        except UserError:
            continue  # whoever uses it says what is wrong with it
        if name in (folder.name, _part_in(other.source).get("of")):
            continue
        shapes = face_shapes(pictures, detector) if shapes is None else shapes
        difference = shape_difference(shapes, face_shapes(other.images[:, 0], detector))
        if difference is None:
            continue
        if difference <= 1:
            return
        raise UserError(
            f"{path}: shows another person than {folder}: the shapes of their faces differ {difference:.1f} times as "
            "much as those of one person do at most; give another workspace with --out, or --capture.person 0 if it is "
            "the same person"
        )


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


def _part_key(job: CaptureJob, number: int, count: int) -> str:
    return f"{job.key}-{number}-{count}"


def _capture_dir(sequences: Path, name: str) -> Path:
    return sequences / name / "capture"


def _read_finished_parts(sequences: Path, job: CaptureJob, tell: bool = True) -> list[Capture]:
    """Return all parts if all of them are finished, else an empty list."""
    whole = read_finished(_capture_dir(sequences, job.name), _part_key(job, 1, 1), tell)
    if whole is not None:
        return [whole]
    count = _part_in(_read_source(_capture_dir(sequences, f"{job.name}-1"))).get("count")
    if not isinstance(count, int):
        return []
    found: list[Capture] = []
    for number in range(1, count + 1):
        capture = read_finished(_capture_dir(sequences, f"{job.name}-{number}"), _part_key(job, number, count), tell)
        if capture is None:
            return []
        found.append(capture)
    return found


def check_place(out: Path, job: CaptureJob) -> None:
    """Refuse to replace anything but a capture of the same source, or of any source if the user allows it."""
    try:
        check_replaceable(out)
    except OSError as error:
        raise cannot_write(out, error) from None
    if job.replace or not (out / JSON_NAME).exists():
        return
    source = _read_source(out)
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


def _run_survey(job: CaptureJob, folder: Path) -> tuple[Survey, GivenInputs]:
    given = job.given()
    tell_kind(job.frames)
    survey = survey_source(job.frames, prepare(folder, job.key), given.landmarks, job.detector)
    given = with_own_alpha(given, job.frames, survey.transparent)
    if any(value is not None for value in vars(given).values()):
        check_one_size(survey, job.frames.path)
    tell_fields(job.frames, survey)
    if given.landmarks is None:
        check_upright(job.frames, survey, job.settings.turn, job.detector)
    return survey, given


def _draft(
    job: CaptureJob, stream: Stream, part: Part, place: tuple[int, int], given: GivenInputs, out: Path
) -> Draft | None:
    """Write the frames and mattes of a part beside `out`, or return None if the part is finished."""
    key = _part_key(job, *place)
    if read_finished(out, key) is not None:
        return None
    work = prepare(partial_folder(out), key)
    layout = FrameLayout(work, ("0",), part.timesteps, part.crop.height, part.crop.width)
    check_room(layout, part.name, out)
    return Draft(part, layout, process_part(stream, part, given, layout, work / _CHUNKS, detector=job.detector))


def _finish(job: CaptureJob, draft: Draft, place: tuple[int, int], given: GivenInputs, out: Path) -> None:
    part, survey = draft.part, draft.part.survey
    landmarks = join_chunks([draft.chunks], "landmarks")
    missed = int(np.isnan(landmarks[:, 0, 0, 0]).sum())
    if missed == len(landmarks):
        remove_tree(draft.layout.folder)
        raise no_face(job.frames.path, missed)
    timestamps, jitter = survey.timestamps - survey.timestamps[0], second_difference_jitter(landmarks[:, 0])
    taken_off = np.concatenate([chunk.taken_off for chunk in draft.chunks])
    report = {
        "frames": len(landmarks),
        "frames_without_face": missed,
        "frames_with_several_faces": int(part.person.crowded.sum()),
        "matte_pixels_taken_off": round(float(taken_off.mean()), 1),
        "landmark_jitter_px": jitter if np.isfinite(jitter) else None,
        **kind_report(job.frames, survey),
        **pace_report(part.name, timestamps),
    }
    if missed:
        say(f"{part.name}: no face in {missed} of {len(landmarks)} frames; they are left out")
    source = {
        "key": _part_key(job, *place),
        "file": job.frames.path.name,
        "content_hash": job.frames.content_hash,
        **origin_of(part),
        "part": {"of": job.name, "number": place[0], "count": place[1]},
        **detector_entry(given.found_by(job.detector)),
    }
    finish(
        draft.layout, out, [draft.chunks], report, name=part.name, fps=frame_rate(timestamps, job.frames.fps),
        timestamps=timestamps, landmarks=landmarks, principal_point=part.crop.to_output(survey.picture_size / 2)[None],
        source=source,
    )  # fmt: skip


def _tell_leftovers(sequences: Path, job: CaptureJob, names: set[str]) -> None:
    """Warn about sequences that an earlier capture of the same video left under other names."""
    for path in sorted(sequences.glob(f"*/capture/{JSON_NAME}")):
        is_ours = _part_in(_read_source(path.parent)).get("of") == job.name
        if is_ours and path.parent.parent.name not in names:
            say(
                f"warning: {path.parent.parent}: is left over from an earlier capture of {job.name}; "
                "delete it if you do not need it"
            )


def _read_source(out: Path) -> dict[str, Any] | None:
    """Return the `source` entry of the capture in a folder, or None if there is no readable capture."""
    try:
        source = read_json(out / JSON_NAME, FORMAT, VERSION).get("source")
    except UserError:
        return None
    return source if isinstance(source, dict) else None


def _part_in(source: dict[str, Any] | None) -> dict[str, Any]:
    """Return the entry of a capture's `source` about the video that it is a part of, if it has one."""
    part = (source or {}).get("part")
    return part if isinstance(part, dict) else {}


def read_finished(out: Path, key: str, tell: bool = True) -> Capture | None:
    """Return the capture in a folder if it has this `key` and is intact. `tell` reports a damaged one."""
    source = _read_source(out)
    if source is None or source.get("key") != key:
        return None
    try:
        return read_capture(out)
    except UserError as error:
        if tell:
            say(f"{str(error).split('; ')[0]}; it is captured again")
        return None
