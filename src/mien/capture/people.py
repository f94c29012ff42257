"""Who is captured: of all faces in a part of a video, those of one person."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from mien.capture.survey import Survey

_REACH = 0.6
"""A face moves by at most so many of its sides from one frame to the next..."""
_GROWTH = 1.6
"""...and grows or shrinks by this factor at most."""
_PATIENCE = 1.0
"""Seconds after which a face that comes back counts as newly come."""
_SIZE_RANGE = 2.5
"""The same person's face is at most so much larger or smaller when it comes back..."""
_LOOK_RANGE = 0.12
"""...and its mean colours (0..1) differ by at most this."""
_CANDIDATES = 8
"""So many of the faces that fill the picture most are considered."""
_PASSING = 3
"""A face seen in fewer frames than this is taken for a false detection, where the clip has more."""


@dataclass(frozen=True, eq=False)
class Person:
    """The followed face of a part of a video."""

    boxes: Float[np.ndarray, "t 4"]
    """Left, top, right, bottom as fractions of the picture; NaN where the face is not seen."""
    others: Float[np.ndarray, "t f 4"]
    """The faces of other people."""

    @property
    def crowded(self) -> Bool[np.ndarray, " t"]:
        """Where somebody else is seen."""
        return np.asarray(np.isfinite(self.others[..., 0]).any(axis=1))

    @property
    def seen(self) -> Bool[np.ndarray, " t"]:
        """Where the followed face is seen."""
        return np.isfinite(self.boxes[:, 0])


@dataclass(eq=False)
class _Track:
    """One face over consecutive frames."""

    entries: list[tuple[int, int]]
    """Frame and place among the frame's faces."""

    def frames(self) -> set[int]:
        return {frame for frame, _ in self.entries}


def choose_person(survey: Survey) -> Person:
    """The person whose face fills the picture most: its area, summed over the frames.

    A face that leaves and comes back is followed again if its size and colours are the same and it was never seen
    beside itself; a face that takes its place is not.
    """
    tracks = _link(survey)
    boxes, others = np.full((len(survey.boxes), 4), np.nan), survey.boxes.copy()
    lasting = [track for track in tracks if len(track.entries) >= min(_PASSING, len(survey.boxes))] or tracks
    for track in tracks:
        if track not in lasting:
            frames, places = zip(*track.entries, strict=True)
            others[list(frames), list(places)] = np.nan
    if not lasting:
        return Person(boxes, others)
    areas = np.square(_sizes(survey.boxes))
    lasting.sort(key=lambda track: -_weight([track], areas))
    people = [_gather(track, lasting, areas, survey.looks) for track in lasting[:_CANDIDATES]]
    accepted = max(people, key=lambda tracks: _weight(tracks, areas))
    for track in accepted:
        for frame, place in track.entries:
            boxes[frame] = survey.boxes[frame, place]
            others[frame, place] = np.nan
    return Person(boxes, others)


def _sizes(boxes: Float[np.ndarray, "t f 4"]) -> Float[np.ndarray, "t f"]:
    """Mean side, as a fraction of the picture."""
    return np.sqrt(np.maximum((boxes[..., 2] - boxes[..., 0]) * (boxes[..., 3] - boxes[..., 1]), 1e-12))


def _link(survey: Survey) -> list[_Track]:
    """Faces joined over time: to the ones seen last, the nearest first; so nobody takes over who has just gone."""
    tracks: list[_Track] = []
    open_tracks: list[_Track] = []
    for frame, (seconds, boxes) in enumerate(zip(survey.timestamps, survey.boxes, strict=True)):
        places = np.flatnonzero(np.isfinite(boxes[:, 0])).tolist()
        open_tracks = [track for track in open_tracks if seconds - survey.timestamps[track.entries[-1][0]] <= _PATIENCE]
        pairs = sorted(
            (frame - track.entries[-1][0], distance, index, place)
            for index, track in enumerate(open_tracks)
            for place in places
            if (distance := _distance(survey.boxes[track.entries[-1]], boxes[place])) <= _REACH
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
    """Between two faces, in sides; infinite where their sizes differ too much."""
    size_before, size_now = (max(math.sqrt(max((b[2] - b[0]) * (b[3] - b[1]), 0)), 1e-6) for b in (before, now))
    if not 1 / _GROWTH <= size_now / size_before <= _GROWTH:
        return float("inf")
    centres = (before[:2] + before[2:] - now[:2] - now[2:]) / 2
    return float(np.abs(centres).max()) / max(size_before, size_now)


def _weight(tracks: list[_Track], areas: Float[np.ndarray, "t f"]) -> float:
    """How much of the video a person's face fills."""
    return float(sum(areas[entry] for track in tracks for entry in track.entries))


def _gather(first: _Track, tracks: list[_Track], areas: np.ndarray, looks: np.ndarray) -> list[_Track]:
    """All tracks that can be of the person of the first one, the weightiest first."""
    accepted = [first]
    for track in tracks:
        if track is not first and _is_same_person(accepted, track, areas, looks):
            accepted.append(track)
    return accepted


def _is_same_person(accepted: list[_Track], track: _Track, areas: np.ndarray, looks: np.ndarray) -> bool:
    frames = track.frames()
    if any(frames & other.frames() for other in accepted):
        return False
    now = tuple(np.array(track.entries).T)
    before = tuple(np.array([entry for other in accepted for entry in other.entries]).T)
    ratio = math.sqrt(float(np.median(areas[now])) / float(np.median(areas[before])))
    change = np.abs(np.median(looks[now], axis=0) - np.median(looks[before], axis=0)).mean()
    return bool(1 / _SIZE_RANGE <= ratio <= _SIZE_RANGE and change <= _LOOK_RANGE)
