"""Check a calibration as a whole against what its cameras see, and advise on how to read it."""

import itertools
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Bool, Float

from mien.camera import Camera
from mien.capture.cameras.calibration import CalibratedCamera
from mien.capture.cameras.reading_fit import advice_of, is_wrong, rank_readings, written_of
from mien.capture.cameras.readings import Reading, readings_of
from mien.capture.person.backend import DetectorChoice
from mien.capture.person.crop import Crop
from mien.capture.person.faces import LANDMARKS, LandmarkDetector
from mien.machine.progress import say
from mien.media.source import FrameSource

_TIMESTEPS = 8
"""Most timesteps at which landmarks are searched to advise on a calibration that does not fit."""
_AROUND = 2.0
"""Side of the part of a picture in which landmarks are searched, in sides of the face's box."""
_CLEAR = 256
"""Least side in pixels of that part, where the picture is large enough."""

Fitted = Callable[[int, CalibratedCamera], Camera]
"""Makes the camera for the pictures in which landmarks are measured, of the camera with that index."""


def advise_on(cameras: Sequence[CalibratedCamera], fitted: Fitted, landmarks: Float[np.ndarray, "t c l 2"]) -> str:
    """Return what to correct in a calibration, or an empty text if it fits as it is written, or no reading fits."""
    ranked = rank_readings(landmarks, _readings(cameras, fitted))
    return advice_of(ranked) if is_wrong(ranked) else ""


def warn_of_misfit(
    cameras: Sequence[CalibratedCamera], fitted: Fitted, landmarks: Float[np.ndarray, "t c l 2"]
) -> None:
    """Warn if the landmarks of a finished capture fit another reading of its calibration far better."""
    ranked = rank_readings(landmarks, _readings(cameras, fitted))
    if is_wrong(ranked):
        pixels = written_of(ranked).pixels
        apart = f"within {pixels:.1f} px" if np.isfinite(pixels) else "nowhere, or on a face that is inside out"
        say(f"warning: --calibration: as it is written, the cameras agree on points of the face {apart}; "
            f"{advice_of(ranked)}; then capture again")  # fmt: skip


def some_timesteps(found: Bool[np.ndarray, "t c"]) -> list[int]:
    """Return some timesteps at which several cameras find a face, evenly spread."""
    several = np.flatnonzero(found.sum(axis=1) >= 2)
    return several[:: -(-len(several) // _TIMESTEPS) or 1].tolist()


def landmarks_at(
    frames: FrameSource, boxes: Float[np.ndarray, "t 4"], timesteps: Sequence[int], detector: DetectorChoice = "auto"
) -> Float[np.ndarray, "n l 2"]:
    """Return landmarks in pixels of the source's pictures at some timesteps; NaN where no face is found.

    Args:
        frames: the source.
        boxes: left, top, right, bottom of the face in pixels of its pictures, at all timesteps; NaN for no face.
        timesteps: increasing numbers of the frames taken.
        detector: what runs the networks.
    """
    found = np.full((len(timesteps), LANDMARKS, 2), np.nan)
    places = {timestep: place for place, timestep in enumerate(timesteps) if np.isfinite(boxes[timestep, 0])}
    if not places:
        return found
    with LandmarkDetector(several_faces=False, detector=detector) as finder:
        for timestep, frame in enumerate(itertools.islice(frames.frames(), max(places) + 1)):
            if timestep in places:
                picture = frame.picture()
                crop = _around(boxes[timestep], picture.shape[1], picture.shape[0])
                for face in finder.detect(crop.apply(picture))[:1]:
                    found[places[timestep]] = face + (crop.left, crop.top)
    return found


def _around(box: Float[np.ndarray, " 4"], width: int, height: int) -> Crop:
    side = max(_AROUND * float((box[2:] - box[:2]).max()), _CLEAR)
    cut_width, cut_height = min(round(side), width), min(round(side), height)
    left = int(np.clip(round((box[0] + box[2] - cut_width) / 2), 0, width - cut_width))
    top = int(np.clip(round((box[1] + box[3] - cut_height) / 2), 0, height - cut_height))
    return Crop(left, top, cut_width, cut_height, cut_width, cut_height)


def _readings(cameras: Sequence[CalibratedCamera], fitted: Fitted) -> list[Reading]:
    return [
        Reading(reading.remedies, tuple(
            fitted(index, CalibratedCamera(camera.camera_id, read))
            for index, (camera, read) in enumerate(zip(cameras, reading.cameras, strict=True))
        ))
        for reading in readings_of([camera.camera for camera in cameras])
    ]  # fmt: skip
