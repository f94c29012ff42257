"""Groups of MediaPipe's 478 landmarks, and the weight of each landmark in a fit."""

import torch
from jaxtyping import Float
from torch import Tensor

from mien.capture.person.faces import IBUG68, LANDMARKS
from mien.tracking.settings import LandmarkSet

OVAL = (
    10, 21, 54, 58, 67, 93, 103, 109, 127, 132, 136, 148, 149, 150, 152, 162, 172, 176, 234, 251, 284, 288, 297, 323,
    332, 338, 356, 361, 365, 377, 378, 379, 389, 397, 400, 454,
)  # fmt: skip
"""The outline of the face. It is a silhouette that slides over the skin, so it says little about any one point."""
LIPS = (
    0, 13, 14, 17, 37, 39, 40, 61, 78, 80, 81, 82, 84, 87, 88, 91, 95, 146, 178, 181, 185, 191, 267, 269, 270, 291, 308,
    310, 311, 312, 314, 317, 318, 321, 324, 375, 402, 405, 409, 415,
)  # fmt: skip
LEFT_EYELIDS = (249, 263, 362, 373, 374, 380, 381, 382, 384, 385, 386, 387, 388, 390, 398, 466)
RIGHT_EYELIDS = (7, 33, 133, 144, 145, 153, 154, 155, 157, 158, 159, 160, 161, 163, 173, 246)
LEFT_LID_PAIRS, RIGHT_LID_PAIRS = ((386, 374), (385, 380), (387, 373)), ((159, 145), (158, 153), (160, 144))
"""Pairs of landmarks across the opening of an eye: upper lid, lower lid."""
BROWS = (46, 52, 53, 55, 63, 65, 66, 70, 105, 107, 276, 282, 283, 285, 293, 295, 296, 300, 334, 336)
NOSE = (1, 2, 4, 5, 6, 19, 45, 48, 64, 94, 97, 98, 115, 168, 195, 197, 220, 275, 278, 294, 326, 327, 344, 440)
EYE_CORNERS = (33, 133, 263, 362)
RIGHT_IRIS = (468, 469, 470, 471, 472)
"""The centre, then the rim, of the subject's right iris."""
LEFT_IRIS = (473, 474, 475, 476, 477)


def landmark_weights(landmarks: LandmarkSet = "mediapipe") -> Float[Tensor, " l"]:
    """Weight of each landmark in a fit. It is 0 for landmarks outside the set, and the mean is 1."""
    weights = torch.ones(LANDMARKS, dtype=torch.float64)
    for group, weight in (
        (OVAL, 0.15),  # weight of landmarks on the face's outline, where that of a landmark of the cheeks is 1
        (NOSE, 3.0),  # the same of the nose
        (LIPS, 3.0),  # the same of the lips
        (LEFT_EYELIDS + RIGHT_EYELIDS, 5.0),  # the same of the eyelids
        (LEFT_IRIS + RIGHT_IRIS, 4.0),  # the same of the irises
    ):
        weights[list(group)] = weight
    if landmarks == "ibug51":
        left_out = torch.ones(LANDMARKS, dtype=torch.bool)
        left_out[list(IBUG68[17:] + LEFT_IRIS + RIGHT_IRIS)] = False
        weights[left_out] = 0
    return weights / weights.mean()


def rigid_weights() -> Float[Tensor, " l"]:
    """Weight of each landmark in a fit of the head pose alone: 0 for those that expressions move. The mean is 1."""
    weights = torch.zeros(LANDMARKS, dtype=torch.float64)
    weights[list(NOSE + EYE_CORNERS)] = 1.0
    weights[list(OVAL)] = 0.05
    return weights / weights.mean()
