"""Step 3: choose the parts of a video that become captures, one for each shot, with its own person and crop."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from mien.capture.constants import CAPTURE
from mien.capture.crop import Crop, choose_crop, whole_picture
from mien.capture.people import Person, choose_person
from mien.capture.settings import CaptureSettings
from mien.capture.survey import Survey, no_face, slice_survey
from mien.errors import UserError
from mien.progress import say


@dataclass(frozen=True, eq=False)
class Part:
    """Consecutive frames of a source that become one capture."""

    name: str
    """Name of the sequence."""
    start: int
    """Index of its first frame, among the frames taken."""
    survey: Survey
    """Survey of the part's frames only."""
    person: Person
    crop: Crop

    @property
    def timesteps(self) -> int:
        """The number of frames."""
        return len(self.survey.timestamps)


def whole_part(survey: Survey, settings: CaptureSettings, path: Path, name: str) -> Part:
    """Return the whole video as one part. Report its cuts, unless the settings turn that off.

    Raises:
        UserError: no face was found.
    """
    cuts = find_cuts(survey.thumbnails) if settings.cuts else []
    if cuts:
        say(f"warning: {path}: the video cuts to another shot at {_list_times(survey, cuts)}; tracking may fail there")
    part = _make_part(survey, 0, settings, name)
    if part is None:
        raise no_face(path, len(survey.timestamps))
    _tell_people(path, part)
    return part


def find_parts(survey: Survey, settings: CaptureSettings, path: Path, name: str) -> list[Part]:
    """Return a part for each shot that is long enough and shows a face.

    A single part is called `name`, several are called `name`-1, `name`-2, ...

    Raises:
        UserError: there is no such shot.
    """
    cuts = find_cuts(survey.thumbnails) if settings.cuts else []
    bounds = [0, *cuts, len(survey.timestamps)]
    interval = float(np.median(np.diff(survey.timestamps))) if len(survey.timestamps) > 1 else 0.0
    short, faceless, found = [], [], []
    for start, stop in zip(bounds[:-1], bounds[1:], strict=True):
        seconds = float(survey.timestamps[stop - 1] - survey.timestamps[start]) + interval
        # Tolerate half a frame: 25 frames at 25 per second last a second.
        if cuts and seconds < settings.shortest_part - interval / 2:
            short.append(start)
            continue
        part = _make_part(slice_survey(survey, slice(start, stop)), start, settings, name)
        faceless.append(start) if part is None else found.append(part)
    if short:
        least = f"{settings.shortest_part:g} s"
        say(f"{path}: {len(short)} parts shorter than {least} are left out, at {_list_times(survey, short)}")
    if not found and short:
        raise UserError(
            f"{path}: has {len(cuts)} cuts, and no part of {settings.shortest_part:g} s or more shows a face; "
            "give a smaller --capture.shortest-part, or --capture.no-cuts to keep the video whole"
        )
    if not found:
        raise no_face(path, len(survey.timestamps))
    if faceless:
        say(f"{path}: {len(faceless)} parts without a face are left out, at {_list_times(survey, faceless)}")
    parts = _number_parts(found, name)
    if cuts:
        say(f"{path}: cuts to another shot at {_list_times(survey, cuts)}: {', '.join(part.name for part in parts)}")
    for part in parts:
        _tell_people(path, part)
    return parts


def _number_parts(parts: list[Part], name: str) -> list[Part]:
    if len(parts) == 1:
        return parts
    return [
        Part(f"{name}-{number}", part.start, part.survey, part.person, part.crop)
        for number, part in enumerate(parts, 1)
    ]


def _make_part(survey: Survey, start: int, settings: CaptureSettings, name: str) -> Part | None:
    person = choose_person(survey)
    if not person.seen.any():
        return None
    return Part(name, start, survey, person, _choose_crop(survey, person, settings))


def _choose_crop(survey: Survey, person: Person, settings: CaptureSettings) -> Crop:
    width, height = survey.picture_size.tolist()
    if settings.crop == "none":
        return whole_picture(width, height, settings.size)
    return choose_crop(person.boxes, width, height, settings.size)


def _tell_people(path: Path, part: Part) -> None:
    crowded = part.person.crowded
    if not crowded.any():
        return
    alone = int((crowded & ~part.person.seen).sum())
    gone = f"; the followed face is missing in {alone} of them, which are left out" if alone else ""
    say(
        f"warning: {path}: several faces in {int(crowded.sum())} of {part.timesteps} frames; "
        f"the one that fills the picture most is followed{gone}"
    )


def _list_times(survey: Survey, frames: list[int]) -> str:
    """List the times of up to five frames, for messages."""
    listed = ", ".join(f"{survey.timestamps[frame]:.1f}" for frame in frames[:5])
    return f"{listed}{', ...' if len(frames) > 5 else ''} s"


def find_cuts(thumbnails: UInt8[np.ndarray, "t h w 3"]) -> list[int]:
    """Return the numbers of the frames that begin a new shot; 0 is not among them.

    A cut is a change that is much larger than the changes beside it, and that the next frames do not undo. Thumbnails
    are divided by their mean before they are compared, so that switching on a light is no cut.
    """
    pictures = thumbnails.astype(np.float32)
    pictures /= np.maximum(pictures.mean(axis=(1, 2, 3), keepdims=True), 1.0)
    changes = np.array([_difference(*pair) for pair in zip(pictures[:-1], pictures[1:], strict=True)])
    cuts = []
    for index in np.flatnonzero(changes > CAPTURE.cut_least_change).tolist():
        beside = np.concatenate(
            [changes[max(index - CAPTURE.cut_neighbors, 0) : index], changes[index + 1 :][: CAPTURE.cut_neighbors]]
        )
        # The largest neighbour may be the other half of a cut that passes through a blended frame.
        loudest = np.sort(beside)[-2] if len(beside) > 1 else 0.0
        stands_out = changes[index] > CAPTURE.cut_least_contrast * loudest
        if stands_out and _parted(pictures, index + 1) > 0.5 * changes[index]:
            cuts.append(index + 1)
    return cuts


def _parted(pictures: Float[np.ndarray, "t h w 3"], start: int) -> float:
    """Return the smallest difference between a frame shortly before `start` and one shortly after it."""
    before, after = pictures[max(start - CAPTURE.cut_reach, 0) : start], pictures[start : start + CAPTURE.cut_reach]
    return min(_difference(one, other) for one in before for other in after)


def _difference(one: Float[np.ndarray, "h w 3"], other: Float[np.ndarray, "h w 3"]) -> float:
    rows, columns = CAPTURE.cut_blocks
    height, width = one.shape[0] // rows, one.shape[1] // columns
    difference = np.abs(one - other).mean(axis=-1)[: rows * height, : columns * width]
    blocks = np.sort(difference.reshape(rows, height, columns, width).mean(axis=(1, 3)).ravel())
    return float(blocks[-(rows * columns // 4) :].mean())
