"""Trained features of pictures: ST-LPIPS, which scores pictures, and the features of another trunk, for training.

What is scored is never trained: the distance of the scores uses an AlexNet, the loss of training a VGG.
"""

from mien.perceptual.distance import MIN_SIDE, PerceptualDistance, load_perceptual
from mien.perceptual.features import TrainingFeatures, load_training_features
from mien.perceptual.weights import Backbone

__all__ = [
    "MIN_SIDE",
    "Backbone",
    "PerceptualDistance",
    "TrainingFeatures",
    "load_perceptual",
    "load_training_features",
]
