"""Flicker of landmarks: a detector that crops each picture by its last answer can swing between two answers.

If nothing moves, the crop of the next picture depends on the last answer and the answer on the crop, so landmarks may
go to and fro for ever. No part of a face does that: none moves up in one frame and down in the next, again and again.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

_SWING = 0.3
"""Largest ratio of squared motion over two frames to the sum of both squared single-frame motions that counts as a
swing. The ratio is 0 for a swing, 0.5 for noise and 2 for steady motion."""
_LEAST_RUN = 4
"""Fewest frames in a row that swing. A blink is a single swing and is kept."""


def without_flicker(landmarks: Float[Tensor, "t c l 2"], seen: Bool[Tensor, "t c"]) -> Float[Tensor, "t c l 2"]:
    """Return the landmarks, with the mean of both answers wherever they swing for several frames.

    Args:
        landmarks: Landmarks in pixels; any value where not seen.
        seen: Whether the camera found a face.
    """
    if len(landmarks) < _LEAST_RUN + 2:
        return landmarks
    steps = (landmarks[1:] - landmarks[:-1]).square().sum((-1, -2))
    across = (landmarks[2:] - landmarks[:-2]).square().sum((-1, -2))
    swings = torch.zeros_like(seen)
    swings[1:-1] = across < _SWING * (steps[1:] + steps[:-1])  # False for NaN
    swings[1:-1] &= seen[:-2] & seen[1:-1] & seen[2:]
    runs = _of_runs(swings)
    # The frames at both ends of a run swing too, but with only one of their neighbours.
    linked = (runs[:-1] | runs[1:])[..., None, None]
    forward = torch.where(linked, landmarks[1:] - landmarks[:-1], 0.0)
    towards, neighbours = torch.zeros_like(landmarks), torch.zeros_like(landmarks[:, :, :1, :1])
    towards[:-1] += forward
    towards[1:] -= forward
    neighbours[:-1] += linked
    neighbours[1:] += linked
    return landmarks + towards / (2 * neighbours.clamp_min(1))


def _of_runs(swings: Bool[Tensor, "t c"]) -> Bool[Tensor, "t c"]:
    """Which swings belong to a run of at least `_LEAST_RUN` frames."""
    whole = swings.unfold(0, _LEAST_RUN, 1).all(-1)
    kept = torch.zeros_like(swings)
    for shift in range(_LEAST_RUN):
        kept[shift : shift + len(whole)] |= whole
    return kept
