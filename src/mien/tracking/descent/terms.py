"""The costs of the `paper` schedule, in squared standard deviations, and what its pictures show of the surface."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import cosine_similarity

from mien.camera import Camera
from mien.face.params import FaceParams
from mien.render.mesh import MeshFragments, rasterize_mesh, vertex_normals
from mien.render.mesh_gradients import LitMesh, image_points, mesh_loss
from mien.tracking.descent.scene import PaperScene, PaperState, SequenceScene
from mien.tracking.fitting.solver import Smoothness
from mien.tracking.fitting.views import CameraBatch
from mien.tracking.landmarks.groups import LEFT_LID_PAIRS, RIGHT_LID_PAIRS
from mien.tracking.landmarks.term import LandmarkTerm
from mien.tracking.pixels.texture import LIGHT_EXTENT

COLOR_EPSILON = 0.02  # colour difference below which the pull fades

_COLOR_WEIGHT = 3e3  # of the mean colour difference (0..1) to the rendering; a squared standard deviation counts 1
_GAPS = (*RIGHT_LID_PAIRS, *LEFT_LID_PAIRS, (13, 14), (82, 87), (312, 317), (81, 178), (311, 402))
"""Pairs of upper and lower landmarks. Their distances show how far eyes and mouth are open."""


@dataclass(frozen=True, eq=False)
class Moving:
    """The parameters that a step may move, as leaves or constants."""

    row: Float[Tensor, " p"]
    identity: Float[Tensor, " i"]
    offsets: Float[Tensor, "v 3"]
    texture: Float[Tensor, "th tw 3"]
    light: Float[Tensor, "9 3"]
    log_focals: Float[Tensor, " g"]


@dataclass(frozen=True, eq=False)
class Target:
    """A picture that the fit uses."""

    sequence: int
    row: int
    camera: int
    image: Float[Tensor, "h w 3"]


def read_target(scene: PaperScene, sequence: int, row: int, camera: int) -> Target:
    """Read a picture of a sequence."""
    own = scene.sequences[sequence]
    image = own.pictures.picture(int(own.timesteps[row]), camera, own.cameras).image
    return Target(sequence, row, camera, image)


def face_of(scene: PaperScene, moving: Moving) -> FaceParams:
    """The parameters as face parameters."""
    face = scene.layout.face_params(moving.row[None], moving.identity)
    return replace(face, vertex_offsets=moving.offsets)


def pose_vertices(scene: PaperScene, moving: Moving) -> Float[Tensor, "v 3"]:
    """Vertices in the frame of the fit."""
    return scene.face_model(face_of(scene, moving))[0]


def _rasterize(
    scene: PaperScene, target: Target, moving: Moving, vertices: Float[Tensor, "v 3"]
) -> tuple[Camera, MeshFragments]:
    """The camera of a picture, and the mesh in it, without gradients."""
    height, width = target.image.shape[:2]
    camera = scene.camera(target.sequence, target.camera, moving.log_focals).resized(width, height)
    return camera, rasterize_mesh(vertices.detach(), scene.mesh.faces, replace(camera, K=camera.K.detach()))


def color_term(
    scene: PaperScene, target: Target, moving: Moving, vertices: Float[Tensor, "v 3"], weights: Float[Tensor, " f"]
) -> Float[Tensor, ""]:
    """The colour difference between picture and rendering, over triangles with a weight.

    Shading has no gradient by the vertices. Otherwise light that a few spherical harmonics do not explain would turn
    heads.
    """
    camera, fragments = _rasterize(scene, target, moving, vertices)
    shape = fragments, image_points(camera, vertices), vertex_normals(vertices.detach(), scene.mesh.faces)
    return _COLOR_WEIGHT * mesh_loss(*shape, *_appearance(scene, target, moving, weights))


def _appearance(
    scene: PaperScene, target: Target, moving: Moving, weights: Float[Tensor, " f"]
) -> tuple[LitMesh, Tensor, Tensor, tuple[Tensor, Tensor, float]]:
    """Mesh, texture, light, and the picture with its mask and the colour difference at which the pull fades."""
    picture = target.image, torch.ones(target.image.shape[:2]), COLOR_EPSILON
    return replace(scene.mesh, face_weights=weights), moving.texture, moving.light, picture


@torch.no_grad()
def without_smooth_difference(
    scene: PaperScene, target: Target, moving: Moving, weights: Float[Tensor, " f"]
) -> Target:
    """The picture minus its smooth difference from the rendering, which is light that the model does not explain."""
    vertices, picture = pose_vertices(scene, moving), torch.empty_like(target.image)
    camera, fragments = _rasterize(scene, target, moving, vertices)
    shape = fragments, image_points(camera, vertices), vertex_normals(vertices, scene.mesh.faces)
    mesh_loss(*shape, *_appearance(scene, target, moving, weights), picture)
    lit = torch.cat([weights, weights.new_zeros(1)])[fragments.face_index.long()][..., None]
    difference = target.image - picture
    # Outliers, such as hair that hides skin, say nothing about the light around them.
    usual = 0.1**2  # colour difference (0..1) above which a pixel hardly counts as light
    lit = lit * (usual / (usual + difference.square().sum(-1, keepdim=True)))
    depth = float(camera.project(vertices.mean(0, keepdim=True))[1])
    sigma = max(LIGHT_EXTENT * float(camera.K[0, 0]) / depth, 1.0)
    sums = _blur(torch.cat([difference * lit, lit], dim=-1).numpy(), sigma)
    smooth = torch.from_numpy(sums[..., :3] / np.maximum(sums[..., 3:], 1e-3)) * (lit > 0)
    return replace(target, image=target.image - smooth)


def _blur(image: Float[np.ndarray, "h w c"], sigma: float) -> Float[np.ndarray, "h w c"]:
    """Blur a picture; a wide blur runs on a smaller copy. The result is the same within 0.01, many times faster."""
    height, width = image.shape[:2]
    factor = max(int(sigma / 4), 1)  # until the standard deviation is about four pixels
    small = cv2.resize(image, (max(width // factor, 1), max(height // factor, 1)), interpolation=cv2.INTER_AREA)
    small = cv2.GaussianBlur(small, (0, 0), sigma / factor)
    return cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)


def landmark_terms(scene: PaperScene, target: Target, moving: Moving) -> Float[Tensor, ""]:
    """The cost of landmarks in all pictures of the timestep, and of the gaps between lids and between lips."""
    own = scene.sequences[target.sequence]
    term, cameras = own.terms[target.row], own.cameras_at(moving.log_focals)
    views = term.views
    # The effect of the offsets on landmarks is added to the bias, as at the end of the descent.
    moved = scene.face_model.landmarks["mediapipe"].positions(moving.offsets, scene.mesh.faces).double()
    cameras = CameraBatch(cameras.K.double(), cameras.viewmat.double())[views.camera]
    state, identity = moving.row.double()[None], moving.identity.double()
    projected = term.model.project(state, identity, scene.bias + moved, cameras, views.row)
    residual = projected - views.detected
    return (term.robust(residual, views)[0] + gap_costs(term, residual)).sum().float()


def gap_costs(term: LandmarkTerm, residual: Float[Tensor, "n l 2"]) -> Float[Tensor, " n"]:
    """The cost of the gaps between lids and between lips, each with the weight of its upper landmark."""
    upper, lower = (torch.tensor(column) for column in zip(*_GAPS, strict=True))
    of_gaps = replace(term, weights=term.weights[upper])
    return of_gaps.robust(residual[:, upper] - residual[:, lower], term.views)[0]


def prior_term(scene: PaperScene, row: Float[Tensor, " p"]) -> Float[Tensor, ""]:
    """The prior cost of a timestep's own parameters."""
    return (row * (scene.layout.precision.float() @ row)).sum()


