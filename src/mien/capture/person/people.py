"""Step 3: choose the person to capture, among all faces in a part of a video."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from mien.capture.person.survey import Survey

_PERSON_MOST_MOVE = 0.6  # sides of a face by which it moves at most from one frame to the next
_PERSON_MOST_GROWTH = 1.6  # factor by which a face grows or shrinks at most from one frame to the next
_PERSON_MOST_GAP = 1.0  # seconds without detection after which a face that comes back starts a new track
_PERSON_MOST_SIZE_RATIO = 2.5  # factor by which the same person's face is larger or smaller at most when it comes back
_PERSON_MOST_COLOR_CHANGE = 0.12
"""Largest difference of the mean colours (0..1) of the same person's face when it comes back."""
_PERSON_LEAST_FRAMES = 3  # frames below which a track counts as a false detection, in clips of at least as many frames

_MAX_CANDIDATES = 8
"""Number of tracks that are considered: those that fill the picture most."""


@dataclass(frozen=True, eq=False)
class Person:
    """The followed face in a part of a video, and the other faces."""

    boxes: Float[np.ndarray, "t 4"]
    """Left, top, right, bottom as fractions of the picture. NaN where the face was not found."""
    others: Float[np.ndarray, "t f 4"]
    """Boxes of other people's faces."""

    @property
    def crowded(self) -> Bool[np.ndarray, " t"]:
        """Frames in which somebody else is seen."""
        return np.asarray(np.isfinite(self.others[..., 0]).any(axis=1))

    @property
    def seen(self) -> Bool[np.ndarray, " t"]:
        """Frames in which the followed face is seen."""
        return np.isfinite(self.boxes[:, 0])


@dataclass(eq=False)
class _Track:
    """One face over consecutive frames."""

    entries: list[tuple[int, int]]
    """Frame number, and index among the faces of that frame."""

    def frames(self) -> set[int]:
        return {frame for frame, _ in self.entries}


def choose_person(survey: Survey) -> Person:
    """Return the person whose face fills the picture most: its area, summed over the frames.

    A face that leaves and comes back is followed again if its size and colours are similar and the two were never seen
    together. Another face that takes its place is not followed.
    """
    tracks = _link(survey)
    boxes, others = np.full((len(survey.boxes), 4), np.nan), survey.boxes.copy()
    least = min(_PERSON_LEAST_FRAMES, len(survey.boxes))
    lasting = [track for track in tracks if len(track.entries) >= least] or tracks
    for track in tracks:
        if track not in lasting:
            frames, places = zip(*track.entries, strict=True)
            others[list(frames), list(places)] = np.nan
    if not lasting:
        return Person(boxes, others)
    areas = np.square(_sizes(survey.boxes))
    lasting.sort(key=lambda track: -_weight([track], areas))
    people = [_gather(track, lasting, areas, survey.colors) for track in lasting[:_MAX_CANDIDATES]]
    accepted = max(people, key=lambda tracks: _weight(tracks, areas))
    for track in accepted:
        for frame, place in track.entries:
            boxes[frame] = survey.boxes[frame, place]
            others[frame, place] = np.nan
    return Person(boxes, others)


def _sizes(boxes: Float[np.ndarray, "t f 4"]) -> Float[np.ndarray, "t f"]:
    """Mean side of each face, as a fraction of the picture."""
    return np.sqrt(np.maximum((boxes[..., 2] - boxes[..., 0]) * (boxes[..., 3] - boxes[..., 1]), 1e-12))


def _link(survey: Survey) -> list[_Track]:
    """Join faces over time into tracks.

    The most recently seen tracks choose first, and each the nearest face. So a track that has just ended does not take
    over another person's face.
    """
    tracks: list[_Track] = []
    open_tracks: list[_Track] = []
    for frame, (seconds, boxes) in enumerate(zip(survey.timestamps, survey.boxes, strict=True)):
        places = np.flatnonzero(np.isfinite(boxes[:, 0])).tolist()
        open_tracks = [
            track for track in open_tracks if seconds - survey.timestamps[track.entries[-1][0]] <= _PERSON_MOST_GAP
        ]
        pairs = sorted(
            (frame - track.entries[-1][0], distance, index, place)
            for index, track in enumerate(open_tracks)
            for place in places
            if (distance := _distance(survey.boxes[track.entries[-1]], boxes[place])) <= _PERSON_MOST_MOVE
        )
        taken: set[int] = set()
        for *_, index, place in pairs:
            track = open_tracks[index]
            if place in places and index not in taken:
                track.entries.append((frame, place))
                taken.add(index)
                places.remove(place)
        for place in places:
            track = _Track([(frame, place)])
            tracks.append(track)
            open_tracks.append(track)
    return tracks


def _distance(before: Float[np.ndarray, " 4"], now: Float[np.ndarray, " 4"]) -> float:
    """Distance between two faces in units of their side; infinite if their sizes differ too much."""
    size_before, size_now = (max(math.sqrt(max((b[2] - b[0]) * (b[3] - b[1]), 0)), 1e-6) for b in (before, now))
    if not 1 / _PERSON_MOST_GROWTH <= size_now / size_before <= _PERSON_MOST_GROWTH:
        return float("inf")
    centers = (before[:2] + before[2:] - now[:2] - now[2:]) / 2
    return float(np.abs(centers).max()) / max(size_before, size_now)


def _weight(tracks: list[_Track], areas: Float[np.ndarray, "t f"]) -> float:
    """Area of the person's face, summed over the frames."""
    return float(sum(areas[entry] for track in tracks for entry in track.entries))


def _gather(first: _Track, tracks: list[_Track], areas: np.ndarray, colors: np.ndarray) -> list[_Track]:
    """Return all tracks that can be of the same person as the first one, the heaviest first."""
    accepted = [first]
    for track in tracks:
        if track is not first and _is_same_person(accepted, track, areas, colors):
            accepted.append(track)
    return accepted


def _is_same_person(accepted: list[_Track], track: _Track, areas: np.ndarray, colors: np.ndarray) -> bool:
    frames = track.frames()
    if any(frames & other.frames() for other in accepted):
        return False
    now = tuple(np.array(track.entries).T)
    before = tuple(np.array([entry for other in accepted for entry in other.entries]).T)
    ratio = math.sqrt(float(np.median(areas[now])) / float(np.median(areas[before])))
    change = np.abs(np.median(colors[now], axis=0) - np.median(colors[before], axis=0)).mean()
    most = _PERSON_MOST_SIZE_RATIO
    return bool(1 / most <= ratio <= most and change <= _PERSON_MOST_COLOR_CHANGE)
