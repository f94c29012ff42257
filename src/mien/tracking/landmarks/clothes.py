"""Points on clothes that are followed through a clip: they show how a torso turns, which two shoulders do not."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from mien.camera import Camera
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.face.torso import torso_pose
from mien.machine.progress import track_progress
from mien.render.mesh import rasterize_mesh
from mien.rotation import matrix_from_axis_angle

_STARTS = 8  # number of frames, evenly spread, from which points are followed in both directions
_POINTS = 80  # largest number of points that begin in one frame
_SPACING = 0.02  # smallest distance between two of them, as a share of the picture's longer side
_QUALITY = 0.005  # least strength of a corner, as a share of the strongest. Clothes have little contrast
_WINDOW = (21, 21)  # pixels around a point that are compared
_DRIFT = 1.5
"""Largest distance in pixels between a point followed from frame to frame and its match to the first frame."""
_MOST_FRAMES = 600  # largest number of frames that are read, evenly spread
_MOST_SEEN = 20_000  # largest number of sights. Beyond, frames are left out evenly
_SURE = 250  # least matte of a pixel on which a point begins
_INSIDE = 0.015  # distance of such a pixel from the edge of the matte, as a share of the picture's longer side


@dataclass(frozen=True, eq=False)
class Clothes:
    """m sights of p points on clothes, in the pictures of one camera."""

    places: Float[Tensor, "p 3"]
    """Where the mesh has each point, in the frame of the torso, in metres."""
    point: Int[Tensor, " m"]
    frame: Int[Tensor, " m"]
    pixels: Float[Tensor, "m 2"]


def follow_clothes(
    images: UInt8[np.ndarray, "t h w 3"],
    mattes: UInt8[np.ndarray, "t h w"],
    model: FaceModel,
    face: FaceParams,
    camera: Camera,
) -> Clothes:
    """Follow points that begin where the posed bust is in front of the person's matte."""
    read = range(0, len(images), -(-len(images) // _MOST_FRAMES))
    starts = sorted({int(start) for start in np.linspace(0, len(read) - 1, _STARTS + 2)[1:-1]})
    grey = [cv2.cvtColor(np.ascontiguousarray(images[frame]), cv2.COLOR_RGB2GRAY) for frame in read]
    bust = model.region_mask("bust")
    every = max(1, -(-_STARTS * _POINTS * len(read) // _MOST_SEEN))
    places, sights, count = [], [], 0
    for start in track_progress(starts, "Following clothes", len(starts)):
        found = _begin(grey[start], np.asarray(mattes[read[start]]), model, face[read[start]], camera, bust)
        if found is None:
            continue
        pixels, place = found
        places.append(place)
        for frames in (range(start + 1, len(read)), range(start - 1, -1, -1)):
            for frame, seen, moved in _follow(grey, start, pixels, frames):
                if frame % every == 0:
                    sights.append((count + seen, np.full(len(seen), read[frame]), moved))
        sights.append((count + np.arange(len(pixels)), np.full(len(pixels), read[start]), pixels))
        count += len(pixels)
    if not count:
        none = torch.zeros(0, dtype=torch.long)
        return Clothes(torch.zeros(0, 3), none, none, torch.zeros(0, 2))
    point, frame, pixels = (torch.from_numpy(np.concatenate(own)) for own in zip(*sights, strict=True))
    return Clothes(torch.cat(places), point, frame, pixels)


def _begin(
    grey: UInt8[np.ndarray, "h w"],
    matte: UInt8[np.ndarray, "h w"],
    model: FaceModel,
    face: FaceParams,
    camera: Camera,
    bust: Bool[Tensor, " f"],
) -> tuple[Float[np.ndarray, "n 2"], Float[Tensor, "n 3"]] | None:
    """Return points in one frame, in pixels, and where they are on the torso; None if it shows none."""
    vertices, side = model(face)[0], max(grey.shape)
    drawn = rasterize_mesh(vertices, model.faces, camera)
    index = drawn.face_index.long()
    on_bust = ((index >= 0) & bust[index.clamp_min(0)]).numpy()
    reach = 2 * round(_INSIDE * side) + 1
    allowed = cv2.erode(((matte >= _SURE) & on_bust).astype(np.uint8), np.ones((reach, reach), np.uint8))
    corners = cv2.goodFeaturesToTrack(grey, _POINTS, _QUALITY, _SPACING * side, mask=allowed)
    if corners is None:
        return None
    pixels = corners[:, 0].astype(np.float32)
    columns, rows = pixels.round().astype(int).T
    corner, weights = model.faces[index[rows, columns]].long(), drawn.barycentric[rows, columns]
    world = (vertices[corner] * weights[..., None]).sum(1)
    pose = torso_pose(model, face)
    place = (world - pose.translation) @ matrix_from_axis_angle(pose.rotation)[0]
    return pixels + 0.5, place


def _follow(
    grey: list[UInt8[np.ndarray, "h w"]], start: int, pixels: Float[np.ndarray, "n 2"], frames: range
) -> list[tuple[int, Int[np.ndarray, " k"], Float[np.ndarray, "k 2"]]]:
    """Return the frames in which points are seen again, which points, and where, until none is left.

    Each is followed from frame to frame, and then matched to the first frame, so that nothing drifts.
    """
    alive, last, previous, found = np.arange(len(pixels)), pixels - 0.5, grey[start], []
    for frame in frames:
        if not len(alive):
            break
        step, kept, _ = cv2.calcOpticalFlowPyrLK(previous, grey[frame], last, last.copy(), winSize=_WINDOW)
        matched, again, _ = cv2.calcOpticalFlowPyrLK(
            grey[start], grey[frame], pixels[alive] - 0.5, step.copy(), winSize=_WINDOW, maxLevel=0,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )  # fmt: skip
        good = (kept[:, 0] > 0) & (again[:, 0] > 0) & (np.linalg.norm(matched - step, axis=1) < _DRIFT)
        alive, last, previous = alive[good], matched[good], grey[frame]
        found.append((frame, alive, last + 0.5))
    return found