def smoothness_term(
    own: SequenceScene, rows: Float[Tensor, "t p"], index: int, row: Float[Tensor, " p"]
) -> Float[Tensor, ""]:
    """The cost of the accelerations that involve the timestep."""
    first, last = max(index - 2, 0), min(index + 3, len(rows))
    window = torch.cat([rows[first:index], row[None], rows[index + 1 : last]])
    return Smoothness(own.smoothness.precision, own.smoothness.linked[first:last]).cost(window)


def shared_terms(scene: PaperScene, state: PaperState | Moving, lights: Iterable[Tensor]) -> Float[Tensor, ""]:
    """The prior costs of identity, offsets, focal lengths and these lights."""
    total = ((state.identity - scene.identity) / 0.5).square().sum()  # in standard deviations of the identity's prior
    total = total + (state.log_focals / 0.03).square().sum()  # the focal length stays near that of the start
    for light in lights:
        total = total + light_term(light)
    return total + offset_term(scene, state.offsets)


def light_term(light: Float[Tensor, "9 3"]) -> Float[Tensor, ""]:
    """Cost that pulls the light towards an even grey, with standard deviations of 0.3 and, between channels, 0.05."""
    even = light.new_zeros(9, 1)
    even[0] = math.sqrt(4 * math.pi)
    tinted = light - light.mean(1, keepdim=True)
    return ((light - even) / 0.3).square().sum() + (tinted / 0.05).square().sum()


def offset_term(scene: PaperScene, offsets: Float[Tensor, "v 3"]) -> Float[Tensor, ""]:
    """Cost that keeps vertex offsets small and smooth (uniform Laplacian). About 100 vertices count as one."""
    first, second, share = scene.neighbors
    mean = torch.zeros_like(offsets).index_add(0, first, offsets[second]) * share
    small = (offsets / 0.002).square().sum()
    smooth = ((offsets - mean) / 0.0001).square().sum()  # a tenth of a millimetre from the mean of the neighbours
    return (small + smooth) / 100


@torch.no_grad()
def visibility_of(scene: PaperScene, target: Target, moving: Moving) -> Float[Tensor, " f"]:
    """Cosine between each triangle's normal and the direction to the camera; 0 if the picture does not show it."""
    vertices = pose_vertices(scene, moving)
    camera, fragments = _rasterize(scene, target, moving, vertices)
    visible = fragments.face_index
    corners = vertices[scene.mesh.faces]
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    cosine = cosine_similarity(normals, camera.position - corners.mean(1), dim=1)
    out = torch.zeros(len(corners))
    faces = visible[visible >= 0].long().unique()
    out[faces] = cosine[faces].clamp_min(0)
    return out


@torch.no_grad()
def guess_texture(scene: PaperScene, target: Target, moving: Moving, texture: Float[Tensor, "th tw 3"]) -> None:
    """Fill the texture with one skin colour: the median of the pixels that the mesh covers."""
    _, fragments = _rasterize(scene, target, moving, pose_vertices(scene, moving))
    used = torch.cat([scene.used, torch.zeros(1)])[fragments.face_index.long()] > 0
    if used.any():
        texture[:] = target.image[used].median(0).values


def roughness_gradient(texture: Float[Tensor, "th tw 3"]) -> Float[Tensor, "th tw 3"]:
    """Gradient of squared differences of neighbouring texels (standard deviation 0.1), scaled like a picture's cost."""
    gradient = torch.zeros_like(texture)
    for axis in (0, 1):
        step = texture.detach().diff(dim=axis)
        size = texture.shape[axis] - 1
        gradient.narrow(axis, 1, size).add_(step)
        gradient.narrow(axis, 0, size).sub_(step)
    return gradient * (2 / 0.1**2 / texture.shape[0])
