"""From an avatar and a motion to pictures."""

import hashlib
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from mien.avatar.files import load_avatar
from mien.capture.settings import CaptureSettings
from mien.disk.files import file_digest, write_atomically
from mien.disk.workspace import Workspace, open_workspace
from mien.driving.drivers import Driver, read_recording, read_tracked_driver, with_neutral
from mien.driving.follower import FollowOptions
from mien.driving.rest import facing, rest_of
from mien.driving.transfer import drive, keep_to_filmed, place_torso
from mien.face.cache import cache_folder, cache_is_kept
from mien.face.model import FaceModel
from mien.machine.progress import say, track_progress
from mien.media.output import plan_output
from mien.media.pictures import side_by_side
from mien.media.source import FrameSelection, list_images, open_source
from mien.media.writing import write_pictures
from mien.pipeline.capture import run_capture_stage
from mien.pipeline.draw import draw, posed_softly, warn_of_white
from mien.pipeline.names import NEUTRALS, check_driver, check_neutral, is_picture, kind_of
from mien.pipeline.picture_options import PictureOptions
from mien.pipeline.track import run_tracking_stage
from mien.tracking.settings import TrackingSettings
from mien.training.run import filmed_range, run_camera


def open_driver(
    by: Path,
    sequence: str | None,
    face_model: FaceModel,
    fps: float | None = None,
    neutral: str | None = None,
    capture: CaptureSettings | None = None,
) -> Driver:
    """Open a driver: a workspace, a recording (csv, json, voice), or a film.

    A film is a video, a picture or a folder of pictures. It is captured (by `capture`), tracked and kept in the cache.
    `sequence` is one of a workspace, or a part of a film with cuts, all of which otherwise follow each other; `fps` is
    the rate of a csv's timecode; `neutral` is the driver's face at rest, as `--neutral` names it (`with_neutral`).
    """
    check_neutral(neutral)
    driver, other = _open(by, face_model, sequence, fps, capture), None
    if neutral is None and by.is_file() and kind_of(by) == "film" and is_picture(by):
        say(f"{by}: is one picture, so its motion is measured from the face model's neutral")
        neutral = "model"
    if neutral is not None and neutral not in NEUTRALS:
        other = _open(Path(neutral), face_model)
    return with_neutral(driver, face_model, neutral, str(by), other)


def _open(
    by: Path,
    face_model: FaceModel,
    sequence: str | None = None,
    fps: float | None = None,
    capture: CaptureSettings | None = None,
) -> Driver:
    kind, names = check_driver(by, sequence, fps, capture), None
    if kind == "recording":
        return read_recording(by, face_model, fps)
    if kind == "sequence":
        return read_tracked_driver([by], face_model)
    if kind == "film":
        workspace, names = tracked_film(by, face_model.name, capture)
    else:
        workspace = open_workspace(by)
    if names is None or sequence is not None:
        names = [workspace.pick_sequence(sequence)]
    return read_tracked_driver([workspace.sequence_dir(name) for name in names], face_model)


_FEWEST = 3  # frames that are tracked at least. Fewer pictures are repeated


def tracked_film(
    film: Path, face_model_name: str, capture: CaptureSettings | None = None
) -> tuple[Workspace, list[str]]:
    """The workspace of a video, a picture or a folder of pictures in this user's cache, and its sequences.

    They are captured and tracked if needed. Each way to capture them has a workspace of its own.
    """
    settings = capture or CaptureSettings()
    pictures = list_images(film) if film.is_dir() else [film] if is_picture(film) else []
    digest = open_source(film, FrameSelection(), 1.0).content_hash if film.is_dir() else file_digest(film)
    if settings != CaptureSettings():
        digest = hashlib.sha256(f"{digest} {settings}".encode()).hexdigest()
    workspace = Workspace(cache_folder() / "drivers" / f"{film.resolve().stem}-{digest[:12]}")
    source = film
    if 0 < len(pictures) < _FEWEST:
        source = workspace.root / film.resolve().stem
        for index, picture in enumerate(each for each in pictures for _ in range(_FEWEST)):
            content = picture.read_bytes()
            write_atomically(source / f"{index}{picture.suffix}", partial(Path.write_bytes, data=content))
    run_capture_stage(workspace, [source], (), None, settings)
    # The parts of a video with cuts are numbered: NAME-10 comes after NAME-2.
    tracked = run_tracking_stage(workspace, face_model_name, TrackingSettings(), overlay="none")
    names = sorted(tracked, key=lambda name: (len(name), name))
    kept = "kept for the next time" if cache_is_kept() else "for this command only; set MIEN_CACHE to keep it"
    say(f"{film}: tracked in {workspace.root}, {kept}")
    return workspace, names


def run_driving_stage(
    run_dir: Path,
    by: Path,
    out: Path,
    picture: PictureOptions | None = None,
    follow: FollowOptions | None = None,
    *,
    sequence: str | None = None,
    fps: float | None = None,
    neutral: str | None = None,
    capture: CaptureSettings | None = None,
    alone: bool = False,
) -> None:
    """Render a run's avatar as it follows a driver (`open_driver`).

    Pictures of the driver are beside it, unless `alone` is set.
    """
    follow, picture = follow or FollowOptions(), picture or PictureOptions()
    # The number of frames is known only after tracking, but a video or numbered pictures take any number.
    output = picture.plan(out, 2)
    avatar = load_avatar(run_dir)
    warn_of_white(picture, run_dir, avatar)
    driver = open_driver(by, sequence, avatar.face_model, fps, neutral, capture)
    bounds, filmed_by = avatar.face_model.expression_bounds, run_camera(run_dir)
    person = rest_of(avatar.subject, avatar.face_model, facing(filmed_by.viewmat)).face
    driven = drive(driver.face, driver.at_rest, person, bounds, follow.head_pose, str(by))
    if output.kind == "sequence":
        plan_output(out, len(driven), output.transparent)
    camera = filmed_by.fitted(*picture.shape())
    if not follow.unlimited:
        filmed = filmed_range(run_dir, avatar)
        driven, softened, parts = keep_to_filmed(driven, filmed, avatar.subject, avatar.face_model, camera.position)
        if softened:
            say(f"{softened} of {len(driven)} frames go beyond what was filmed and are softened; --unlimited lets go")
            say(f"softened most: {', '.join(parts[:5])}")
    of_driver = driver.face, driver.at_rest
    driven = place_torso(avatar.face_model, driven, avatar.subject, follow.torso, of_driver)
    beside = None if alone or output.transparent else driver.pictures
    pose = posed_softly(avatar)

    def frame(timestep: int) -> np.ndarray:
        shown = draw(picture, pose(driven[timestep]), camera, avatar.extras.closing)
        if beside is None:
            return shown
        theirs = beside(timestep)
        width = max(1, round(theirs.shape[1] * camera.height / theirs.shape[0]))
        return side_by_side([cv2.resize(theirs, (width, camera.height), interpolation=cv2.INTER_AREA), shown])

    frames = map(frame, range(len(driven)))
    sound = None if driver.sound is None else (driver.sound, len(driven) / driver.fps)
    if sound is not None and output.kind != "mp4":
        say(f"{out}: has no sound; only an .mp4 gets that of {driver.sound}")
        sound = None
    write_pictures(output, track_progress(frames, "Driving", len(driven)), driver.fps, sound)
    say(f"{out}: {len(driven)} frames")
