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


def fit_face(experiment: Experiment, frames: list[Frame], steps: int) -> FaceParams:
    """Expression, joints, head rotation and head translation of one timestep, after some steps of Adam.

    `frames` are those of one timestep, from different cameras, and are fitted together. The start are the face
    parameters of the headline. The loss is the mean absolute difference of colours, summed over the frames. Expression
    coefficients stay within the bounds of the face model, or where the tracking left them.
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
