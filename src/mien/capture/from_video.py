"""Turn a video into captures. This file runs the five steps that the docstring of `mien.capture` lists.

Only a few frames are in memory at a time.
"""

from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from mien.capture.capture import Capture
from mien.capture.frame_files import FRAMES, FrameLayout
from mien.capture.job import (
    CaptureJob,
    capture_once,
    check_place,
    cleaning_up,
    open_job,
    part_in,
    prepare,
    read_finished,
    read_source,
)
from mien.capture.parts import Part, check_one_size, find_parts, number_parts, tell_who, whole_part
from mien.capture.person.backend import Detector, detector_entry
from mien.capture.person.faces import second_difference_jitter
from mien.capture.person.given import GivenInputs, with_own_alpha
from mien.capture.person.people import face_shapes, group_people, most_difference, shape_difference
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
from mien.capture.store import JSON_NAME, check_room, partial_folder, read_capture
from mien.disk.locks import hold
from mien.disk.reading import remove_tree
from mien.errors import UserError
from mien.machine.progress import say

_CHUNKS = "chunks"
_NEIGHBORS = 4  # most captures of a workspace that a new one is compared with


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
    longest = drafts[max(kept, key=lambda index: parts[index].timesteps)]
    check_neighbors(sequences, job.name, job.frames.path, longest, job.detector)
    return number_parts([parts[index] for index in kept], job.name)


def check_neighbors(sequences: Path, name: str, path: Path, draft: Draft, detector: Detector) -> None:
    """Check that other captures of a workspace show the person of the new capture `name`.

    Captures that are too short to be sure are taken, with a warning.
    """
    shapes, doubt = None, ""
    for json_path in sorted(sequences.glob(f"*/capture/{JSON_NAME}"))[:_NEIGHBORS]:
        folder = json_path.parent.parent
        try:
            other = read_capture(json_path.parent)
        except UserError:
            continue  # whoever uses it says what is wrong with it
        if name in (folder.name, part_in(other.source).get("of")):
            continue
        shapes = face_shapes(draft.pictures(), detector) if shapes is None else shapes
        difference = shape_difference(shapes, face_shapes(other.images[:, 0], detector))
        if difference is None:
            continue
        if difference <= 1:
            return
        differ = f"the shapes of their faces differ {difference:.1f} times as much as those of one person do at most"
        if difference > most_difference(float(np.ptp(draft.part.survey.timestamps)), float(np.ptp(other.timestamps))):
            raise UserError(
                f"{path}: shows another person than {folder}: {differ}; give another workspace with --out, or "
                "--capture.person 0 if it is the same person"
            )
        doubt = (
            doubt or f"warning: {path}: may show another person than {folder}, but is too short to be sure: {differ}"
        )
    if doubt:
        say(doubt)


def _part_key(job: CaptureJob, number: int, count: int) -> str:
    return f"{job.key}-{number}-{count}"


def _capture_dir(sequences: Path, name: str) -> Path:
    return sequences / name / "capture"


def _read_finished_parts(sequences: Path, job: CaptureJob, tell: bool = True) -> list[Capture]:
    """Return all parts if all of them are finished, else an empty list."""
    whole = read_finished(_capture_dir(sequences, job.name), _part_key(job, 1, 1), tell)
    if whole is not None:
        return [whole]
    count = part_in(read_source(_capture_dir(sequences, f"{job.name}-1"))).get("count")
    if not isinstance(count, int):
        return []
    found: list[Capture] = []
    for number in range(1, count + 1):
        capture = read_finished(_capture_dir(sequences, f"{job.name}-{number}"), _part_key(job, number, count), tell)
        if capture is None:
            return []
        found.append(capture)
    return found


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
        is_ours = part_in(read_source(path.parent)).get("of") == job.name
        if is_ours and path.parent.parent.name not in names:
            say(
                f"warning: {path.parent.parent}: is left over from an earlier capture of {job.name}; "
                "delete it if you do not need it"
            )
