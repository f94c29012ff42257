"""Video in, capture out: the head cut out of every frame, landmarks, mattes; a few frames in memory at a time."""

import hashlib
import json
import shutil
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float

from mien.capture.capture import Capture
from mien.capture.crop import Crop, choose_crop, whole_picture
from mien.capture.faces import second_difference_jitter
from mien.capture.frame_files import FRAMES, MATTES, FrameLayout
from mien.capture.process import Chunk, process_frames
from mien.capture.source import FrameSelection, FrameSource, open_source
from mien.capture.store import (
    FORMAT,
    JSON_NAME,
    VERSION,
    CaptureData,
    cannot_write,
    check_replaceable,
    finish_capture,
    partial_folder,
    read_capture,
)
from mien.capture.survey import Survey, no_face, survey_faces
from mien.errors import UserError
from mien.progress import say
from mien.storage import read_json, write_json

CAMERA_ID = "0"
_RECIPE = 2
"""Raised whenever the same video would give another capture, so that old ones are not taken for current."""
_SMALLEST_SIZE = 32
_RATE_TOLERANCE = 0.01
_STATE, _SURVEY, _CHUNKS = "state.json", "survey.safetensors", "chunks"


@dataclass(frozen=True)
class CaptureSettings:
    """How a video becomes a capture."""

    size: int = 512
    """Longest side of the captured frames in pixels; smaller sources are not enlarged."""
    crop: Literal["auto", "none"] = "auto"
    """auto: one square around the head for the whole clip; none: the whole picture."""
    start: float = 0.0
    """Seconds to skip at the beginning."""
    stride: int = 1
    """Take every n-th frame."""
    max_frames: int = 0
    """Stop after so many frames; 0 takes all."""
    fps: float = 25.0
    """Frames a second of a folder of images; videos know their own."""


@dataclass(frozen=True)
class _Origin:
    """What a capture is made from."""

    frames: FrameSource
    crop: Crop
    name: str
    key: str


def capture_video(source: Path, out: Path, settings: CaptureSettings | None = None, name: str | None = None) -> Capture:
    """Capture the head in a video, or in a folder of images, into the folder `out`.

    An `out` made earlier from the same source with the same settings is read back. What an interrupted run has done is
    kept beside `out` and continued; the result does not depend on interruptions. Memory does not grow with the length.

    Args:
        source: video file or folder of images.
        out: the capture's folder; a capture in it is replaced, anything else is refused.
        settings: how; the defaults by default.
        name: of the sequence; by default the source's name without its ending.

    Raises:
        UserError: the source is no video or shows no face, or `out` cannot be written or is damaged.
    """
    settings = settings or CaptureSettings()
    if settings.size < _SMALLEST_SIZE:
        raise UserError(f"size {settings.size}: too small for a face; give at least {_SMALLEST_SIZE}, better 512")
    frames = open_source(source, FrameSelection(settings.start, settings.stride, settings.max_frames), settings.fps)
    name = name or source.resolve().stem
    key = _key(frames, settings, name)
    if _is_finished(out, key):
        return read_capture(out)
    cv2.setNumThreads(1)  # one thread detects, another refines and writes; more would stand in their way
    try:
        check_replaceable(out)
        work = _prepare(partial_folder(out), key)
        survey = survey_faces(frames, work / _SURVEY)
        crop = _choose_crop(survey, settings)
        layout = FrameLayout(work, (CAMERA_ID,), len(survey.timestamps), crop.height, crop.width)
        chunks = process_frames(frames, survey, crop, layout, work / _CHUNKS)
        _finish(layout, out, chunks, survey, _Origin(frames, crop, name, key))
    except OSError as error:
        raise cannot_write(out, error) from None
    return read_capture(out)


def _key(frames: FrameSource, settings: CaptureSettings, name: str) -> str:
    content = {"recipe": _RECIPE, "source": frames.content_hash, "name": name, "settings": asdict(settings)}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _is_finished(out: Path, key: str) -> bool:
    try:
        source = read_json(out / JSON_NAME, FORMAT, VERSION).get("source")
    except UserError:
        return False
    return isinstance(source, dict) and source.get("key") == key


def _prepare(work: Path, key: str) -> Path:
    """The folder for unfinished work; what is in it is kept only if it belongs to the same key."""
    try:
        kept = read_json(work / _STATE, "mien.capture_state", 1).get("key") == key
    except UserError:
        kept = False
    if not kept:
        shutil.rmtree(work, ignore_errors=True)
        work.mkdir(parents=True)
        write_json(work / _STATE, "mien.capture_state", 1, {"key": key})
    return work


def _choose_crop(survey: Survey, settings: CaptureSettings) -> Crop:
    width, height = (int(side) for side in survey.picture_size)
    if settings.crop == "none":
        return whole_picture(width, height, settings.size)
    return choose_crop(survey.boxes, width, height, settings.size)


def _finish(layout: FrameLayout, out: Path, chunks: list[Chunk], survey: Survey, origin: _Origin) -> None:
    landmarks = np.concatenate([chunk.landmarks for chunk in chunks])
    valid = np.concatenate([chunk.valid for chunk in chunks])
    if not valid.any():
        raise no_face(origin.frames.path, len(valid))
    crop = origin.crop
    data = CaptureData(
        name=origin.name,
        camera_ids=layout.camera_ids,
        fps=_frame_rate(survey.timestamps, origin.frames.fps),
        timestamps=survey.timestamps,
        landmarks=landmarks[:, None],
        valid=valid[:, None],
        principal_point=crop.to_output(survey.picture_size / 2)[None],
        source={
            "key": origin.key,
            "file": origin.frames.path.name,
            "content_hash": origin.frames.content_hash,
            "picture_size": survey.picture_size.astype(int).tolist(),
            "crop": {"left": crop.left, "top": crop.top, "width": crop.crop_width, "height": crop.crop_height},
        },
    )
    digests = {
        FRAMES: np.concatenate([chunk.frame_digests for chunk in chunks]),
        MATTES: np.concatenate([chunk.matte_digests for chunk in chunks]),
    }
    jitter = second_difference_jitter(landmarks)
    report = {
        "frames": len(valid),
        "frames_without_face": int((~valid).sum()),
        "frames_with_several_faces": int(survey.crowded[0]),
        "landmark_jitter_px": jitter if np.isfinite(jitter) else None,
    }
    if not valid.all():
        say(f"{origin.name}: no face in {report['frames_without_face']} of {len(valid)} frames; they are left out")
    shutil.rmtree(layout.folder / _CHUNKS)
    (layout.folder / _SURVEY).unlink()
    (layout.folder / _STATE).unlink()
    finish_capture(layout, out, data, digests, report)


def _frame_rate(timestamps: Float[np.ndarray, " t"], nominal: float) -> float:
    """The rate that the file names, unless its times tell otherwise (variable frame rate, dropped frames)."""
    if len(timestamps) < 2:
        return nominal
    measured = float((len(timestamps) - 1) / timestamps[-1])
    return nominal if abs(measured - nominal) <= _RATE_TOLERANCE * nominal else measured
