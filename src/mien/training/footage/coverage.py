"""How well the training pictures show each triangle of the tracked head, and in which colour.

One camera in front sees half of a head. `Coverage` belongs to the data and not to a method: training draws only what is
covered, what is not covered is filled afterwards, and pictures of the avatar can say which sides were filmed.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from mien.face.model import FaceModel
from mien.machine.parallel import stream_in_threads
from mien.render.mesh import rasterize_mesh, sample_picture
from mien.rotation import matrix_from_axis_angle
from mien.tracking.neck_cut import NeckCut, NeckParts, fit_neck_cut
from mien.training.footage.frames import Footage, Frame, spread_frames
from mien.training.footage.mesh_colors import DEPTH_TOLERANCE

_COVERAGE_EVEN_FRAMES = 48  # number of evenly spread frames in which coverage is measured
_COVERAGE_TURNED_FRAMES = 24  # number of other frames: those in which the head turns furthest to each side
_COVERAGE_FACING = (0.1, 0.3)
"""Cosines between a triangle's normal and the direction to the camera, between which its view begins to count."""
_COVERAGE_ENOUGH = 1.0
"""Sum of squared cosines over the frames from which a triangle is certain. Rare sights, such as teeth, count fully.
Geometry: one picture from straight ahead."""
_COVERAGE_CUT_SOFTNESS = 0.001  # distance in metres below the cut at the neck to which a vertex counts as above

_INTERIOR = ("mouth", "teeth", "tongue")
"""Regions inside the mouth. Lips hide them in most frames, so the mesh cannot say which of them pictures show."""


@dataclass(frozen=True, eq=False)
class Coverage:
    """What the training pictures show of the f triangles of a head."""

    seen: Float[Tensor, " f"]
    """Confidence: 1 for triangles that are seen often and squarely, 0 for those that are never seen; it fades."""
    colors: Float[Tensor, "f 3"]
    """Mean colours in the pictures, 0..1; 0.5 where `seen` is 0."""
    above: Float[Tensor, " f"]
    """1 for triangles above the cut at the neck, 0 for those below it, which nothing shows or scores; it fades. Without
    a cut, the lower edge of the picture is in its place."""


@torch.no_grad()
def measure_coverage(footage: Footage, threads: int | None = None) -> Coverage:
    """Confidence and mean colour of every triangle. The number of threads changes no bit.

    A frame counts for a triangle by the squared cosine between the triangle's normal and the direction to the camera,
    where the mesh hides it from nothing (a soft test against the mesh's own depth) and where the scoring mask has the
    head. At most 72 frames are used, and those in which the head turns furthest to either side are among them.
    """
    count = len(footage.face_model.faces)
    colors, weights, above = torch.zeros(count, 3), torch.zeros(count), torch.zeros(count)
    chosen = representative_frames(footage, _COVERAGE_EVEN_FRAMES, _COVERAGE_TURNED_FRAMES)
    neck = NeckParts.of(footage.face_model)

    def seen_in(frame: Frame) -> tuple[Tensor, Tensor, Tensor]:
        vertices = footage.vertices(frame)
        cut = fit_neck_cut(neck, vertices, footage.face(frame).T_world_head[0, :3, 1])
        return _seen_colors(footage, frame, vertices, cut)

    for own, weight, line in stream_in_threads(seen_in, chosen, threads):
        colors += weight[:, None] * own
        weights += weight
        above += line
    known = weights > 1e-3
    colors = torch.where(known[:, None], colors / weights.clamp_min(1e-3)[:, None], torch.tensor(0.5))
    seen = torch.where(known, smoothstep(weights / _COVERAGE_ENOUGH), 0.0)
    return Coverage(seen, colors, smoothstep(2 * above / len(chosen) - 1))


def representative_frames(footage: Footage, even: int, turned: int) -> list[Frame]:
    """Evenly spread frames, and those in which the camera sees the head furthest from each side, above and below.

    `turned` is the number of the latter, a quarter for each direction.
    """
    frames, chosen = footage.frames, spread_frames(footage.frames, even)
    directions = torch.stack([_camera_direction(footage, frame) for frame in frames])
    share = turned // 4
    for axis in (0, 1):
        order = directions[:, axis].argsort(stable=True).tolist()
        chosen += [frames[index] for index in (*order[:share], *order[len(order) - share :])]
    return sorted(set(chosen))


