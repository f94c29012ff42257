"""Turn videos by several calibrated cameras into one capture, with the head at the same scale in all pictures."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from mien.camera import Camera
from mien.capture.cameras import readings
from mien.capture.cameras.calibration import CalibratedCamera, match_sources, read_calibration
from mien.capture.cameras.head_path import HeadPath, choose_crops, disagreeing, find_head_path, project
from mien.capture.capture import Capture
from mien.capture.frame_files import FrameLayout
from mien.capture.job import (
    RECIPE,
    CaptureJob,
    capture_once,
    check_place,
    cleaning_up,
    open_job,
    prepare,
    read_finished,
)
from mien.capture.parts import Part, check_one_size
from mien.capture.person.backend import detector_entry
from mien.capture.person.crop import Crop
from mien.capture.person.faces import LANDMARKS
from mien.capture.person.given import with_own_alpha
from mien.capture.person.people import Person, choose_person
from mien.capture.person.survey import Survey, kind_report, survey_source, tell_fields, tell_kind
from mien.capture.process import Chunk, finish, join_chunks, origin_of, process_part
from mien.capture.quality import frame_rate, tell_pauses
from mien.capture.settings import CaptureSettings
from mien.capture.store import check_room, partial_folder, read_capture
from mien.disk.files import file_digest
from mien.errors import UserError
from mien.machine.progress import say

_LANDMARKS_MOST_ASTRAY = 1.0
"""Largest distance between landmarks and the projected head, in sides of the landmarks' box. Farther ones are taken for
a false face, for example in hair seen from behind."""


@dataclass(frozen=True, eq=False)
class _View:
    camera_id: str
    job: CaptureJob
    survey: Survey
    person: Person
    camera: Camera
    """The camera for the source's pictures."""
    calibrated: CalibratedCamera
    """The camera as it is in the calibration."""


def capture_cameras(
    sources: Sequence[Path], calibration: Path, out: Path, name: str, settings: CaptureSettings | None = None,
    replace_others: bool = False,
) -> Capture:  # fmt: skip
    """Capture a head that several calibrated cameras filmed at the same time, as one capture into the folder `out`.

    Frame n of all videos is the same moment, after the offsets of the calibration file. The head's path is found from
    the faces in all pictures, and every camera is cropped to it, so a camera behind the head needs no face. Unfinished
    work of an interrupted run is continued.

    `sources` are a video or a folder of pictures for each camera, named by its id, or one folder with them, and
    `calibration` is the json file of the cameras (`read_calibration`). Mattes, landmarks and clean plates of the
    settings are folders with a file or folder for each camera, named by its id; cuts are not searched. A capture of the
    same sources in `out` is replaced, and with `replace_others` one of others; anything else is refused.
    """
    settings = settings or CaptureSettings()
    cameras = read_calibration(calibration)
    paths = match_sources(list(sources), cameras, calibration)
    jobs = [_job_of(path, camera, settings, replace_others) for path, camera in zip(paths, cameras, strict=True)]
    for job, camera in zip(jobs, cameras, strict=True):
        _check_size(job, camera)
    whole = _joined(jobs, cameras, name, file_digest(calibration))

    def work() -> Capture:
        _check_lengths(jobs, cameras)
        check_place(out, whole)
        with cleaning_up(out, partial_folder(out).with_suffix(".survey")) as survey_folder:
            views = _survey_views(jobs, cameras, prepare(survey_folder, whole.key))
            _capture_views(views, whole, settings, out)
        return read_capture(out)

    return capture_once(out, partial(read_finished, out, whole.key), work)


def _job_of(source: Path, camera: CalibratedCamera, settings: CaptureSettings, replace_others: bool) -> CaptureJob:
    """Return the job of one camera, with its own files of those that settings name."""
    own = {
        option: _file_of(path, camera.camera_id, option.replace("_", "-"))
        for option in ("clean_plate", "mattes", "landmarks")
        if (path := getattr(settings, option)) is not None
    }
    job = open_job(source, replace(settings, **own), camera.camera_id, replace_others)
    selection = replace(job.frames.selection, offset=camera.offset)
    return replace(job, frames=replace(job.frames, selection=selection, lens=camera.lens, colors=camera.colors))


def _check_size(job: CaptureJob, camera: CalibratedCamera) -> None:
    """Check the first picture of a camera, before faces are searched in any."""
    if camera.offset and camera.offset >= job.frames.count():
        raise UserError(
            f"camera {camera.camera_id}: its offset of {camera.offset} leaves no frame of {job.frames.path}; give the "
            "number of frames by which it started before the others"
        )
    height, width = next(job.frames.frames()).picture().shape[:2]
    camera.for_pictures(width, height)


