"""Tell people apart: compare the shapes of faces in two captures with how much they vary within each.

A shape is that of points of MediaPipe's mesh that expressions hardly move. The mesh depends on the pose of the head as
well, so only frames of similar poses are compared. Mirrored frames count, too: the shots of an interview show opposite
sides of faces.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from mien.capture.parts import Part
from mien.capture.person.backend import DetectorChoice
from mien.capture.person.faces import LANDMARKS, MeshReader
from mien.capture.store import JSON_NAME, read_capture
from mien.errors import UserError
from mien.machine.progress import say
from mien.machine.terminal import counted

_IDENTITY_PICTURES = 48  # pictures of a capture, spread evenly, of which shapes of faces are compared
_IDENTITY_MOST_PAIRS = 8  # pairs of pictures that are compared, those of the most similar poses
_IDENTITY_LEAST_PAIRS = 3  # pairs below which nothing is said
_IDENTITY_MOST_TURN = 0.35  # angle in radians between the poses of two pictures up to which they are compared
_IDENTITY_NOISE = 3e-4
"""Variance of a coordinate below which the spread within a clip is not trusted, in units of the face's size."""
_IDENTITY_MOST_DIFFERENCE = 4.6
"""Difference up to which two captures show one person. Halves of a clip differ by at most 3.3, people by 5.4."""
_IDENTITY_NEAR_TURN = 0.15  # angle up to which that holds; the estimated shape follows the pose
_IDENTITY_TURN_ALLOWANCE = 20.0  # ...and this much more difference is allowed for each radian beyond
_IDENTITY_NEIGHBORS = 4  # most captures of a workspace that a new one is compared with

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

    Returns:
        The difference, or None if too few of the pictures show the head in similar poses.
    """
    one = one[: len(one) // 2]  # mirrored pictures of one side are enough
    if min(len(one), len(other) // 2) < _IDENTITY_LEAST_PAIRS:
        return None
    turned, rotations = _turned_alike(np.concatenate([one, other]))
    angles = _angles(rotations[: len(one)], rotations[len(one) :])
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


def check_neighbors(
    sequences: Path, name: str, path: Path, pictures: UInt8[np.ndarray, "t h w 3"], detector: DetectorChoice
) -> None:
    """Check that other captures of a workspace show the person of these pictures.

    Args:
        sequences: folder of the workspace's sequences.
        name: name of the new capture; earlier ones of this name are not compared.
        path: source of the pictures, for the message.
        pictures: frames of the new capture.
        detector: what runs the networks.
    """
    shapes = None
    for json_path in sorted(sequences.glob(f"*/capture/{JSON_NAME}"))[:_IDENTITY_NEIGHBORS]:
        folder = json_path.parent.parent
        try:
            other = read_capture(json_path.parent)
        except UserError:
            continue  # whoever uses it says what is wrong with it
        part = other.source.get("part")
        if folder.name == name or isinstance(part, dict) and part.get("of") == name:
            continue
        shapes = face_shapes(pictures, detector) if shapes is None else shapes
        difference = shape_difference(shapes, face_shapes(other.images[:, 0], detector))
        if difference is None:
            continue
        if difference <= 1:
            return
        raise UserError(
            f"{path}: shows another person than {folder}: the shapes of their faces differ {difference:.1f} times as "
            "much as those of one person do at most; give another workspace with --out, or --capture.person 0 if it is "
            "the same person"
        )


def _turned_alike(shapes: Shapes) -> tuple[Shapes, Float[np.ndarray, "n 3 3"]]:
    """Return the shapes rotated onto their mean, and these rotations (Procrustes)."""
    turned, rotations = shapes[:1], np.eye(3)[None]
    for _ in range(4):
        u, _, v = np.linalg.svd(np.einsum("kx,nky->nxy", turned.mean(axis=0), shapes))
        u[..., 2] *= np.linalg.det(u @ v)[:, None]
        rotations = u @ v
        turned = np.einsum("nxy,nky->nkx", rotations, shapes)
    return turned, rotations


def _angles(one: Float[np.ndarray, "n 3 3"], other: Float[np.ndarray, "m 3 3"]) -> Float[np.ndarray, "n m"]:
    """Angles between rotations, in radians."""
    return np.arccos(np.clip((np.einsum("nij,mij->nm", one, other) - 1) / 2, -1, 1))


def _nearest_pairs(angles: Float[np.ndarray, "n m"], most: float) -> list[tuple[int, int]]:
    """Return up to `identity_most_pairs` pairs of frames, the nearest first, each frame once."""
    left, pairs = angles.copy(), []
    while len(pairs) < _IDENTITY_MOST_PAIRS and left.size and left.min() <= most:
        i, j = divmod(int(left.argmin()), left.shape[1])
        left[i], left[:, j] = np.inf, np.inf
        pairs.append((i, j))
    return pairs
