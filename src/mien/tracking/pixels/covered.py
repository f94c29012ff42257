"""Parts of the face that something covers in some frames: a hand, a cup, a phone, a microphone.

The detector guesses a plausible mouth behind a hand, so its landmarks fit. Pictures tell the difference: points of the
surface look alike in all frames that show them, up to light, and what covers them looks different or moves. The tracked
texture is not used, because a hand in half of the frames may be what it shows.
"""

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mien.capture.capture import Capture
from mien.face.model import FaceModel
from mien.machine.parallel import map_in_threads
from mien.render.mesh import rasterize_mesh, vertex_normals
from mien.rotation import matrix_from_axis_angle
from mien.tracking.fitting.fit import HIDING_REGIONS
from mien.tracking.fitting.views import batch_of
from mien.tracking.landmarks.groups import BROWS, LEFT_EYELIDS, LIPS, NOSE, RIGHT_EYELIDS
from mien.tracking.pixels.pictures import Picture, Pictures, window_of
from mien.tracking.pixels.texture import LIGHT_EXTENT
from mien.tracking.tracking import PARTS, Tracking

_PICTURE_SIZE = 256  # shorter side of the pictures that are compared, in pixels
_LEAST_COSINE = 0.3  # least cosine between the surface's normal and the direction to the camera of a point that counts
_LEAST_SEEN = 0.4  # least share of a part's points that a picture must show
_LEAST_LIKENESS = 0.35
"""Correlation with the usual look of a part below which something covers it. Measured: a drawn hand reaches 0.29 at
most. Seven real clips without hands have 0.43 or more, except for one frame of a grimace with 0.22, which `_LASTING`
leaves out."""
_LASTING = 0.05  # half of the least time that something covers a part, in seconds. A grimace is shorter than a hand
_LEAST_LASTING = 3
"""Fewest pictures in a row that something covers. At 25 frames a second it is what `_LASTING` says; with fewer, one
grimace or one turn of the head was taken for a hand."""
_SIMILAR_TURN = 15.0  # angle in degrees between the turns of a head up to which its pictures are compared
_ALIKE = 0.5  # correlation with the usual look above which a frame has a part in it
_FLAT = 0.05
"""Share of the usual contrast below which a picture is flat, such as a phone's back: it correlates with nothing."""
_USUAL_SHARE = 0.3  # share of the pictures that the usual look comes from. Fewer could be those of a hand that rests
_USUAL_ROUNDS = 5
"""Rounds in which the usual look is made of all pictures that are like it. Without them, 20 frames of wojtek were
found."""
_MANY = 0.25  # share of odd pictures from which on they may be the face itself
_CLEARLY = 0.1
"""Difference of correlations by which what moves in front of the face is less alike from picture to picture."""
_LOOK_EVERY = 0.2  # seconds between the frames that are looked at first
_LEAST_LOOKS = 60  # least number of these frames

_PLACES = {
    "mouth": (LIPS, 0.014), "nose": (NOSE, 0.008), "eyes": (LEFT_EYELIDS + RIGHT_EYELIDS + BROWS, 0.010),
}  # fmt: skip
"""Landmarks of each part, and the distance from them up to which triangles belong to it, in metres. Set by eye."""