def _check_lengths(jobs: list[CaptureJob], cameras: list[CalibratedCamera]) -> None:
    """Check the numbers of frames without decoding any. With --capture.start or --capture.end, times decide."""
    selections = [job.frames.selection for job in jobs]
    if any(selection.start or selection.end for selection in selections):
        return
    counts = {}
    for job, camera, selection in zip(jobs, cameras, selections, strict=True):
        taken = -(-max(0, job.frames.count() - selection.offset) // selection.stride)
        counts[camera.camera_id] = min(taken, selection.max_frames) if selection.max_frames else taken
    _check_counts(counts)


def _check_counts(counts: dict[str, int]) -> None:
    if len(set(counts.values())) > 1:
        shortest, longest = min(counts, key=lambda key: counts[key]), max(counts, key=lambda key: counts[key])
        raise UserError(
            f"camera {shortest} has {counts[shortest]} frames, but camera {longest} has {counts[longest]}; frames are "
            "paired by their number: cut the videos to the same length, correct the offsets, or use only the first "
            f"{counts[shortest]} frames with --capture.max-frames {counts[shortest]}"
        )


def _file_of(folder: Path, camera_id: str, option: str) -> Path:
    found = [entry for entry in folder.iterdir() if camera_id in (entry.name, entry.stem)] if folder.is_dir() else []
    if len(found) != 1:
        raise UserError(
            f"--capture.{option} {folder}: has {len(found)} entries for the camera {camera_id!r}; for several cameras "
            "give a folder with one file or folder for each, named by its id"
        )
    return found[0]


def _joined(jobs: list[CaptureJob], cameras: list[CalibratedCamera], name: str, calibration: str) -> CaptureJob:
    """Return the job of the whole: the first camera's, under the sequence's name and a key over all of them."""
    rates = [job.frames.fps for job in jobs]
    for camera, rate in zip(cameras, rates, strict=True):
        if abs(rate - rates[0]) > 0.01 * rates[0]:
            raise UserError(
                f"camera {camera.camera_id} has {rate:g} frames a second, camera {cameras[0].camera_id} {rates[0]:g}; "
                "frames are paired by their number, so give videos of one rate"
            )
    content = {"recipe": RECIPE, "name": name, "calibration": calibration, "keys": [job.key for job in jobs]}
    if any(camera.lens for camera in cameras):
        content["straightened"] = True
    key = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
    contents = hashlib.sha256("".join(job.frames.content_hash for job in jobs).encode()).hexdigest()
    return replace(jobs[0], frames=replace(jobs[0].frames, content_hash=contents), name=name, key=key)


def _survey_views(jobs: list[CaptureJob], cameras: list[CalibratedCamera], folder: Path) -> list[_View]:
    views = []
    for job, camera in zip(jobs, cameras, strict=True):
        given = job.given()
        tell_kind(job.frames)
        survey = survey_source(job.frames, folder / camera.camera_id, given.landmarks, job.detector)
        check_one_size(survey, job.frames.path)
        tell_fields(job.frames, survey)
        fitted = camera.for_pictures(*(int(side) for side in survey.picture_size))
        views.append(_View(camera.camera_id, job, survey, choose_person(survey), fitted, camera))
    _check_counts({view.camera_id: len(view.survey.timestamps) for view in views})
    return views


def _capture_views(views: list[_View], whole: CaptureJob, settings: CaptureSettings, out: Path) -> None:
    cameras = [view.camera for view in views]
    boxes = np.stack([view.person.boxes * np.tile(view.survey.picture_size, 2) for view in views], axis=1)
    path = find_head_path(boxes, cameras, lambda: _advice(views, boxes))
    for index, pixels in disagreeing(path, boxes, cameras).items():
        if not np.isfinite(pixels):
            raise UserError(
                f"camera {views[index].camera_id} finds a face, but the other cameras see the head behind it; correct "
                "its viewmat, which goes from world to camera with OpenCV axes"
            )
        say(
            f"warning: camera {views[index].camera_id} sees the face {pixels:.0f} pixels away from where the other "
            "cameras see it; check its calibration, its id and its offset"
        )
    crops, (width, height) = choose_crops(path, cameras, settings.size, settings.crop == "none")
    work = prepare(partial_folder(out), whole.key)
    layout = FrameLayout(work, tuple(view.camera_id for view in views), len(path.centers), height, width)
    check_room(layout, whole.name, out)
    parts, chunks = [], []
    for index, (view, crop) in enumerate(zip(views, crops, strict=True)):
        # Without faces that are somewhere else than the head.
        agreed = path.agrees[:, index, None] | ~path.known[:, None]
        person = replace(view.person, boxes=np.where(agreed, view.person.boxes, np.nan))
        part = Part(f"{whole.name}, camera {view.camera_id}", 0, view.survey, person, crop)
        parts.append(part)
        frames = view.job.frames
        given = with_own_alpha(view.job.given(), frames, view.survey.transparent)
        folder = work / f"chunks-{view.camera_id}"
        stream = enumerate(frames.frames())
        chunks.append(process_part(stream, part, given, layout, folder, index, whole.detector))
    _finish(views, whole, path, parts, layout, chunks, out)


def _advice(views: list[_View], boxes: Float[np.ndarray, "t c 4"]) -> str:
    """Return what to correct in a calibration that does not fit, found from landmarks in a few pictures."""
    timesteps = readings.some_timesteps(np.isfinite(boxes[..., 0]))
    landmarks = np.full((len(timesteps), len(views), LANDMARKS, 2), np.nan)
    for index, view in enumerate(views):
        given = view.job.given().landmarks
        if given is None:
            landmarks[:, index] = readings.landmarks_at(view.job.frames, boxes[:, index], timesteps, view.job.detector)
        else:
            landmarks[:, index] = given[view.survey.numbers[timesteps]]
    ranked = readings.rank_readings(landmarks, _readings(views))
    return readings.advice_of(ranked) if readings.is_wrong(ranked) else ""


def _readings(views: list[_View], parts: Sequence[Part] = ()) -> list[readings.Reading]:
    """Return how the calibration may be read, for the source's pictures or for the captured parts of them."""

    def fitted(index: int, camera: Camera) -> Camera:
        camera = camera.resized(views[index].camera.width, views[index].camera.height)
        return _cropped(camera, parts[index].crop) if parts else camera

    return [
        readings.Reading(reading.remedies, tuple(fitted(*each) for each in enumerate(reading.cameras)))
        for reading in readings.readings_of([view.calibrated.camera for view in views])
    ]


def _finish(
    views: list[_View], whole: CaptureJob, path: HeadPath, parts: list[Part], layout: FrameLayout,
    chunks: list[list[Chunk]], out: Path,
) -> None:  # fmt: skip
    cameras = tuple(_cropped(view.camera, part.crop) for view, part in zip(views, parts, strict=True))
    landmarks = join_chunks(chunks, "landmarks")
    readings.warn_of_misfit(readings.rank_readings(landmarks, _readings(views, parts)))
    _remove_astray(landmarks, path, cameras)
    timestamps, valid = views[0].survey.timestamps, np.isfinite(landmarks[..., 0, 0])
    report = {
        "frames": len(timestamps),
        "frames_without_face": int((~valid.any(axis=1)).sum()),
        "faces_by_camera": dict(zip(layout.camera_ids, valid.sum(axis=0).tolist(), strict=True)),
        "kind_by_camera": {view.camera_id: kind_report(view.job.frames, view.survey) for view in views},
        **tell_pauses(whole.name, timestamps),
    }
    source = {
        "key": whole.key,
        "file": ", ".join(view.job.frames.path.name for view in views),
        "content_hash": whole.frames.content_hash,
        "cameras": {
            view.camera_id: {"file": view.job.frames.path.name, **origin_of(part)}
            for view, part in zip(views, parts, strict=True)
        },
        **detector_entry(views[0].job.given().found_by(whole.detector)),
    }
    finish(
        layout, out, chunks, report, name=whole.name, fps=frame_rate(timestamps, whole.frames.fps),
        timestamps=timestamps, landmarks=landmarks,
        principal_point=np.stack([camera.K[:2, 2].numpy() for camera in cameras]).astype(np.float64), source=source,
        calibration=cameras,
    )  # fmt: skip


def _cropped(camera: Camera, crop: Crop) -> Camera:
    cut = camera.cropped(float(crop.left), float(crop.top), crop.crop_width, crop.crop_height)
    return cut.resized(crop.width, crop.height)


def _remove_astray(landmarks: Float[np.ndarray, "t c l 2"], path: HeadPath, cameras: tuple[Camera, ...]) -> None:
    """Remove landmarks that were found far from the head, for example in hair seen from behind."""
    for index, camera in enumerate(cameras):
        found = landmarks[:, index]
        least, most = found.min(axis=1), found.max(axis=1)
        side = np.maximum((most - least).max(axis=1), 1.0)
        with np.errstate(invalid="ignore"):
            away = np.linalg.norm((least + most) / 2 - project(path.centers, camera), axis=1)
            is_astray = away > _LANDMARKS_MOST_ASTRAY * side
        found[is_astray] = np.nan
