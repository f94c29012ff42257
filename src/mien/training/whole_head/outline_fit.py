"""The tracked mesh is drawn into the outline of the person, before training.

A tracked skull can stand out beyond the hair, ears can hang lower than the person's, and a neck can be wider. What no
picture shows of them is filled at the mesh, so every picture contradicts it there, and nothing takes it away. Each
vertex that lies outside of the matte is therefore drawn to it, in all frames together, by smooth offsets of the mesh.
What lies inside stays where tracking put it: hair and hanging things stand out beyond a mesh that is right. Only the
scalp moves as a whole, because pictures from the front show its highest points alone, and these would be cut flat.
"""

from collections.abc import Sequence as Items
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
from mien.training.footage.frames import Frame, spread_frames
from mien.training.footage.sequence import Sequence
from mien.training.settings import TrainSettings
from mien.training.whole_head.constants import WHOLE_HEAD
from mien.training.whole_head.unseen import fills_sides

_FIRST, _SECOND = 0.8, 0.95
"""Decay of the running means of the gradient and of its square (Adam; Kingma and Ba 2015)."""
_OPAQUE = 128
"""Least alpha of a pixel that belongs to the person, 0..255."""


@dataclass(frozen=True, eq=False)
class _View:
    """One frame, as the descent sees it."""

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
        metres = (distance - WHOLE_HEAD.outline_free).clamp_min(0) * framed * depth.detach() / self.camera.K[0, 0]
        return (metres.square() / (metres + WHOLE_HEAD.outline_robust)).mean()


def fitted_faces(
    face_model: FaceModel, sequences: Items[Sequence], frames: Items[Frame], settings: TrainSettings, *, bound: bool
) -> list[FaceParams] | None:
    """The tracked face parameters of each sequence with a mesh that lies inside the mattes. None if it stays as it is.

    `bound` says whether the avatar's Gaussians are bound to the mesh. To others it does not matter.
    """
    wanted = settings.mesh == "fitted" or (settings.mesh == "auto" and fills_sides(frames, settings, bound=bound))
    if not (bound and wanted):
        return None
    faces = [sequence.tracking.face for sequence in sequences]
    with one_torch_thread():  # so that the bytes do not depend on the number of threads
        offsets = fit_to_outlines(face_model, sequences, faces, frames)
    return [replace(face, vertex_offsets=offsets) for face in faces]


def fit_to_outlines(
    face_model: FaceModel,
    sequences: Items[Sequence],
    faces: Items[FaceParams],
    frames: Items[Frame],
    threads: int | None = None,
) -> Float[Tensor, "v 3"]:
    """Return offsets of the subject's vertices with which the mesh lies inside the mattes, in metres.

    They contain the offsets that `faces` already have. Poses and expressions stay as they are.

    Args:
        face_model: The face model, float32 on the CPU.
        sequences: The sequences that the frames count in.
        faces: Face parameters of each sequence, with all its timesteps.
        frames: The frames to look at. At most `outline_frames` of them, evenly spread, are used. Of these, frames with
            an empty matte say nothing.
        threads: Number of frames that are read at a time; by default, MIEN_THREADS or all cores. It changes no bit.
    """
    given = faces[0].vertex_offsets
    start = torch.zeros_like(face_model.template) if given is None else given.detach()
    rest = face_model.rest_vertices(faces[0]).detach()
    chosen = spread_points(rest, WHOLE_HEAD.outline_spacing)
    weights = smooth_weights(rest, rest[chosen], WHOLE_HEAD.outline_reach)
    scalp = _Scalp.of(face_model, rest, chosen)
    outer = _outer_vertices(face_model)
    own = weights[outer]

    def view(frame: Frame) -> _View:
        sequence, face = sequences[frame.sequence], faces[frame.sequence][frame.timestep]
        outside = torch.from_numpy(_distance(sequence.capture.mattes[frame[1:]]))[None, None]
        world = face_model(face)[0].detach()[outer]
        return _View(sequence.tracking.cameras[frame.camera], outside, world, face.T_world_head[0, :3, :3])

    def shows_person(frame: Frame) -> bool:
        return bool((sequences[frame.sequence].capture.mattes[frame[1:]] >= _OPAQUE).any())

    # Without an opaque pixel, all distances are infinite.
    looked = [frame for frame in spread_frames(frames, WHOLE_HEAD.outline_frames) if shows_person(frame)]
    views = list(stream_in_threads(view, looked, threads))
    rounds = WHOLE_HEAD.outline_rounds if views else 0
    shifts, first, second = (torch.zeros(weights.shape[1], 3) for _ in range(3))
    random = torch.Generator().manual_seed(0)
    for number in range(1, rounds + 1):
        drawn = torch.randperm(len(views), generator=random)[: WHOLE_HEAD.outline_frames_at_once].tolist()
        shifts = shifts.detach().requires_grad_()
        moved = own @ shifts
        pulls = torch.stack([views[one].pull(moved) for one in drawn])
        (gradient,) = torch.autograd.grad(scalp.cost(shifts) + pulls.mean(), shifts)
        first, second = torch.lerp(gradient, first, _FIRST), torch.lerp(gradient.square(), second, _SECOND)
        scale = (second / (1 - _SECOND**number)).sqrt() + 1e-12
        rate = WHOLE_HEAD.outline_rate * (1 - number / rounds) / (1 - _FIRST**number)
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
        around = _gaussians(points, points, WHOLE_HEAD.outline_scalp_reach).fill_diagonal_(0)
        return _Scalp(inside[chosen].to(vertices), around / around.sum(1, keepdim=True))

    def cost(self, shifts: Float[Tensor, "a 3"]) -> Float[Tensor, ""]:
        """The cost of shifts in metres. The scalp follows what is around it, and does not pull at it."""
        near = torch.where(self.inside[:, None] > 0, shifts, shifts.detach())
        bent = (self.inside * (shifts - self.around @ near).square().sum(1)).mean()
        held = 1 - (1 - WHOLE_HEAD.outline_scalp_held) * self.inside
        moved = (held * shifts.square().sum(1)).mean()
        return WHOLE_HEAD.outline_shift_weight * moved + WHOLE_HEAD.outline_bend_weight * bent


def spread_points(vertices: Float[Tensor, "v 3"], spacing: float) -> list[int]:
    """Return indices of spread vertices, from which no vertex is further than `spacing`, in metres."""
    chosen, away = [0], torch.linalg.vector_norm(vertices - vertices[0], dim=1)
    while float(away.max()) > spacing:
        chosen.append(int(away.argmax()))
        away = torch.minimum(away, torch.linalg.vector_norm(vertices - vertices[chosen[-1]], dim=1))
    return chosen


def smooth_weights(vertices: Float[Tensor, "v 3"], points: Float[Tensor, "a 3"], reach: float) -> Float[Tensor, "v a"]:
    """Return the share of each point in each vertex: Gaussians of the distance, with the sum 1.

    Args:
        vertices: A mesh, in metres.
        points: Some points, in metres.
        reach: Standard deviation of the Gaussians, in metres.
    """
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
    """The distance of each pixel from the half opaque part of a matte, in pixels."""
    return cv2.distanceTransform((matte < _OPAQUE).astype(np.uint8), cv2.DIST_L2, 5)
