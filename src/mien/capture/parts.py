"""Step 3: choose the parts of a video that become captures, one for each shot, with its own person and crop."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from mien.capture.person.crop import Crop, choose_crop, whole_picture
from mien.capture.person.people import Person, choose_person
from mien.capture.person.survey import Survey, no_face, slice_survey
from mien.capture.settings import CaptureSettings
from mien.errors import UserError
from mien.machine.progress import say
from mien.machine.terminal import counted

_CUT_REACH = 3
"""Frames on either side of a cut that must all differ. After a flash, the picture from before it comes back. All
numbers of cuts were judged together: no false cut in 1,341 real frames, and all spliced shots found (log)."""
_CUT_NEIGHBORS = 4
"""Frames on either side of a cut in which the picture may change only a little: motion lasts longer than a cut."""
_CUT_LEAST_CHANGE = 0.05  # smallest change at a cut, as a fraction of the mean brightness
_CUT_LEAST_CONTRAST = 3.0  # factor by which the change at a cut exceeds the changes beside it
_CUT_BLOCKS = (3, 4)
"""Rows and columns of blocks. The change is that of half of the blocks, or of the face's place if that is larger. The
quarter that changes most also has captions in it, which cost 47 to 67 % of the frames of such videos."""


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
    """Return the whole video as one part. Report its cuts, unless the settings turn that off."""
    for turn in survey.changes_of_shape():
        raise UserError(
            f"{path}: {_change_of_size(survey, turn)}; capture it with `mien capture`, which makes a part of each shape"
        )
    cuts = find_cuts(survey.thumbnails, survey.boxes) if settings.cuts else []
    if cuts:
        say(f"warning: {path}: the video cuts to another shot at {_list_times(survey, cuts)}; tracking may fail there")
    (part,) = find_parts(survey, replace(settings, cuts=False), path, name)
    return part


def find_parts(survey: Survey, settings: CaptureSettings, path: Path, name: str) -> list[Part]:
    """Return a part for each shot that is long enough and shows a face. A change of the picture's shape ends a shot.

    A single part is called `name`, several are called `name`-1, `name`-2, ...
    """
    cuts = find_cuts(survey.thumbnails, survey.boxes) if settings.cuts else []
    turns = survey.changes_of_shape()
    bounds = sorted({0, *cuts, *turns, len(survey.timestamps)})
    interval = float(np.median(np.diff(survey.timestamps))) if len(survey.timestamps) > 1 else 0.0
    short, faceless, found = [], [], []
    for start, stop in itertools.pairwise(bounds):
        seconds = float(survey.timestamps[stop - 1] - survey.timestamps[start]) + interval
        # Tolerate half a frame: 25 frames at 25 per second last a second.
        if len(bounds) > 2 and seconds < settings.shortest_part - interval / 2:
            short.append((start, stop))
            continue
        part = _make_part(slice_survey(survey, slice(start, stop)), start, settings, name)
        faceless.append((start, stop)) if part is None else found.append(part)
    for turn in turns:
        say(f"{path}: {_change_of_size(survey, turn)}; a part begins there")
    if not found and short:
        whole = "" if turns else ", or --capture.no-cuts to keep the video whole"
        raise UserError(
            f"{path}: has {len(bounds) - 1} parts, which begin at {_list_times(survey, bounds[:-1])}, and none of "
            f"{settings.shortest_part:g} s or more shows a face; give a smaller --capture.shortest-part{whole}"
        )
    if not found:
        raise no_face(path, len(survey.timestamps))
    keeps = "--capture.shortest-part keeps shorter ones" + ("" if turns else ", --capture.no-cuts all")
    shorter = f"parts shorter than {settings.shortest_part:g} s"
    _tell_left_out(path, survey, [(shorter, short, f"; {keeps}"), ("parts without a face", faceless, "")])
    parts = number_parts(found, name)
    if cuts:
        say(f"{path}: cuts to another shot at {_list_times(survey, cuts)}: {', '.join(part.name for part in parts)}")
    for part in parts:
        _tell_people(path, part)
    return parts


def check_one_size(survey: Survey, path: Path) -> None:
    """Refuse a video whose pictures change their size, for what needs one size: given inputs, calibrated cameras."""
    changes = np.flatnonzero((survey.sizes[1:] != survey.sizes[:-1]).any(axis=1)) + 1
    if len(changes):
        raise UserError(
            f"{path}: {_change_of_size(survey, int(changes[0]))}; calibrated cameras, and what is given for each "
            "frame (mattes, landmarks, a clean plate), need one size: convert the video to one"
        )


def _change_of_size(survey: Survey, frame: int) -> str:
    before, after = ("x".join(map(str, survey.sizes[index].tolist())) for index in (frame - 1, frame))
    return f"the picture changes from {before} to {after} at {_list_times(survey, [frame])}"


def _tell_left_out(path: Path, survey: Survey, left_out: list[tuple[str, list[tuple[int, int]], str]]) -> None:
    """Say which frames belong to no part, and why. It is a warning with a remedy if they are more than a tenth."""
    total = len(survey.timestamps)
    many = sum(stop - start for _, spans, _ in left_out for start, stop in spans) > 0.1 * total
    for why, spans, remedy in left_out:
        if spans:
            frames = sum(stop - start for start, stop in spans)
            say(
                f"{'warning: ' if many else ''}{path}: {len(spans)} {why} are left out, at "
                f"{_list_times(survey, [start for start, _ in spans])}: {frames} of {counted(total, 'frame')}"
                f"{remedy if many else ''}"
            )


def number_parts(parts: list[Part], name: str) -> list[Part]:
    """Return the parts under their names: a single part is called `name`, several `name`-1, `name`-2, ..."""
    names = [f"{name}-{number}" for number in range(1, len(parts) + 1)] if len(parts) > 1 else [name]
    return [replace(part, name=each) for part, each in zip(parts, names, strict=True)]


def _make_part(survey: Survey, start: int, settings: CaptureSettings, name: str) -> Part | None:
    person = choose_person(survey)
    if not person.seen.any():
        return None
    width, height = survey.picture_size.tolist()
    whole = settings.crop == "none"
    crop = (whole_picture if whole else partial(choose_crop, person.boxes))(width, height, settings.size)
    return Part(name, start, survey, person, crop)


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


def tell_who(path: Path, parts: Sequence[Part], people: Sequence[Sequence[int]], person: int) -> None:
    """Say which parts of the video (as indices) show whom, and who is kept, if there are several people."""
    if person > len(people):
        shown = "one person" if len(people) == 1 else f"{len(people)} people"
        raise UserError(f"--capture.person {person}: {path} shows {shown}; give a smaller number")
    if len(people) == 1:
        return
    seen = []
    for number, places in enumerate(people, 1):
        begins = ", ".join(f"{parts[place].survey.timestamps[0]:.1f}" for place in places[:5])
        frames = sum(parts[place].timesteps for place in places)
        seen.append(f"person {number} from {begins}{', ...' if len(places) > 5 else ''} s ({counted(frames, 'frame')})")
    say(
        f"warning: {path}: shows {len(people)} people, by the shapes of their faces: {'; '.join(seen)}. "
        f"Person {person} is kept; choose with --capture.person N, where 0 takes all for one person"
    )


def _list_times(survey: Survey, frames: list[int]) -> str:
    listed = ", ".join(f"{survey.timestamps[frame]:.1f}" for frame in frames[:5])
    return f"{listed}{', ...' if len(frames) > 5 else ''} s"


def find_cuts(thumbnails: UInt8[np.ndarray, "t h w 3"], faces: Float[np.ndarray, "t f 4"] | None = None) -> list[int]:
    """Return the numbers of the frames that begin a new shot; 0 is not among them.

    A cut is a change of most of the picture, or of the places of all faces. It is much larger than the changes beside
    it, and the next frames do not undo it. A light that is switched on is no cut. Neither is a caption or a window that
    appears beside a face, or a person who leaves another one. `faces` are their boxes as fractions of each picture.
    """
    pictures = thumbnails.astype(np.float32)
    boxes = np.full((len(pictures), 1, 4), np.nan) if faces is None else faces
    changes = np.array([_difference(pictures, boxes, index, index + 1) for index in range(len(pictures) - 1)])
    cuts = []
    for index in np.flatnonzero(changes > _CUT_LEAST_CHANGE).tolist():
        beside = np.concatenate(
            [changes[max(index - _CUT_NEIGHBORS, 0) : index], changes[index + 1 :][:_CUT_NEIGHBORS]]
        )
        # The largest neighbour may be the other half of a cut that passes through a blended frame.
        loudest = np.sort(beside)[-2] if len(beside) > 1 else 0.0
        if (
            changes[index] > _CUT_LEAST_CONTRAST * loudest
            and _parted(pictures, boxes, index + 1) > 0.5 * changes[index]
        ):
            cuts.append(index + 1)
    return cuts


def _parted(pictures: Float[np.ndarray, "t h w 3"], boxes: Float[np.ndarray, "t f 4"], start: int) -> float:
    """Return the smallest difference between a frame shortly before `start` and one shortly after it."""
    before = range(max(start - _CUT_REACH, 0), start)
    after = range(start, min(start + _CUT_REACH, len(pictures)))
    return min(_difference(pictures, boxes, one, other) for one in before for other in after)


def _difference(
    pictures: Float[np.ndarray, "t h w 3"], boxes: Float[np.ndarray, "t f 4"], one: int, other: int
) -> float:
    """Return the change of most of two pictures, or of the face's place that changes least, relative to their level."""
    before, after = pictures[one], pictures[other]
    # A caption changes the mean of a picture, but not the ratio of most of its pixels.
    gain = float(np.median((after.mean(axis=-1) + 1) / (before.mean(axis=-1) + 1)))
    change = np.abs(gain * before - after).mean(axis=-1) / max(float(after.mean()), 1.0)
    rows, columns = _CUT_BLOCKS
    height, width = change.shape[0] // rows, change.shape[1] // columns
    blocks = change[: rows * height, : columns * width].reshape(rows, height, columns, width).mean(axis=(1, 3))
    faces = [float(np.median(_inside(change, box))) for box in (*boxes[one], *boxes[other]) if np.isfinite(box[0])]
    return max(float(np.median(blocks)), min(faces, default=0.0))


def _inside(picture: Float[np.ndarray, "h w"], box: Float[np.ndarray, " 4"]) -> Float[np.ndarray, "h2 w2"]:
    height, width = picture.shape
    left, right = np.clip([np.floor(box[0] * width), np.ceil(box[2] * width)], 0, width).astype(int)
    top, bottom = np.clip([np.floor(box[1] * height), np.ceil(box[3] * height)], 0, height).astype(int)
    left, top = min(left, width - 1), min(top, height - 1)
    return picture[top : max(bottom, top + 1), left : max(right, left + 1)]
