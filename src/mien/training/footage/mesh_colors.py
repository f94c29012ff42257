"""Mean colours of the tracked mesh's vertices in the training pictures: first colours of an avatar, and a baseline."""

from collections.abc import Sequence as Items

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.machine.parallel import stream_in_threads
from mien.render.mesh import rasterize_mesh, vertex_normals
from mien.training.footage.frames import Frame, spread_frames
from mien.training.footage.sequence import Sequence, composite

DEPTH_TOLERANCE = 0.004  # depth in metres behind the nearest surface up to which something counts as visible
_COLOR_FRAMES = 60  # number of evenly spread frames for the mean vertex colours. More make no visible difference
_COLOR_SPREAD_ROUNDS = 200  # number of times that unknown colours are averaged over neighbours


@torch.no_grad()
def vertex_colors(
    face_model: FaceModel,
    sequences: Items[Sequence],
    faces: Items[FaceParams],
    frames: Items[Frame],
    threads: int | None = None,
) -> Float[Tensor, "v 3"]:
    """Colours of the vertices: the mean over frames that see the vertex, weighted by how squarely they do.

    Vertices that are never seen (the back of the head, the inside of the mouth) get the mean of their neighbours'
    colours.

    Args:
        face_model: The face model, float32 on the CPU.
        sequences: The sequences that the frames count in.
        faces: Face parameters of each sequence, with all its timesteps.
        frames: The frames to look at. At most 60 of them, evenly spread, are used.
        threads: Number of frames that are read at a time; by default, MIEN_THREADS or all cores. It changes no bit.
    """
    count = len(face_model.template)
    colors, weights = torch.zeros(count, 3), torch.zeros(count)

    def seen_in(frame: Frame) -> tuple[Tensor, Tensor]:
        vertices = face_model(faces[frame.sequence][frame.timestep])[0]
        return _seen_colors(sequences[frame.sequence], frame, vertices, face_model.faces)

    for seen, weight in stream_in_threads(seen_in, spread_frames(frames, _COLOR_FRAMES), threads):
        colors += weight[:, None] * seen
        weights += weight
    known = weights > 1e-3
    colors[known] /= weights[known, None]
    colors[~known] = colors[known].mean(0) if bool(known.any()) else 0.5
    return _spread(colors, known, face_model.faces)


def _seen_colors(
    sequence: Sequence, frame: Frame, vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"]
) -> tuple[Float[Tensor, "v 3"], Float[Tensor, " v"]]:
    """The colour of each vertex in one frame's target, and its weight: 0 if it is hidden or outside the person.

    The part of the person that the scoring mask cuts off, below the neck, is white in the target and on the mesh.
    """
    camera = sequence.tracking.cameras[frame.camera]
    pixels, depth = camera.project(vertices)
    grid = pixels / torch.tensor([camera.width, camera.height]) * 2 - 1
    picture, mask = np.asarray(sequence.capture.images[frame[1:]]), np.asarray(sequence.scoring[frame[1:]])
    target = torch.from_numpy(composite(picture, mask, np.full(3, 255, np.uint8))).float() / 255
    person = torch.from_numpy(sequence.capture.mattes[frame[1:]].astype(np.float32))[..., None] / 255
    nearest = rasterize_mesh(vertices, faces, camera).depth[..., None]
    colors, alpha = (sample_picture(picture, grid, "bilinear") for picture in (target, person))
    front = sample_picture(nearest.nan_to_num(posinf=1e3), grid, "nearest")[:, 0]
    to_camera = normalize(camera.position - vertices, dim=-1)
    facing = (vertex_normals(vertices, faces) * to_camera).sum(-1).clamp_min(0)
    inside = (grid.abs() < 1).all(-1) & (depth > 0)
    seen = inside & (depth < front + DEPTH_TOLERANCE) & (alpha[:, 0] > 0.9)
    return colors, torch.where(seen, facing**2, torch.zeros_like(facing))


def sample_picture(picture: Float[Tensor, "h w c"], grid: Float[Tensor, "v 2"], mode: str) -> Float[Tensor, "v c"]:
    """Values of a picture at points in -1..1."""
    safe = grid.nan_to_num(2.0).clamp(-2, 2)[None, None]
    values = grid_sample(picture.permute(2, 0, 1)[None], safe, mode=mode, padding_mode="border", align_corners=False)
    return values[0, :, 0].T


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
