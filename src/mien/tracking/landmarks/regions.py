"""Regions for a face model without any: lips, lids, brows, nose, ears, hair and neck, placed by its landmarks."""

from dataclasses import replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float

from mien.face.chart import edge_connected, find_outside
from mien.face.model import FaceModel
from mien.tracking.landmarks.groups import LEFT_EYELIDS, LIPS, NOSE, RIGHT_EYELIDS

_LID_WIDTH = 0.006  # largest distance of lids from their landmarks, in metres
_MOUTH_REACH = 0.075  # largest distance of the mouth's inside from the middle of the lips, in metres
_SOCKET_REACH = 0.025  # largest distance of a socket from its eyeball, in metres
_HAIRLINE = 0.010  # height of the hairline above the forehead's highest landmark, in metres
_NECK = 0.030  # distance of the neck below the chin, measured to a plane slanted like the jaw, in metres

_LIPS_OUTER = (61, 146, 91, 181, 84, 17, 314, 405, 321, 375, 291, 409, 270, 269, 267, 0, 37, 39, 40, 185)
_BROWS = ((70, 63, 105, 66, 107, 55, 65, 52, 53, 46), (300, 293, 334, 296, 336, 285, 295, 282, 283, 276))
_FOREHEAD, _CHIN, _TEMPLES, _TRAGI, _JAW_CORNERS = 10, 152, (127, 356), (234, 454), (58, 288)


def with_regions_by_landmarks(model: FaceModel) -> FaceModel:
    """Return the model with the regions of the default model. Those that it has stay, except skin and neck."""
    marks = model.landmark_positions(model.template, "mediapipe").numpy()
    middle = model.template[model.faces].numpy().mean(1)
    outside = find_outside(model.template.numpy(), model.faces.numpy())
    found = _around_the_face(model, middle, marks)
    found["nose"] = _within(middle, marks[list(NOSE)], hull=True) & (middle[:, 2] > marks[list(_TEMPLES), 2].mean())
    found["brows"] = outside & (_within(middle, marks[list(_BROWS[0])]) | _within(middle, marks[list(_BROWS[1])]))
    found["eyelids"], found["eye_sockets"] = _around_eyes(model, middle, marks, outside)
    near = _distance(middle, marks[list(LIPS)]) < 0.008  # largest distance of lips from their landmarks, in metres
    found["lips"] = _within(middle, marks[list(_LIPS_OUTER)]) & near
    hidden = ~outside & ~found["lips"] & ~found["eyelids"] & ~found["eye_sockets"]
    inside = edge_connected(model.faces.numpy(), ~outside)
    behind_lips = _within(middle, marks[list(_LIPS_OUTER)]) & (middle[:, 2] > marks[list(_TRAGI), 2].mean())
    near = np.linalg.norm(middle - marks[list(LIPS)].mean(0), axis=1) < _MOUTH_REACH
    found["mouth"] = hidden & near & np.isin(inside, inside[behind_lips & hidden])
    return _named(model, found)


def _around_the_face(
    model: FaceModel, middle: Float[np.ndarray, "f 3"], marks: Float[np.ndarray, "l 3"]
) -> dict[str, Bool[np.ndarray, " f"]]:
    x, y, z = middle.T
    tragus, corner, temple = (marks[list(pair)].mean(0) for pair in (_TRAGI, _JAW_CORNERS, _TEMPLES))
    scalp = (y > marks[_FOREHEAD, 1] + _HAIRLINE) | ((y > corner[1]) & (z < tragus[2] - 0.02))
    scalp |= (y > temple[1]) & (z < temple[2] + 0.8 * (y - temple[1]))
    slant = np.array([0.0, 1.0, 0.5])
    neck = model.region_mask("neck").numpy() | (middle @ slant < marks[_CHIN] @ slant - _NECK)
    neck |= (y < corner[1]) & (z < corner[2] - 0.02)
    level = (y > corner[1]) & (y < marks[list(_BROWS[0]), 1].min())
    ears = level & (np.abs(x) > 0.97 * np.abs(marks[list(_TRAGI), 0]).mean()) & (z < tragus[2] + 0.006)
    return {"scalp": scalp, "neck": neck, "ears": ears}


def _around_eyes(
    model: FaceModel, middle: Float[np.ndarray, "f 3"], marks: Float[np.ndarray, "l 3"], outside: Bool[np.ndarray, " f"]
) -> tuple[Bool[np.ndarray, " f"], Bool[np.ndarray, " f"]]:
    """The triangles of the lids and of the sockets."""
    balls = model.region_mask("eyes", "irises").numpy()
    eyelids, sockets = np.zeros(len(middle), bool), np.zeros(len(middle), bool)
    for lids in (LEFT_EYELIDS, RIGHT_EYELIDS):
        rim = marks[list(lids)]
        ball = middle[balls & (np.sign(middle[:, 0]) == np.sign(rim[0, 0]))].mean(0)
        far = _distance(middle, rim)
        behind = ~outside & (np.linalg.norm(middle - ball, axis=1) < _SOCKET_REACH) & (far > 0.5 * _LID_WIDTH)
        eyelids |= (outside & _within(middle, rim, hull=True)) | (~behind & (far < _LID_WIDTH))
        sockets |= behind
    return eyelids, sockets


def _named(model: FaceModel, found: dict[str, Bool[np.ndarray, " f"]]) -> FaceModel:
    known = [name for name in model.region_names if name not in ("skin", "neck")]
    names = ("skin", *known, *(name for name in found if name not in known))
    regions = np.zeros(len(model.faces), np.int64)
    for name, mask in found.items():  # Later regions overwrite earlier ones.
        regions[mask] = names.index(name)
    for name in known:
        regions[model.region_mask(name).numpy()] = names.index(name)
    return replace(model, region_names=names, face_regions=torch.from_numpy(regions))


def _within(
    points: Float[np.ndarray, "n 3"], ring: Float[np.ndarray, "m 3"], hull: bool = False
) -> Bool[np.ndarray, " n"]:
    """Which points are inside a polygon, seen from the front."""
    polygon = (1000 * ring[:, :2]).astype(np.float32)
    polygon = cv2.convexHull(polygon)[:, 0] if hull else polygon
    return np.array([cv2.pointPolygonTest(polygon, (x, y), False) > 0 for x, y in (1000 * points[:, :2]).tolist()])


def _distance(points: Float[np.ndarray, "n 3"], marks: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, " n"]:
    return np.sqrt(((points[:, None] - marks) ** 2).sum(-1)).min(1)
