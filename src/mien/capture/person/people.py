"""Step 3: choose the person to capture among all faces in a part of a video, and tell people of several parts apart.

Captures show the same person if the shapes of their faces differ no more than they vary within each. A shape is that of
points of MediaPipe's mesh that expressions hardly move. The mesh depends on the head's pose, too, so only frames of
similar poses are compared. Mirrored frames count as well: the shots of an interview show opposite sides of faces.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from mien.capture.person.backend import DetectorChoice
from mien.capture.person.faces import LANDMARKS, MeshReader
from mien.capture.person.survey import Survey

_PERSON_MOST_MOVE = 0.6  # sides of a face by which it moves at most from one frame to the next
_PERSON_MOST_GROWTH = 1.6  # factor by which a face grows or shrinks at most from one frame to the next
_PERSON_MOST_GAP = 1.0  # seconds without detection after which a face that comes back starts a new track
_PERSON_MOST_SIZE_RATIO = 2.5  # factor by which the same person's face is larger or smaller at most when it comes back
_PERSON_MOST_COLOR_CHANGE = 0.12
"""Largest difference of the mean colours (0..1) of the same person's face when it comes back."""
_PERSON_LEAST_FRAMES = 3  # frames below which a track counts as a false detection, in clips of at least as many frames


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


_Track = list[tuple[int, int]]
"""One face over consecutive frames: frame number, and index among the faces of that frame."""


def choose_person(survey: Survey) -> Person:
    """Return the person whose face fills the picture most: its area, summed over the frames.

    A face that leaves and comes back is followed again if its size and colours are similar and the two were never seen
    together. Another face that takes its place is not followed.
    """
    tracks = _link(survey)
    boxes, others = np.full((len(survey.boxes), 4), np.nan), survey.boxes.copy()
    least = min(_PERSON_LEAST_FRAMES, len(survey.boxes))
    lasting = [track for track in tracks if len(track) >= least] or tracks
    for track in tracks:
        if track not in lasting:
            frames, places = zip(*track, strict=True)
            others[list(frames), list(places)] = np.nan
    if not lasting:
        return Person(boxes, others)
    areas = np.maximum(np.prod(survey.boxes[..., 2:] - survey.boxes[..., :2], axis=-1), 1e-12)
    lasting.sort(key=lambda track: -_weight([track], areas))
    people = [
        _gather(track, lasting, areas, survey.colors) for track in lasting[:8]
    ]  # those that fill the picture most
    for track in max(people, key=lambda tracks: _weight(tracks, areas)):
        for frame, place in track:
            boxes[frame] = survey.boxes[frame, place]
            others[frame, place] = np.nan
    return Person(boxes, others)


def _link(survey: Survey) -> list[_Track]:
    """Join faces over time into tracks.

    The most recently seen tracks choose first, and each the nearest face. So a track that has just ended does not take
    over another person's face.
    """
    tracks: list[_Track] = []
    open_tracks: list[_Track] = []
    for frame, (seconds, boxes) in enumerate(zip(survey.timestamps, survey.boxes, strict=True)):
        places = np.flatnonzero(np.isfinite(boxes[:, 0])).tolist()
        open_tracks = [track for track in open_tracks if seconds - survey.timestamps[track[-1][0]] <= _PERSON_MOST_GAP]
        pairs = sorted(
            (frame - track[-1][0], distance, index, place)
            for index, track in enumerate(open_tracks)
            for place in places
            if (distance := _distance(survey.boxes[track[-1]], boxes[place])) <= _PERSON_MOST_MOVE
        )
        taken: set[int] = set()
        for *_, index, place in pairs:
            track = open_tracks[index]
            if place in places and index not in taken:
                track.append((frame, place))
                taken.add(index)
                places.remove(place)
        for place in places:
            track = [(frame, place)]
            tracks.append(track)
            open_tracks.append(track)
    return tracks


def _distance(before: Float[np.ndarray, " 4"], now: Float[np.ndarray, " 4"]) -> float:
    """Distance between two faces in units of their side; infinite if their sizes differ too much."""
    size_before, size_now = (max(math.sqrt(max((b[2] - b[0]) * (b[3] - b[1]), 0)), 1e-6) for b in (before, now))
    if not 1 / _PERSON_MOST_GROWTH <= size_now / size_before <= _PERSON_MOST_GROWTH:
        return float("inf")
    return float(np.abs((before[:2] + before[2:] - now[:2] - now[2:]) / 2).max()) / max(size_before, size_now)


