"""What the parts of analyses draw: a head or its mouth from near, an avatar with some Gaussians, and labels."""

from dataclasses import replace

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from mien.avatar.avatar import Avatar
from mien.camera import Camera
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.media.pictures import WHITE, Box, to_uint8
from mien.render import rasterize
from mien.render.mesh import Headlight, render_mesh

_MOUTH = ("lips", "teeth")
"""Regions that say where the mouth is. The first one that the face model has counts."""
_STRIP = 20
"""Height of a label above a picture, in pixels."""


def zoomed(camera: Camera, box: Box, side: int) -> Camera:
    """A part of the camera's view as a square picture of `side` pixels."""
    left, top, width, height = box
    scale = side / max(width, height)
    K = camera.K.clone()
    K[0, 2] -= left + width / 2
    K[1, 2] -= top + height / 2
    K[:2] *= scale
    K[:2, 2] += side / 2
    return replace(camera, K=K, width=side, height=side)


def mouth_box(model: FaceModel, face: FaceParams, camera: Camera) -> Box:
    """A square box around the mouth in the picture, at least 8 pixels wide. Without a mouth, it is around the head."""
    mask = next((mask for mask in map(model.region_mask, _MOUTH) if bool(mask.any())), None)
    points = model(face)[0]
    return _square(points if mask is None else points[model.faces[mask].unique()], camera, 1.3)


def mouth_camera(model: FaceModel, face: FaceParams, camera: Camera, side: int) -> Camera:
    """The camera, enlarged to the mouth, with a square picture."""
    return zoomed(camera, mouth_box(model, face, camera), side)


def head_camera(model: FaceModel, face: FaceParams, camera: Camera, side: int) -> Camera:
    """The camera, enlarged to the head, with a square picture."""
    return zoomed(camera, _square(model(face)[0], camera, 1.15), side)


def _square(points: Float[Tensor, "p 3"], camera: Camera, margin: float) -> Box:
    pixels, _ = camera.project(points)
    low, high = pixels.amin(0), pixels.amax(0)
    side = max(8.0, margin * float((high - low).max()))
    x, y = ((low + high) / 2).tolist()
    return round(x - side / 2), round(y - side / 2), round(side), round(side)


@torch.no_grad()
def draw_avatar(
    avatar: Avatar, face: FaceParams, camera: Camera, kept: Tensor | None = None
) -> UInt8[np.ndarray, "h w 3"]:
    """The avatar over white, with all Gaussians or those that a mask or indices select."""
    gaussians = avatar.pose(face).gaussians.timestep(0)
    return to_uint8(rasterize(gaussians if kept is None else gaussians.select(kept), camera, torch.ones(3)).image)


@torch.no_grad()
def draw_mesh(model: FaceModel, face: FaceParams, camera: Camera) -> UInt8[np.ndarray, "h w 3"]:
    """The mesh of the face model, grey and lit, over white."""
    return to_uint8(render_mesh(model(face)[0], model.faces, camera, light=Headlight(), supersample=2)[0])


def labeled(image: UInt8[np.ndarray, "h w 3"], text: str) -> UInt8[np.ndarray, "_ w 3"]:
    """The picture below a white strip with a text, which is cut where it is too long."""
    strip = np.full((_STRIP, image.shape[1], 3), WHITE, np.uint8)
    cv2.putText(strip, text, (3, _STRIP - 6), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (60, 60, 60), 1, cv2.LINE_AA)
    return np.concatenate([strip, image], axis=0)
