"""Face parameters of held-out frames, fitted to the pictures of these very frames.

MonoGaussianAvatar (Chen et al. 2024, supplement B.4) is scored in this way: before a test frame is compared, its
expression and pose are tuned by the colour loss alone. The figure shows what the avatar can draw if its tracking is
right. It uses the pixels that are scored, so it is no figure of a prediction, and never the headline.
"""

import torch

from mien.avatar.avatar import frozen
from mien.avatar.settings import FaceTuning, Progress
from mien.evaluation.experiment import Experiment, target_image
from mien.face.params import FaceParams
from mien.render import rasterize
from mien.training.adam import Adam
from mien.training.footage.face_track import FaceTrack
from mien.training.footage.frames import Frame
from mien.training.losses import photometric_loss

LOSS = "mean absolute difference of colours over the whole picture"
_RATES = FaceTuning(within_bounds=True)
"""Learning rates for every method alike: those with which training corrects the tracking by default."""


class FittedFaces:
    """The fitted face parameters of an experiment's held-out timesteps, each computed when it is first asked for.

    A timestep starts from the face parameters of the headline. All of its held-out cameras are fitted together, since
    they show the same face. Nothing in the experiment changes, and results do not depend on the order of questions.

    Each timestep takes `steps` optimiser steps, at least 1.
    """

    def __init__(self, experiment: Experiment, steps: int):
        self._experiment = experiment
        self._steps = steps
        self._known: dict[tuple[int, int], FaceParams] = {}
        self._frames: dict[tuple[int, int], list[Frame]] = {}
        for frame in experiment.held_out_frames:
            self._frames.setdefault((frame.sequence, frame.timestep), []).append(frame)

    def face(self, frame: Frame) -> FaceParams:
        """The face parameters of one held-out frame's timestep."""
        key = (frame.sequence, frame.timestep)
        if key not in self._known:
            self._known[key] = fit_face(self._experiment, self._frames[key], self._steps)
        return self._known[key]


def fit_face(experiment: Experiment, frames: list[Frame], steps: int) -> FaceParams:
    """Expression, joints, head rotation and head translation of one timestep, after some steps of Adam.

    The loss is the mean absolute difference of colours, summed over the frames. Expression coefficients stay within the
    bounds of the face model, or where the tracking left them.

    `frames` are those of one timestep, from different cameras.
    """
    avatar = experiment.avatar
    targets = [(frame, target_image(experiment, frame)) for frame in frames]
    track = FaceTrack(experiment.face(frames[0]), _RATES, bounds=avatar.face_model.expression_bounds)
    adam = Adam()
    with torch.enable_grad(), frozen(avatar):
        for step in range(steps):
            gaussians = avatar.pose(track.face(0)).gaussians.timestep(0)
            white = torch.ones(3).to(gaussians.means)
            drawn = [(frame, rasterize(gaussians, experiment.camera(frame), white)) for frame, _ in targets]
            images = [experiment.lit(picture, white, frame).image for frame, picture in drawn]
            losses = [
                photometric_loss(image, target, l1_weight=1.0, ssim_weight=0.0)
                for image, (_, target) in zip(images, targets, strict=True)
            ]
            torch.autograd.backward(losses)
            adam.step(track.parameter_groups(0), Progress(step, steps))
            track.confine(0)
    return track.face(0).detach()