def _weight(tracks: list[_Track], areas: Float[np.ndarray, "t f"]) -> float:
    return float(sum(areas[entry] for track in tracks for entry in track))


def _gather(first: _Track, tracks: list[_Track], areas: np.ndarray, colors: np.ndarray) -> list[_Track]:
    """Return all tracks that can be of the same person as the first one, the heaviest first."""
    accepted = [first]
    for track in tracks:
        if track is not first and _is_same_person(accepted, track, areas, colors):
            accepted.append(track)
    return accepted


def _is_same_person(accepted: list[_Track], track: _Track, areas: np.ndarray, colors: np.ndarray) -> bool:
    frames = {frame for frame, _ in track}
    if any(frame in frames for other in accepted for frame, _ in other):
        return False
    now = tuple(np.array(track).T)
    before = tuple(np.array([entry for other in accepted for entry in other]).T)
    ratio = math.sqrt(float(np.median(areas[now])) / float(np.median(areas[before])))
    change = np.abs(np.median(colors[now], axis=0) - np.median(colors[before], axis=0)).mean()
    most = _PERSON_MOST_SIZE_RATIO
    return bool(1 / most <= ratio <= most and change <= _PERSON_MOST_COLOR_CHANGE)


_IDENTITY_PICTURES = 48  # pictures of a capture, spread evenly, of which shapes of faces are compared
_IDENTITY_LEAST_PAIRS = 3  # pairs below which nothing is said
_IDENTITY_MOST_TURN = 0.35  # angle in radians between the poses of two pictures up to which they are compared
_IDENTITY_NOISE = 3e-4
"""Variance of a coordinate below which the spread within a clip is not trusted, in units of the face's size."""
_IDENTITY_MOST_DIFFERENCE = 4.6
"""Difference up to which two captures show one person. Halves of a clip differ by at most 3.3, people by 5.4."""
_IDENTITY_NEAR_TURN = 0.15  # angle up to which that holds; the estimated shape follows the pose
_IDENTITY_TURN_ALLOWANCE = 20.0  # ...and this much more difference is allowed for each radian beyond

_IDENTITY_SURE_SECONDS = 14.0
"""Length of two captures from which a difference beyond 1 shows that they are of two people.

Windows of 1, 2 and 4 seconds of seven clips differ within a clip by at most 2.9, 2.9 and 1.8, which stays below
`most_difference`; those of 8 seconds differ by 0.9.
"""

_MIDDLE = (10, 151, 9, 8, 168, 6, 197, 195, 5, 4, 1, 19, 94)
"""Points of the mesh from the forehead down to the base of the nose."""
_SIDES = (
    *((33, 263), (133, 362), (98, 327), (48, 278), (127, 356), (234, 454)),
    *((93, 323), (21, 251), (162, 389), (50, 280), (117, 346), (116, 345)),
)
"""Corners of the eyes, wings of the nose, temples and cheekbones, each right and left."""
_POINTS = np.array([*_MIDDLE, *(point for pair in _SIDES for point in pair)])
_MIRROR = np.array([*_MIDDLE, *(point for right, left in _SIDES for point in (left, right))])

Shapes = Float[np.ndarray, "n k 3"]
"""Points of the face in n pictures, about their mean, with a mean square distance of 1 from it; x and y as in the
picture."""


def face_shapes(pictures: UInt8[np.ndarray, "t h w 3"], detector: DetectorChoice = "auto") -> Shapes:
    """Return the shapes of the face in pictures, taken evenly of all, and then those of the same pictures mirrored."""
    count = min(len(pictures), _IDENTITY_PICTURES)
    chosen = pictures[np.linspace(0, len(pictures) - 1, count).round().astype(int)]
    with MeshReader(1, is_video=False, detector=detector) as mesh:
        found = [faces[0] for picture in chosen if len(faces := mesh.read(np.ascontiguousarray(picture)))]
    points = np.array(found).reshape(-1, LANDMARKS, 3)
    both = np.concatenate([points[:, _POINTS], points[:, _MIRROR] * (-1, 1, 1)])
    both = both - both.mean(axis=1, keepdims=True)
    return both / np.sqrt(np.square(both).sum(axis=(1, 2), keepdims=True) / len(_POINTS))


