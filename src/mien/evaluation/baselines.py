"""Baselines that an avatar has to beat: the mean training picture, and the tracked mesh with the person's colours."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from mien.evaluation.experiment import Experiment
from mien.evaluation.trained_frames import TrainedFrames, look_at_trained
from mien.render.mesh import render_mesh
from mien.training.footage.frames import Footage, Frame
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

    def mesh_image(self, experiment: Experiment, frame: Frame, supersample: int = 2) -> Float[Tensor, "h w 3"]:
        """The face model posed as in a frame, with the mean vertex colours, unlit, over white."""
        face_model = experiment.avatar.face_model
        vertices = face_model(experiment.face(frame))[0]
        image, _ = render_mesh(
            vertices, face_model.faces, experiment.camera(frame), self.vertex_colors, supersample=supersample
        )
        return image.clamp(0, 1)


@torch.no_grad()
def make_baselines(
    experiment: Experiment, threads: int | None = None, trained: TrainedFrames | None = None
) -> Baselines:
    """Both baselines, from training frames only.

    Args:
        experiment: The experiment.
        threads: Number of frames that are read at a time; by default, MIEN_THREADS or all cores. It changes no figure.
        trained: The means of the training frames, if they are known.
    """
    model, frames = experiment.avatar.face_model, experiment.training_frames
    colors = vertex_colors(Footage(model, experiment.sequences, experiment.faces, frames), threads)
    return Baselines((trained or look_at_trained(experiment, 0, threads)).means, colors)