def covered_parts(capture: Capture, tracking: Tracking, face_model: FaceModel) -> Bool[Tensor, "t c p"]:
    """Which of `PARTS` something covers, for each picture. Pictures without a face, or of the other side, have none.

    Points of each part are sampled from every picture, without the light. The largest group of pictures that look
    alike defines the usual look; if something covers a part for half of the time, this is the part itself, because
    what moves in front of it does not look alike from frame to frame. A picture that hardly correlates with it is
    covered. The result depends on no texture and on no landmark of a covered part.
    """
    seen = torch.from_numpy(np.asarray(capture.valid)) & tracking.valid[:, None]
    found = torch.zeros(*seen.shape, len(PARTS), dtype=torch.bool)
    places = _points_of(face_model)
    pictures = Pictures(capture, max(round(min(capture.width, capture.height) / _PICTURE_SIZE), 1))
    for camera in range(seen.shape[1]):
        timesteps = seen[:, camera].nonzero()[:, 0]
        stride = max(min(round(_LOOK_EVERY * capture.fps), len(timesteps) // _LEAST_LOOKS), 1)
        first = timesteps[::stride]
        looks = _looks(pictures, tracking, face_model, places, camera, first)
        usual = [the_face(usual_look(*part), *part) for part in looks]
        odd = [_unlike(look, *part) for look, part in zip(usual, looks, strict=True)]
        if stride > 1 and any(part.any() for part in odd):
            first = timesteps
            looks = _looks(pictures, tracking, face_model, places, camera, first)
            odd = [_unlike(look, *part) for look, part in zip(usual, looks, strict=True)]
        turns = matrix_from_axis_angle(tracking.face.head_rotation[first]).reshape(-1, 9).numpy()
        odd = [_compared(part, weights, turns) for part, (_, weights) in zip(odd, looks, strict=True)]
        least = max(2 * int(_LASTING * capture.fps) + 1, _LEAST_LASTING)  # Shorter runs are left out.
        stacked = np.stack(odd, axis=1).astype(np.uint8)
        lasting = cv2.morphologyEx(stacked, cv2.MORPH_OPEN, np.ones((least, 1), np.uint8))
        found[first, camera] = torch.from_numpy(lasting.astype(bool))
    return found


def usual_look(
    values: Float[np.ndarray, "n k 3"], weights: Float[np.ndarray, "n k"]
) -> Float[np.ndarray, "k 3"] | None:
    """The mean of the largest group of pictures that look alike; None if too few pictures agree.

    `values` are colours of the points of a part without the light, and `weights` are 1 where a picture shows a point.
    Both are 0 elsewhere.
    """
    enough = weights.mean(1) >= _LEAST_SEEN
    if enough.sum() < 8:  # fewest pictures of a part that can tell what is usual
        return None
    values, weights = values[enough], weights[enough]
    flat, wide = values.reshape(len(values), -1), weights.repeat(3, axis=1)
    power = (flat**2) @ wide.T
    power += _FLAT * np.quantile(power.diagonal(), 0.9) + 1e-9
    alike = flat @ flat.T / np.sqrt(power * power.T)
    count = max(round(_USUAL_SHARE * len(flat)), 3)
    center = np.sort(alike, axis=1)[:, -count].argmax()
    members = alike[center] >= np.sort(alike[center])[-count]
    look = _mean(values[members], weights[members])
    for _ in range(_USUAL_ROUNDS):
        members = _likeness(look, values, weights) >= _ALIKE
        if members.sum() < count:
            return None
        look = _mean(values[members], weights[members])
    return look


def _mean(values: Float[np.ndarray, "n k 3"], weights: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "k 3"]:
    return (values.sum(0) / weights.sum(0).clip(1)[:, None]).astype(np.float32)


def the_face(
    look: Float[np.ndarray, "k 3"] | None, values: Float[np.ndarray, "n k 3"], weights: Float[np.ndarray, "n k"]
) -> Float[np.ndarray, "k 3"] | None:
    """The usual look, or None if many pictures differ from it alike, because a hand rests or the light changed."""
    odd = _unlike(look, values, weights)
    if look is None or odd.mean() < _MANY:
        return look
    other = usual_look(values[odd], weights[odd])
    if other is None:
        return look
    own = np.median(_likeness(look, values[~odd], weights[~odd]))
    return None if np.median(_likeness(other, values[odd], weights[odd])) > own - _CLEARLY else look


def _likeness(
    look: Float[np.ndarray, "k 3"], values: Float[np.ndarray, "n k 3"], weights: Float[np.ndarray, "n k"]
) -> Float[np.ndarray, " n"]:
    """The correlation of each picture with the usual look, over the points that it shows."""
    flat, expected = values.reshape(len(values), -1), weights @ (look**2).sum(1) + 1e-9
    return flat @ look.reshape(-1) / np.sqrt(((flat**2).sum(1) + _FLAT * expected) * expected)


def _unlike(
    look: Float[np.ndarray, "k 3"] | None, values: Float[np.ndarray, "n k 3"], weights: Float[np.ndarray, "n k"]
) -> Bool[np.ndarray, " n"]:
    if look is None:
        return np.zeros(len(values), bool)
    return (_likeness(look, values, weights) < _LEAST_LIKENESS) & (weights.mean(1) >= _LEAST_SEEN)


def _compared(
    odd: Bool[np.ndarray, " n"], weights: Float[np.ndarray, "n k"], turns: Float[np.ndarray, "n 9"]
) -> Bool[np.ndarray, " n"]:
    """The odd pictures of a part for which enough usual ones show the head from nearly the same side.

    Seen from another side, a part may look odd without anything before it. `turns` are the head's rotation matrices.
    """
    usual = ~odd & (weights.mean(1) >= _LEAST_SEEN)
    # The trace of R^T S is 1 + 2 cos of the angle between the rotations R and S.
    near = turns[odd] @ turns[usual].T >= 1 + 2 * np.cos(np.radians(_SIMILAR_TURN))
    compared = odd.copy()
    compared[odd] = near.sum(1) >= 5  # fewest usual pictures of a similar turn without which a picture is not judged
    return compared


def _points_of(face_model: FaceModel) -> list[Int[Tensor, " _"]]:
    """The triangles of each part. Their middles are the points that are compared."""
    marks = face_model.landmark_positions(face_model.template, "mediapipe")
    middle = face_model.template[face_model.faces].mean(1)
    free, places = ~face_model.region_mask(*HIDING_REGIONS), []
    for name in PARTS:
        landmarks, reach = _PLACES[name]
        near = free & (torch.cdist(middle, marks[list(landmarks)]).amin(1) < reach)
        free = free & ~near
        places.append(near.nonzero()[:, 0])
    return places


@torch.no_grad()
def _looks(
    pictures: Pictures,
    tracking: Tracking,
    face_model: FaceModel,
    places: Sequence[Int[Tensor, " _"]],
    camera: int,
    timesteps: Int[Tensor, " n"],
) -> list[tuple[Float[np.ndarray, "n _ 3"], Float[np.ndarray, "n _"]]]:
    """Values and weights (`usual_look`) of each part in the pictures of one camera."""
    cameras = batch_of(tracking.cameras)
    ends = np.cumsum([len(place) for place in places])[:-1]
    triangles = face_model.faces[torch.cat(list(places))]
    skin = ~face_model.region_mask(*HIDING_REGIONS)
    values = np.zeros((len(timesteps), len(triangles), 3), np.float32)
    weights = np.zeros(values.shape[:2], np.float32)

    def look(row: int) -> None:
        timestep = int(timesteps[row])
        vertices = face_model(tracking.face[timestep])[0]
        picture = pictures.picture(timestep, camera, cameras)
        values[row], weights[row] = _sampled(picture, vertices, face_model, skin, triangles)

    map_in_threads(look, list(range(len(timesteps))))
    return list(zip(np.split(values, ends, axis=1), np.split(weights, ends, axis=1), strict=True))


def _sampled(
    picture: Picture,
    vertices: Float[Tensor, "v 3"],
    face_model: FaceModel,
    skin: Bool[Tensor, " f"],
    triangles: Int[Tensor, "k 3"],
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, " k"]]:
    """Colours without the light at the middles of some triangles, and 1 where the picture shows them, else 0."""
    window = window_of(picture.camera, vertices)
    camera, part = window.camera, (window.rows, window.columns)
    image, mask = picture.image[part].numpy(), picture.mask[part].numpy()
    shown = rasterize_mesh(vertices, face_model.faces, camera).face_index.numpy()
    mask = mask * ((shown >= 0) & skin.numpy()[shown])
    points = vertices[triangles].mean(1)
    at, depth = camera.project(points)
    sigma = LIGHT_EXTENT * float(camera.K[0, 0]) / max(float(depth.mean()), 1e-3)
    light = cv2.GaussianBlur(image * mask[..., None], (0, 0), sigma)
    light /= cv2.GaussianBlur(mask, (0, 0), sigma).clip(1e-3)[..., None]
    normals = torch.nn.functional.normalize(vertex_normals(vertices, face_model.faces)[triangles].mean(1), dim=1)
    cosine = (normals * torch.nn.functional.normalize(camera.position - points, dim=1)).sum(1).numpy()
    x, y = np.split((at - 0.5).numpy().astype(np.float32), 2, axis=1)
    seen = (cv2.remap(mask, x, y, cv2.INTER_LINEAR)[:, 0] > 0.5) & (cosine > _LEAST_COSINE)
    colors = cv2.remap(image - light, x, y, cv2.INTER_LINEAR)[:, 0]
    return colors * seen[:, None], seen.astype(np.float32)