def drawn_share(face_model: FaceModel, covered: Coverage) -> Float[Tensor, " f"]:
    """How much of each triangle training draws, 0..1: its confidence, and everything inside the mouth."""
    interior = face_model.region_mask(*_INTERIOR)
    return torch.where(interior, torch.ones_like(covered.seen), covered.seen)


def smoothstep(values: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """0 up to 0, 1 from 1, and a smooth rise between."""
    inside = values.clamp(0, 1)
    return inside * inside * (3 - 2 * inside)


def _camera_direction(footage: Footage, frame: Frame) -> Float[Tensor, " 3"]:
    """The unit direction from the head to the frame's camera, in the head's axes."""
    face = footage.faces[frame.sequence]
    rotation, place = face.head_rotation[frame.timestep], face.head_translation[frame.timestep]
    return normalize(matrix_from_axis_angle(rotation).T @ (footage.camera(frame).position - place), dim=0)


def triangle_views(
    vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"], camera_position: Float[Tensor, " 3"]
) -> Float[Tensor, " f"]:
    """Cosine between each triangle's normal and the direction to a camera; negative if it faces away."""
    a, b, c = (vertices[faces[:, corner].long()] for corner in range(3))
    normals = normalize(torch.linalg.cross(b - a, c - a), dim=-1, eps=1e-20)
    return (normals * normalize(camera_position - (a + b + c) / 3, dim=-1)).sum(-1)


def _seen_colors(
    footage: Footage, frame: Frame, vertices: Float[Tensor, "v 3"], cut: NeckCut
) -> tuple[Float[Tensor, "f 3"], Float[Tensor, " f"], Float[Tensor, " f"]]:
    """Each triangle's colour in one picture, its weight, and whether it is above the cut at the neck (0..1).

    The weight is 0 if the triangle is hidden, faces away, or is not part of the head that is scored.
    """
    sequence, camera, faces = footage.sequences[frame.sequence], footage.camera(frame), footage.face_model.faces
    centers = vertices[faces.long()].mean(1)
    pixels, depth = camera.project(centers)
    grid = pixels / torch.tensor([camera.width, camera.height]) * 2 - 1
    picture = torch.from_numpy(np.array(sequence.capture.images[frame[1:]])).float() / 255
    mask = torch.from_numpy(footage.scoring(frame)).float()[..., None] / 255
    nearest = rasterize_mesh(vertices, faces, camera).depth[..., None].nan_to_num(posinf=1e3)
    colors, head = (sample_picture(whole, grid, "bilinear") for whole in (picture, mask))
    front = sample_picture(nearest, grid, "nearest")[:, 0]
    cosine = triangle_views(vertices, faces, camera.position)
    visible = smoothstep((front + 2 * DEPTH_TOLERANCE - depth) / DEPTH_TOLERANCE)
    hardly, well = _COVERAGE_FACING
    facing = smoothstep((cosine - hardly) / (well - hardly))
    inside = (grid.abs() < 1).all(-1) & (depth > 0)
    weight = cosine.clamp_min(0) ** 2 * facing * visible * smoothstep(2 * head[:, 0] - 1)
    corners, _ = camera.project(vertices)
    if sequence.cut == "none":
        framed = (camera.height - corners[:, 1]).clamp(0, 1)
        return colors, torch.where(inside, weight, 0.0), framed[faces.long()].amin(1)
    line = sequence.tracking.neck_lines[frame.timestep, frame.camera]
    # What is below the neck line in the picture, or below the cut in space, is not scored.
    in_space = (cut.heights(vertices) / _COVERAGE_CUT_SOFTNESS + 2).clamp(0, 1)
    above = torch.minimum((corners @ line[:2] + line[2]).clamp(0, 1), in_space)
    # All of the triangle has to be above: what hangs over the cut is scored as background.
    return colors, torch.where(inside, weight, 0.0), above[faces.long()].amin(1)
