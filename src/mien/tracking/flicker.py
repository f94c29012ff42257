"""Landmarks that swing between two answers: what a detector does that starts from where it saw the face last.

Where nothing moves, its crop of the next picture depends on its last answer and that on the crop, and it may go to and
fro for ever. A face does not: nothing of it moves up in one frame and down in the next, again and again.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

_SWING = 0.3
"""Squared way between frames two apart, of that between neighbours: 0 for swings, 0.5 for noise, 2 for motion."""
_LEAST_RUN = 4
"""Frames in a row that swing; a blink is one."""


def without_flicker(landmarks: Float[Tensor, "t c l 2"], seen: Bool[Tensor, "t c"]) -> Float[Tensor, "t c l 2"]:
    """The same with frames of longer swings replaced by the mean of both answers.

    Args:
        landmarks: Pixels; of any value where not seen.
        seen: Whether the camera found a face.
    """
    if len(landmarks) < _LEAST_RUN + 2:
        return landmarks
    steps = (landmarks[1:] - landmarks[:-1]).square().sum((-1, -2))
    across = (landmarks[2:] - landmarks[:-2]).square().sum((-1, -2))
    swings = torch.zeros_like(seen)
    swings[1:-1] = across < _SWING * (steps[1:] + steps[:-1])  # not a number is no swing
    swings[1:-1] &= seen[:-2] & seen[1:-1] & seen[2:]
    runs = _of_runs(swings)
    # The ends of a run swing as well, but have one neighbour only that does.
    linked = (runs[:-1] | runs[1:])[..., None, None]
    forward = torch.where(linked, landmarks[1:] - landmarks[:-1], 0.0)
    towards, neighbours = torch.zeros_like(landmarks), torch.zeros_like(landmarks[:, :, :1, :1])
    towards[:-1] += forward
    towards[1:] -= forward
    neighbours[:-1] += linked
    neighbours[1:] += linked
    return landmarks + towards / (2 * neighbours.clamp_min(1))


def _of_runs(swings: Bool[Tensor, "t c"]) -> Bool[Tensor, "t c"]:
    """Which of them are in runs that are long enough."""
    whole = swings.unfold(0, _LEAST_RUN, 1).all(-1)
    kept = torch.zeros_like(swings)
    for shift in range(_LEAST_RUN):
        kept[shift : shift + len(whole)] |= whole
    return kept
