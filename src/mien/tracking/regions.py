"""Regions of a face model that came without: lips, lids, brows, nose, ears, hair and neck by where its landmarks are."""

from dataclasses import replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float

from mien.face import FaceModel
from mien.face.chart import edge_connected, outside_of
from mien.tracking.landmark_groups import LEFT_EYELIDS, LIPS, NOSE, RIGHT_EYELIDS

_LIPS_OUTER = (61, 146, 91, 181, 84, 17, 314, 405, 321, 375, 291, 409, 270, 269, 267, 0, 37, 39, 40, 185)
_BROWS = ((70, 63, 105, 66, 107, 55, 65, 52, 53, 46), (300, 293, 334, 296, 336, 285, 295, 282, 283, 276))
_FOREHEAD, _CHIN, _TEMPLES, _TRAGI, _JAW_CORNERS = 10, 152, (127, 356), (234, 454), (58, 288)
_LIP_DEPTH, _LID_WIDTH = 0.008, 0.006
"""How far from their landmarks lips and lids reach, metres."""
_MOUTH_REACH, _SOCKET_REACH = 0.075, 0.025
"""How far what lies inside may be from the middle of the lips, and of an eyeball."""
_HAIRLINE, _NECK = 0.010, 0.030
"""Above the forehead's highest landmark; and below the chin, along a plane slanted like the jaw."""


def with_regions_by_landmarks(model: FaceModel) -> FaceModel:
    """The same model with regions as the default model has them, but for teeth and tongue; eyes stay as they are."""
    marks = model.landmark_positions(model.template, "mediapipe").numpy()
    triangles = model.template[model.faces].numpy()
    middle = triangles.mean(1)
    outside = outside_of(model.template.numpy(), model.faces.numpy())
    eyes = model.region_mask("eyes", "irises").numpy()
    found: dict[str, Bool[np.ndarray, " f"]] = {}
    x, y, z = middle.T
    tragus, corner = marks[list(_TRAGI)].mean(0), marks[list(_JAW_CORNERS)].mean(0)
    width = np.abs(marks[list(_TRAGI), 0]).mean()
    temple = marks[list(_TEMPLES)].mean(0)
    found["scalp"] = (y > marks[_FOREHEAD, 1] + _HAIRLINE) | ((y > corner[1]) & (z < tragus[2] - 0.02))
    found["scalp"] |= (y > temple[1]) & (z < temple[2] + 0.8 * (y - temple[1]))
    slanted = middle @ np.array([0, 1, 0.5])
    found["neck"] = model.region_mask("neck").numpy() | (slanted < marks[_CHIN] @ np.array([0, 1, 0.5]) - _NECK)
    found["neck"] |= (y < corner[1]) & (z < corner[2] - 0.02)
    found["ears"] = (
        (np.abs(x) > 0.97 * width) & (z < tragus[2] + 0.006) & (y > corner[1]) & (y < marks[list(_BROWS[0]), 1].min())
    )
    found["nose"] = _within(middle, marks[list(NOSE)], hull=True) & (z > temple[2])
    for ring in _BROWS:
        found["brows"] = found.get("brows", False) | (_within(middle, marks[list(ring)]) & outside)
    for lids in (LEFT_EYELIDS, RIGHT_EYELIDS):
        near = outside & (_distance(middle, marks[list(lids)]) < _LID_WIDTH)
        found["eyelids"] = (
            found.get("eyelids", False) | near | (_within(middle, marks[list(lids)], hull=True) & outside)
        )
        ball = middle[eyes & (np.sign(x) == np.sign(marks[lids[0], 0]))].mean(0)
        behind = ~outside & (np.linalg.norm(middle - ball, axis=1) < _SOCKET_REACH)
        behind &= _distance(middle, marks[list(lids)]) > 0.5 * _LID_WIDTH
        found["eye_sockets"] = found.get("eye_sockets", False) | behind
        found["eyelids"] |= ~outside & ~behind & (_distance(middle, marks[list(lids)]) < _LID_WIDTH)
    in_lips = _within(middle, marks[list(_LIPS_OUTER)])
    found["lips"] = in_lips & (_distance(middle, marks[list(LIPS)]) < _LIP_DEPTH)
    inside = edge_connected(model.faces.numpy(), ~outside)
    seeds = inside[in_lips & ~outside & ~found["lips"] & (z > tragus[2])]
    found["mouth"] = ~outside & ~found["lips"] & ~found["eyelids"] & ~found["eye_sockets"] & np.isin(inside, seeds)
    found["mouth"] &= np.linalg.norm(middle - marks[list(LIPS)].mean(0), axis=1) < _MOUTH_REACH
    return _named(model, found, eyes)


def _named(model: FaceModel, found: dict[str, Bool[np.ndarray, " f"]], eyes: Bool[np.ndarray, " f"]) -> FaceModel:
    names = ("skin", "eyes", "irises", *found)
    regions = np.zeros(len(model.faces), np.int64)
    for name, mask in found.items():  # later ones over earlier ones
        regions[mask & ~eyes] = names.index(name)
    for name in ("eyes", "irises"):
        regions[model.region_mask(name).numpy()] = names.index(name)
    return replace(model, region_names=names, face_regions=torch.from_numpy(regions))


def _within(
    points: Float[np.ndarray, "n 3"], ring: Float[np.ndarray, "m 3"], hull: bool = False
) -> Bool[np.ndarray, " n"]:
    """Which points are inside a polygon as seen from the front."""
    polygon = (ring[:, :2] * 1000).astype(np.float32)
    polygon = cv2.convexHull(polygon)[:, 0] if hull else polygon
    return np.array(
        [cv2.pointPolygonTest(polygon, (1000 * float(p[0]), 1000 * float(p[1])), False) > 0 for p in points]
    )


def _distance(points: Float[np.ndarray, "n 3"], marks: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, " n"]:
    return np.sqrt(((points[:, None] - marks) ** 2).sum(-1)).min(1)
