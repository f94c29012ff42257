"""Baselines that an avatar has to beat: the mean training picture, and the tracked mesh with the person's colours."""

from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from mien.evaluation.experiment import Experiment, spread_frames, target_image
from mien.parallel import stream_in_threads
from mien.render.mesh import rasterize_mesh, render_mesh, vertex_normals
from mien.training.frames import Frame

_MAX_COLOUR_FRAMES = 60
"""Number of training frames, evenly spread, for the mean vertex colours. More frames make no visible difference."""
_DEPTH_TOLERANCE = 0.004
"""Depth in metres behind the depth picture up to which a vertex still counts as visible."""
_SMOOTHING_ROUNDS = 200


@dataclass(frozen=True, eq=False)
class Baselines:
    """Both baselines, ready to draw any frame."""

    mean_frames: dict[Frame, Float[Tensor, "h w 3"]]
    """The mean training target of each sequence and camera. The keys have timestep 0."""
    vertex_colors: Float[Tensor, "v 3"]
    """Mean colours of the vertices, 0..1."""

    def mean_frame_image(self, experiment: Experiment, frame: Frame) -> Float[Tensor, "h w 3"]:
        """The mean of the training targets of this frame's sequence and camera.

        A held-out sequence or camera has no such mean. Its image is then the mean of the same camera's pictures in
        other sequences, or else of the other cameras of the same sequence, or else of all pictures of that size.
        """
        camera, camera_id = experiment.camera(frame), experiment.camera_id(frame)
        size = (camera.height, camera.width, 3)
        known = {key: mean for key, mean in self.mean_frames.items() if mean.shape == size}
        for alike in (
            [mean for key, mean in known.items() if (key.sequence, key.camera) == (frame.sequence, frame.camera)],
            [mean for key, mean in known.items() if experiment.camera_id(key) == camera_id],
            [mean for key, mean in known.items() if key.sequence == frame.sequence],
            list(known.values()),
        ):
            if alike:
                return torch.stack(alike).mean(0)
        return torch.ones(size)

    def mesh_image(self, experiment: Experiment, frame: Frame, supersample: int = 2) -> Float[Tensor, "h w 3"]:
        """The face model posed as in a frame, with the mean vertex colours, unlit, over white."""
        face_model = experiment.avatar.face_model
        vertices = face_model(experiment.face(frame))[0]
        image, _ = render_mesh(
            vertices, face_model.faces, experiment.camera(frame), self.vertex_colors, supersample=supersample
        )
        return image.clamp(0, 1)


@torch.no_grad()
def make_baselines(experiment: Experiment, threads: int | None = None) -> Baselines:
    """Both baselines, from training frames only.

    Args:
        experiment: The experiment.
        threads: Number of frames that are read at a time; by default, MIEN_THREADS or all cores. It changes no figure.
    """
    return Baselines(_mean_frames(experiment, threads), _vertex_colors(experiment, threads))


def _mean_frames(experiment: Experiment, threads: int | None = None) -> dict[Frame, Float[Tensor, "h w 3"]]:
    sums: dict[Frame, Tensor] = {}
    counts: dict[Frame, int] = {}
    frames = experiment.training_frames
    # Sums are taken here, in the order of the frames.
    for frame, target in zip(
        frames, stream_in_threads(partial(target_image, experiment), frames, threads), strict=True
    ):
        key = frame._replace(timestep=0)
        sums[key] = sums[key].add_(target) if key in sums else target
        counts[key] = counts.get(key, 0) + 1
    return {key: total / counts[key] for key, total in sums.items()}


def _vertex_colors(experiment: Experiment, threads: int | None = None) -> Float[Tensor, "v 3"]:
    """Colours of the vertices: the mean over training frames that see the vertex, weighted by how squarely they do.

    Vertices that are never seen (the back of the head, the inside of the mouth) get the mean of their neighbours'
    colours.
    """
    face_model = experiment.avatar.face_model
    count = len(face_model.template)
    colors, weights = torch.zeros(count, 3), torch.zeros(count)

    def seen_in(frame: Frame) -> tuple[Tensor, Tensor]:
        return _seen_colors(experiment, frame, face_model(experiment.face(frame))[0], face_model.faces)

    frames = spread_frames(experiment.training_frames, _MAX_COLOUR_FRAMES)
    for seen, weight in stream_in_threads(seen_in, frames, threads):
        colors += weight[:, None] * seen
        weights += weight
    known = weights > 1e-3
    colors[known] /= weights[known, None]
    colors[~known] = colors[known].mean(0) if bool(known.any()) else 0.5
    return _spread(colors, known, face_model.faces)


def _seen_colors(
    experiment: Experiment, frame: Frame, vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"]
) -> tuple[Float[Tensor, "v 3"], Float[Tensor, " v"]]:
    """The colour of each vertex in one frame's target, and its weight: 0 if it is hidden or outside the person.

    The part of the person that the scoring mask cuts off, below the neck line, is white in the target and on the mesh.
    """
    camera = experiment.camera(frame)
    pixels, depth = camera.project(vertices)
    grid = pixels / torch.tensor([camera.width, camera.height]) * 2 - 1
    sequence = experiment.sequences[frame.sequence]
    person = torch.from_numpy(sequence.capture.mattes[frame[1:]].astype(np.float32))[..., None] / 255
    nearest = rasterize_mesh(vertices, faces, camera).depth[..., None]
    colors, alpha = (_sample(picture, grid, "bilinear") for picture in (target_image(experiment, frame), person))
    front = _sample(nearest.nan_to_num(posinf=1e3), grid, "nearest")[:, 0]
    to_camera = normalize(camera.position - vertices, dim=-1)
    facing = (vertex_normals(vertices, faces) * to_camera).sum(-1).clamp_min(0)
    inside = (grid.abs() < 1).all(-1) & (depth > 0)
    seen = inside & (depth < front + _DEPTH_TOLERANCE) & (alpha[:, 0] > 0.9)
    return colors, torch.where(seen, facing**2, torch.zeros_like(facing))


def _sample(picture: Float[Tensor, "h w c"], grid: Float[Tensor, "v 2"], mode: str) -> Float[Tensor, "v c"]:
    """Values of a picture at points in -1..1."""
    safe = grid.nan_to_num(2.0).clamp(-2, 2)[None, None]
    values = grid_sample(picture.permute(2, 0, 1)[None], safe, mode=mode, padding_mode="border", align_corners=False)
    return values[0, :, 0].T


def _spread(
    colors: Float[Tensor, "v 3"], known: Tensor, faces: Int[Tensor, "f 3"], rounds: int = _SMOOTHING_ROUNDS
) -> Float[Tensor, "v 3"]:
    """The colours with unknown ones replaced by a smooth continuation of the known ones along the mesh's edges."""
    edges = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).long()
    edges = torch.cat([edges, edges.flip(1)])
    edges = edges[~known[edges[:, 0]]]
    degree = torch.zeros(len(colors)).index_add(0, edges[:, 0], torch.ones(len(edges))).clamp_min(1)
    unknown = torch.zeros(len(colors), dtype=torch.bool)
    unknown[edges[:, 0]] = True
    for _ in range(rounds):
        means = torch.zeros_like(colors).index_add(0, edges[:, 0], colors[edges[:, 1]]) / degree[:, None]
        colors = torch.where(unknown[:, None], means, colors)
    return colors