def shape_difference(one: Shapes, other: Float[np.ndarray, "m k 3"]) -> float | None:
    """Return how much two captures' faces differ, 1 being the most that one person's do.

    It is the Mahalanobis distance by the spread within both captures, over what is allowed at the angle between poses.
    None means that too few of the pictures show the head in similar poses.
    """
    one = one[: len(one) // 2]  # mirrored pictures of one side are enough
    if min(len(one), len(other) // 2) < _IDENTITY_LEAST_PAIRS:
        return None
    turned, rotations = _turned_alike(np.concatenate([one, other]))
    cosines = (np.einsum("nij,mij->nm", rotations[: len(one)], rotations[len(one) :]) - 1) / 2
    angles = np.arccos(np.clip(cosines, -1, 1))
    pairs = _nearest_pairs(angles, _IDENTITY_MOST_TURN)
    if len(pairs) < _IDENTITY_LEAST_PAIRS:
        return None
    here, there = np.split(turned, [len(one)])
    change = np.median([here[i] - there[j] for i, j in pairs], axis=0).ravel()
    unmirrored = (here, there[: len(other) // 2])
    spread = np.concatenate([(shapes - np.median(shapes, axis=0)).reshape(len(shapes), -1) for shapes in unmirrored])
    variances, directions = np.linalg.eigh(spread.T @ spread / len(spread))
    # Points that hardly move in a short clip are not known to such a precision.
    scale = np.sqrt(np.maximum(variances, 0) + _IDENTITY_NOISE)
    beyond = max(0.0, max(angles[pair] for pair in pairs) - _IDENTITY_NEAR_TURN)
    allowed = _IDENTITY_MOST_DIFFERENCE + _IDENTITY_TURN_ALLOWANCE * beyond
    return float(np.linalg.norm(change @ directions / scale)) / allowed


def most_difference(seconds: float, others: float) -> float:
    """Return up to which `shape_difference` captures of these lengths may well be of one person, at least 1.

    A short capture shows few poses and faces, so its spread tells too little of how much the shape varies. The error of
    a mean falls with the square root of the length.
    """
    mean = (1 / max(seconds, 1e-6) + 1 / max(others, 1e-6)) / 2
    return max(1.0, math.sqrt(_IDENTITY_SURE_SECONDS * mean))


def group_people(shapes: Sequence[np.ndarray], frames: Sequence[int]) -> list[list[int]]:
    """Return the captures (as indices, with their `face_shapes` and numbers of frames) of each person.

    The person with most frames comes first. A capture joins the person whose longest capture it differs from least. It
    is of somebody else if it differs from all; where nothing can be said about a person, it joins that one.
    """
    people: list[list[int]] = []
    for index in sorted(range(len(shapes)), key=lambda index: (-frames[index], index)):
        found = [(shape_difference(shapes[person[0]], shapes[index]), person) for person in people]
        # An unknown difference is as good as the limit.
        likely = [(1.0 if difference is None else difference, person) for difference, person in found]
        difference, person = min(likely, key=lambda pair: pair[0], default=(np.inf, []))
        person.append(index) if difference <= 1 else people.append([index])
    return sorted((sorted(person) for person in people), key=lambda person: -sum(frames[index] for index in person))


def _turned_alike(shapes: Shapes) -> tuple[Shapes, Float[np.ndarray, "n 3 3"]]:
    """Return the shapes rotated onto their mean, and these rotations (Procrustes)."""
    turned, rotations = shapes[:1], np.eye(3)[None]
    for _ in range(4):
        u, _, v = np.linalg.svd(np.einsum("kx,nky->nxy", turned.mean(axis=0), shapes))
        u[..., 2] *= np.linalg.det(u @ v)[:, None]
        rotations = u @ v
        turned = np.einsum("nxy,nky->nkx", rotations, shapes)
    return turned, rotations


def _nearest_pairs(angles: Float[np.ndarray, "n m"], most: float) -> list[tuple[int, int]]:
    """Return up to eight pairs of frames, the nearest first, each frame once."""
    left, pairs = angles.copy(), []
    while len(pairs) < 8 and left.size and left.min() <= most:
        i, j = divmod(int(left.argmin()), left.shape[1])
        left[i], left[:, j] = np.inf, np.inf
        pairs.append((i, j))
    return pairs
