"""The tracked mesh is drawn into the outline of the person, before training.

A tracked skull can stand out beyond the hair, ears can hang lower than the person's, and a neck can be wider. What no
picture shows of them is filled at the mesh, so every picture contradicts it there, and nothing takes it away. Each
vertex that lies outside of the matte is therefore drawn to it, in all frames together, by smooth offsets of the mesh.
What lies inside stays where tracking put it: hair and earrings are beyond a mesh that is right. Only the
scalp moves as a whole, because pictures from the front show its highest points alone, and these would be cut flat.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.nn.functional import grid_sample

from mien.camera import Camera
from mien.face.head_parts import head_parts
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.machine.parallel import stream_in_threads
from mien.machine.threads import one_torch_thread
from mien.training.footage.frames import Footage, Frame, spread_frames
from mien.training.settings import TrainSettings
from mien.training.whole_head.unseen import fills_sides

_OUTLINE_FRAMES = 48  # largest number of frames whose outlines are looked at
_OUTLINE_FRAMES_AT_ONCE = 6  # number of frames in one round of the descent
_OUTLINE_ROUNDS = 160  # number of rounds. Measured: 240 leave as much of the mesh outside (log, 11-26)
_OUTLINE_RATE = 0.0012  # first step of the descent in metres. It falls to 0. Chosen with the number of rounds
_OUTLINE_FREE = 1.0  # distance in pixels from the matte up to which a vertex counts as inside
_OUTLINE_ROBUST = 0.003  # distance in metres beyond which the pull on a vertex grows no more
_OUTLINE_REACH = 0.014  # distance in metres over which the mesh moves together (standard deviation of a Gaussian)
_OUTLINE_SPACING = 0.012  # distance in metres between the points that are moved
_OUTLINE_SHIFT_WEIGHT = 0.5
"""Weight of the mean square of all shifts in metres, against the mean pull. It makes the smallest change win. Measured:
2 leaves 0.2 to 0.5 % of the mesh outside on s18, d14 and d6, 0.5 leaves 0.1 to 0.3 %, 0.1 leaves 0.02 to 0.1 % and
moves an ear by 12 mm (log, 11-26)."""
_OUTLINE_BEND_WEIGHT = 4.0
"""Weight of the mean square of how far a point of the scalp moves from what is around it, in metres. Measured on s18,
where a crown of 12 mm was cut flat: 2 leaves it a little flat, 8 leaves 0.05 instead of 0.01 % of the mesh outside. The
other six clips do not change (log, 11-27)."""
_OUTLINE_SCALP_REACH = 0.04
"""Distance in metres over which points of the scalp count as around each other (standard deviation of a Gaussian)."""
_OUTLINE_SCALP_HELD = 0.1  # share of `outline_shift_weight` that holds the scalp

_FIRST, _SECOND = 0.8, 0.95
"""Decay of the running means of the gradient and of its square (Adam; Kingma and Ba 2015)."""
_OPAQUE = 128
"""Least alpha of a pixel that belongs to the person, 0..255."""


@dataclass(frozen=True, eq=False)
class _View:
    camera: Camera
    outside: Float[Tensor, "1 1 h w"]
    """Distance of each pixel from the matte, in pixels; 0 inside."""
    world: Float[Tensor, "k 3"]
    """The vertices as tracked, in world space."""
    turn: Float[Tensor, "3 3"]
    """Rotation from the head to the world."""

    def pull(self, shift: Float[Tensor, "k 3"]) -> Float[Tensor, ""]:
        """The mean cost of vertices outside of the matte, in metres, when the mesh is shifted in the head frame."""
        pixels, depth = self.camera.project(self.world + shift @ self.turn.T)
        grid = pixels / pixels.new_tensor([self.camera.width, self.camera.height]) * 2 - 1
        # What the picture cuts off may be anywhere.
        framed = (grid.detach().abs() < 1).all(-1) & (depth.detach() > 0)
        distance = grid_sample(self.outside, grid[None, None], padding_mode="border", align_corners=False)[0, 0, 0]
        metres = (distance - _OUTLINE_FREE).clamp_min(0) * framed * depth.detach() / self.camera.K[0, 0]
        return (metres.square() / (metres + _OUTLINE_ROBUST)).mean()


def fitted_faces(footage: Footage, settings: TrainSettings, *, bound: bool) -> list[FaceParams] | None:
    """The face parameters of each sequence with a mesh that lies inside the mattes. None if it stays as it is.

    `bound` says whether the avatar's Gaussians are bound to the mesh. To others it does not matter.
    """
    filled = fills_sides(footage.frames, settings, bound=bound)
    wanted = settings.mesh == "fitted" or (settings.mesh == "auto" and filled)
    if not (bound and wanted):
        return None
    with one_torch_thread():  # so that the bytes do not depend on the number of threads
        offsets = fit_to_outlines(footage)
    return [replace(face, vertex_offsets=offsets) for face in footage.faces]


def fit_to_outlines(footage: Footage) -> Float[Tensor, "v 3"]:
    """Return offsets of the subject's vertices with which the mesh lies inside the mattes, in metres.

    They contain the offsets that the faces already have. Poses and expressions stay as they are. At most 48 frames,
    evenly spread, are looked at. Of these, frames with an empty matte say nothing.
    """
    face_model, faces = footage.face_model, footage.faces
    given = faces[0].vertex_offsets
    start = torch.zeros_like(face_model.template) if given is None else given.detach()
    rest = face_model.rest_vertices(faces[0]).detach()
    chosen = spread_points(rest, _OUTLINE_SPACING)
    weights = smooth_weights(rest, rest[chosen], _OUTLINE_REACH)
    scalp = _Scalp.of(face_model, rest, chosen)
    outer = _outer_vertices(face_model)
    own = weights[outer]

    def view(frame: Frame) -> _View:
        outside = torch.from_numpy(_distance(footage.matte(frame)))[None, None]
        turn = footage.face(frame).T_world_head[0, :3, :3]
        return _View(footage.camera(frame), outside, footage.vertices(frame).detach()[outer], turn)

    # Without an opaque pixel, all distances are infinite.
    spread = spread_frames(footage.frames, _OUTLINE_FRAMES)
    looked = [frame for frame in spread if bool((footage.matte(frame) >= _OPAQUE).any())]
    views = list(stream_in_threads(view, looked))
    rounds = _OUTLINE_ROUNDS if views else 0
    shifts, first, second = (torch.zeros(weights.shape[1], 3) for _ in range(3))
    random = torch.Generator().manual_seed(0)
    for number in range(1, rounds + 1):
        drawn = torch.randperm(len(views), generator=random)[:_OUTLINE_FRAMES_AT_ONCE].tolist()
        shifts = shifts.detach().requires_grad_()
        moved = own @ shifts
        pulls = torch.stack([views[one].pull(moved) for one in drawn])
        (gradient,) = torch.autograd.grad(scalp.cost(shifts) + pulls.mean(), shifts)
        first, second = torch.lerp(gradient, first, _FIRST), torch.lerp(gradient.square(), second, _SECOND)
        scale = (second / (1 - _SECOND**number)).sqrt() + 1e-12
        rate = _OUTLINE_RATE * (1 - number / rounds) / (1 - _FIRST**number)
        shifts = shifts.detach() - rate * first / scale
    return start + weights @ shifts


@dataclass(frozen=True, eq=False)
class _Scalp:
    """Computes the cost of shifts of the points. On the scalp, it grows with their difference to those around them."""

    inside: Float[Tensor, " a"]
    """1 for points on the scalp, 0 elsewhere."""
    around: Float[Tensor, "a a"]
    """The share of each other point in what is around a point."""

    @staticmethod
    def of(face_model: FaceModel, vertices: Float[Tensor, "v 3"], chosen: list[int]) -> "_Scalp":
        """The costs for some of the vertices as points."""
        inside = torch.ones(len(vertices), dtype=torch.bool)
        inside[face_model.faces[~head_parts(face_model).scalp].long().flatten()] = False
        points = vertices[chosen]
        around = _gaussians(points, points, _OUTLINE_SCALP_REACH).fill_diagonal_(0)
        return _Scalp(inside[chosen].to(vertices), around / around.sum(1, keepdim=True))

    def cost(self, shifts: Float[Tensor, "a 3"]) -> Float[Tensor, ""]:
        """The cost of shifts in metres. The scalp follows what is around it, and does not pull at it."""
        near = torch.where(self.inside[:, None] > 0, shifts, shifts.detach())
        bent = (self.inside * (shifts - self.around @ near).square().sum(1)).mean()
        held = 1 - (1 - _OUTLINE_SCALP_HELD) * self.inside
        moved = (held * shifts.square().sum(1)).mean()
        return _OUTLINE_SHIFT_WEIGHT * moved + _OUTLINE_BEND_WEIGHT * bent


def spread_points(vertices: Float[Tensor, "v 3"], spacing: float) -> list[int]:
    """Return indices of spread vertices, from which no vertex is further than `spacing`, in metres."""
    chosen, away = [0], torch.linalg.vector_norm(vertices - vertices[0], dim=1)
    while float(away.max()) > spacing:
        chosen.append(int(away.argmax()))
        away = torch.minimum(away, torch.linalg.vector_norm(vertices - vertices[chosen[-1]], dim=1))
    return chosen


def smooth_weights(vertices: Float[Tensor, "v 3"], points: Float[Tensor, "a 3"], reach: float) -> Float[Tensor, "v a"]:
    """Return the share of each point in each vertex: Gaussians of the distance with the sum 1. Lengths in metres."""
    weights = _gaussians(vertices, points, reach)
    return weights / weights.sum(1, keepdim=True)


def _gaussians(first: Float[Tensor, "v 3"], second: Float[Tensor, "a 3"], reach: float) -> Float[Tensor, "v a"]:
    apart = torch.cdist(first, second, compute_mode="donot_use_mm_for_euclid_dist")
    return torch.exp(-0.5 * (apart / reach).square())


def _outer_vertices(face_model: FaceModel) -> Bool[Tensor, " v"]:
    """The vertices that can be on an outline: those of triangles that are not inside the head."""
    parts = head_parts(face_model)
    inner = parts.interior | torch.stack(parts.eyes).any(0)
    outer = torch.zeros(len(face_model.template), dtype=torch.bool)
    outer[face_model.faces[~inner].long().flatten()] = True
    return outer


def _distance(matte: UInt8[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    return cv2.distanceTransform((matte < _OPAQUE).astype(np.uint8), cv2.DIST_L2, 5)
