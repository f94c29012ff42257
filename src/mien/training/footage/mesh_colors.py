"""Mean colours of the tracked mesh's vertices in the training pictures: first colours of an avatar, and a baseline."""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from mien.machine.parallel import stream_in_threads
from mien.render.mesh import rasterize_mesh, sample_picture, vertex_normals
from mien.training.footage.frames import Footage, Frame, spread_frames
from mien.training.footage.sequence import composite

DEPTH_TOLERANCE = 0.004  # depth in metres behind the nearest surface up to which something counts as visible
_COLOR_FRAMES = 60  # number of evenly spread frames for the mean vertex colours. More make no visible difference
_COLOR_SPREAD_ROUNDS = 200  # number of times that unknown colours are averaged over neighbours


@torch.no_grad()
def vertex_colors(footage: Footage, threads: int | None = None) -> Float[Tensor, "v 3"]:
    """Colours of the vertices: the mean over frames that see the vertex, weighted by how squarely they do.

    At most 60 frames are used, evenly spread. Vertices that are never seen (the back of the head, the inside of the
    mouth) get the mean of their neighbours' colours. The number of threads changes no bit.
    """
    face_model = footage.face_model
    count = len(face_model.template)
    colors, weights = torch.zeros(count, 3), torch.zeros(count)

    def seen_in(frame: Frame) -> tuple[Tensor, Tensor]:
        return _seen_colors(footage, frame)

    for seen, weight in stream_in_threads(seen_in, spread_frames(footage.frames, _COLOR_FRAMES), threads):
        colors += weight[:, None] * seen
        weights += weight
    known = weights > 1e-3
    colors[known] /= weights[known, None]
    colors[~known] = colors[known].mean(0) if bool(known.any()) else 0.5
    return _spread(colors, known, face_model.faces)


def _seen_colors(footage: Footage, frame: Frame) -> tuple[Float[Tensor, "v 3"], Float[Tensor, " v"]]:
    """The colour of each vertex in one frame's target, and its weight: 0 if it is hidden or outside the person.

    The part of the person that the scoring mask cuts off, below the neck, is white in the target and on the mesh.
    """
    vertices, faces, camera = footage.vertices(frame), footage.face_model.faces, footage.camera(frame)
    pixels, depth = camera.project(vertices)
    grid = pixels / torch.tensor([camera.width, camera.height]) * 2 - 1
    picture = np.asarray(footage.sequences[frame.sequence].capture.images[frame[1:]])
    target = torch.from_numpy(composite(picture, footage.scoring(frame), np.full(3, 255, np.uint8))).float() / 255
    person = torch.from_numpy(footage.matte(frame).astype(np.float32))[..., None] / 255
    nearest = rasterize_mesh(vertices, faces, camera).depth[..., None]
    colors, alpha = (sample_picture(picture, grid, "bilinear") for picture in (target, person))
    front = sample_picture(nearest.nan_to_num(posinf=1e3), grid, "nearest")[:, 0]
    to_camera = normalize(camera.position - vertices, dim=-1)
    facing = (vertex_normals(vertices, faces) * to_camera).sum(-1).clamp_min(0)
    inside = (grid.abs() < 1).all(-1) & (depth > 0)
    seen = inside & (depth < front + DEPTH_TOLERANCE) & (alpha[:, 0] > 0.9)
    return colors, torch.where(seen, facing**2, torch.zeros_like(facing))


def _spread(colors: Float[Tensor, "v 3"], known: Tensor, faces: Int[Tensor, "f 3"]) -> Float[Tensor, "v 3"]:
    """The colours with unknown ones replaced by a smooth continuation of the known ones along the mesh's edges."""
    edges = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).long()
    edges = torch.cat([edges, edges.flip(1)])
    edges = edges[~known[edges[:, 0]]]
    degree = torch.zeros(len(colors)).index_add(0, edges[:, 0], torch.ones(len(edges))).clamp_min(1)
    unknown = torch.zeros(len(colors), dtype=torch.bool)
    unknown[edges[:, 0]] = True
    for _ in range(_COLOR_SPREAD_ROUNDS):
        means = torch.zeros_like(colors).index_add(0, edges[:, 0], colors[edges[:, 1]]) / degree[:, None]
        colors = torch.where(unknown[:, None], means, colors)
    return colors
