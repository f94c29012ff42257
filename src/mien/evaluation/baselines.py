"""What an evaluation takes from training pictures: baselines that an avatar has to beat, and its figures on them.

The baselines are the mean training picture, and the tracked mesh with the person's colours.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from mien.evaluation.experiment import Experiment, avatar_image, target_image
from mien.evaluation.metrics import psnr
from mien.evaluation.scoring import as_8_bit
from mien.machine.parallel import stream_in_threads
from mien.render.mesh import render_mesh
from mien.training.footage.frames import Footage, Frame, spread_frames
from mien.training.footage.mesh_colors import vertex_colors


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

    def mesh_image(self, experiment: Experiment, frame: Frame) -> Float[Tensor, "h w 3"]:
        """The face model posed as in a frame, with the mean vertex colours, unlit, over white."""
        face_model = experiment.avatar.face_model
        vertices = face_model(experiment.face(frame))[0]
        camera = experiment.camera(frame)
        image, _ = render_mesh(vertices, face_model.faces, camera, self.vertex_colors, supersample=2)
        return image.clamp(0, 1)


@torch.no_grad()
def make_baselines(
    experiment: Experiment, threads: int | None = None, means: dict[Frame, Tensor] | None = None
) -> Baselines:
    """Both baselines, from training frames only. `means` are those of `look_at_trained`, if they are known."""
    model, frames = experiment.avatar.face_model, experiment.training_frames
    colors = vertex_colors(Footage(model, experiment.sequences, experiment.faces, frames), threads)
    return Baselines(look_at_trained(experiment, 0, threads)[0] if means is None else means, colors)


@torch.no_grad()
def look_at_trained(
    experiment: Experiment, scored: int, threads: int | None = None, *, mean: bool = True
) -> tuple[dict[Frame, Float[Tensor, "h w 3"]], dict[Frame, tuple[float, float]]]:
    """The mean target of each sequence and camera (at timestep 0), and PSNR on frame and head crop of some frames.

    The avatar is scored on at most `scored` evenly spread frames, and all are read for the `mean` target. `threads`
    change no figure.
    """
    every = experiment.training_frames
    judged = spread_frames(every, scored) if scored else []
    chosen = set(judged)

    def jobs() -> Iterator[tuple[Frame, Tensor | None]]:
        # Rendering runs here, frame by frame; all else runs in threads.
        for frame in every if mean else judged:
            yield frame, avatar_image(experiment, frame) if frame in chosen else None

    def look(job: tuple[Frame, Tensor | None]) -> tuple[Frame, Tensor, tuple[float, float] | None]:
        frame, drawn = job
        target = target_image(experiment, frame)
        if drawn is None:
            return frame, target, None
        image = as_8_bit(drawn)
        return frame, target, (psnr(image, target), psnr(image, target, experiment.crop(frame)))

    sums: dict[Frame, Tensor] = {}
    counts: dict[Frame, int] = {}
    figures: dict[Frame, tuple[float, float]] = {}
    # Sums are taken here, in the order of the frames.
    for frame, target, found in stream_in_threads(look, jobs(), threads):
        if found is not None:
            figures[frame] = found
        if mean:
            key = frame._replace(timestep=0)
            sums[key] = sums[key].add_(target) if key in sums else target
            counts[key] = counts.get(key, 0) + 1
    return {key: total / counts[key] for key, total in sums.items()}, figures
