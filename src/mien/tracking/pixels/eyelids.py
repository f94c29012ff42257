"""Eyelids placed from the pictures. This finds blinks that a landmark detector misses, above all behind glasses.

Skin is tracked by its texture, but the texture does not include what the lids uncover. So each picture decides on its
own which position of the lids explains it best: every pixel that the lids may cover looks like this person's eyeball
or like the skin around the eye (`EyeColors`). This is weighed against the lids of the fit, which are right within a few
hundredths of a blink, or altogether wrong. Nothing is smoothed over time, and nothing assumes that anybody
blinks: the usual position of the lids comes from the fit, and the closed position from the model.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mien.camera import Camera
from mien.machine.parallel import map_in_threads
from mien.tracking.fitting.fit import Fit, SequenceFit
from mien.tracking.fitting.sequence import SequenceData
from mien.tracking.landmarks.model import LandmarkModel
from mien.tracking.pixels.eye_colors import EyeCrop, eye_crop, learn_colors
from mien.tracking.pixels.eyes import Eye, eyes_of

_POSITION_RANGE = (-0.4, 1.2)
"""First and last of the positions of the lids that are tried: 0 is at rest, 1 is closed, below 0 is wider open than at
rest."""
_POSITIONS = 13  # number of these positions
_EDGE_BAND = 4  # width of the lashes and the edge of the upper lid, in positions
_FINE_STEP = 0.01  # step of the fine positions to which costs are interpolated
_COST_BLUR = 0.08  # standard deviation of the kernel that smooths the costs, in positions' units
_COST_DIVISOR = 8.0  # divisor of the costs, because errors of neighbouring pixels are correlated
_DISAGREEMENT = 0.07
"""Largest upper quartile, over the frames, of the cost of the fit's lids above the best one, as a share of the range of
costs. If it is larger, the colours are misleading and count less. Measured: d3, where they mislead, has 0.12 to 0.14,
and all other clips up to 0.05 (log)."""
_FIT_SIGMA = 0.12  # standard deviation of the lids of a good fit. Chosen with the shape of the cost (log) alone
_OFFSET_SIGMA = 0.4
"""Wider standard deviation of the fit's lids, for the estimate of the usual offset between colours and fit."""
_LEARNING_PICTURES = 100  # largest number of pictures that colours are learned from
_LEAST_FACING = 0.35  # smallest cosine between an eye's direction and the direction to the camera


def place_lids(model: LandmarkModel, sequences: Sequence[SequenceData], fit: Fit, weight: float) -> Fit:
    """Return the fit with the lids placed from the pictures, which weigh 1 against the fit as measured, or 0 for none.

    Lids stay as they are if the model cannot close them or the eyes are too small in the pictures.
    """
    eyes = eyes_of(model.face_model.to(torch.zeros(())), model.layout) if weight > 0 else []
    if not eyes:
        return fit
    placed = [
        replace(sequence, state=_place(_Sequence(model, data, fit, sequence, eyes), weight))
        for data, sequence in zip(sequences, fit.sequences, strict=True)
    ]
    return replace(fit, sequences=tuple(placed))


class _Sequence:
    """The pictures of one sequence and its fit so far."""

    def __init__(self, model: LandmarkModel, data: SequenceData, fit: Fit, own: SequenceFit, eyes: Sequence[Eye]):
        self.model, self.data, self.fit, self.own, self.eyes = model, data, fit, own, eyes
        self.face_model = model.face_model.to(torch.zeros(()))
        self.timesteps = data.timesteps.tolist()

    def crops(self, row: int, positions: list[float]) -> list[EyeCrop | None]:
        """The crop of each eye, in the picture of the camera that the eye faces most directly."""
        columns = [eye.column for eye in self.eyes]
        states = self.own.state[[row, row]].clone()
        states[0, columns], states[1, columns] = 0.0, states.new_tensor([eye.closed for eye in self.eyes])
        face = self.model.layout.face_params(states, self.fit.subject.identity)
        face = replace(face.to(self.face_model.template), vertex_offsets=self.fit.subject.vertex_offsets)
        vertices, turn = self.face_model(face), face.T_world_head[0, :3, :3]
        return [self._crop(eye, row, vertices[:, eye.vertices], turn @ eye.forward, positions) for eye in self.eyes]

    def _crop(
        self,
        eye: Eye,
        row: int,
        corners: Float[Tensor, "2 n 3"],
        forward: Float[Tensor, " 3"],
        positions: list[float],
    ) -> EyeCrop | None:
        middle = corners[0].mean(0)
        capture, best, facing = self.data.capture, None, _LEAST_FACING
        for index in self.data.views.seen_by(row):
            K, viewmat = self.own.cameras.K[index].float(), self.own.cameras.viewmat[index].float()
            camera = Camera(K, viewmat, capture.width, capture.height)
            towards = camera.position - middle
            cosine = float(forward @ towards / towards.norm())
            if cosine > facing:
                best, facing = (index, camera), cosine
        if best is None:
            return None
        picture = np.asarray(capture.images[self.timesteps[row], best[0]])
        tracked = float(self.own.state[row, eye.column]) / eye.closed
        return eye_crop(eye, picture, best[1], corners, tracked, positions)


def _place(sequence: _Sequence, weight: float) -> Float[Tensor, "v p"]:
    state, positions = sequence.own.state.clone(), np.linspace(*_POSITION_RANGE, _POSITIONS).tolist()
    several = torch.linspace(0, len(state) - 1, min(_LEARNING_PICTURES, len(state))).round().long().unique()
    learned = map_in_threads(lambda row: sequence.crops(row, positions[:1]), several.tolist())
    colors = [learn_colors([crop for crop in of_eye if crop is not None]) for of_eye in zip(*learned, strict=True)]

    def costs_of(row: int) -> list[Float[np.ndarray, " k"] | None]:
        pairs = zip(sequence.crops(row, positions), colors, strict=True)
        return [None if crop is None or of_eye is None else of_eye.costs(crop, _EDGE_BAND) for crop, of_eye in pairs]

    rows = map_in_threads(costs_of, list(range(len(state))))
    for eye, of_eye in zip(sequence.eyes, zip(*rows, strict=True), strict=True):
        seen = torch.tensor([cost is not None for cost in of_eye])
        if seen.sum() >= 10:  # fewest pictures that must show an eye for its lids to be placed
            costs = np.stack([cost for cost in of_eye if cost is not None])
            before = state[seen, eye.column].numpy() / eye.closed
            state[seen, eye.column] = torch.from_numpy(weigh_positions(costs, before, weight)) * eye.closed
    return sequence.model.layout.bounds.clip(state)


def weigh_positions(
    costs: Float[np.ndarray, "n k"], tracked: Float[np.ndarray, " n"], weight: float
) -> Float[np.ndarray, " n"]:
    """The positions of the lids in n frames that best suit both the costs of k positions and the tracked positions.

    If the colours place the lids too open or too closed in most frames, the fit corrects them. The correction is full
    at the usual position and vanishes where the lids meet. If the colours contradict the fit in many frames, they count
    for little in all frames.
    """
    positions = np.linspace(*_POSITION_RANGE, _POSITIONS)
    fine = np.arange(positions[0], positions[-1] + _FINE_STEP / 2, _FINE_STEP)
    near = np.exp(-0.5 * ((fine[:, None] - positions) / _COST_BLUR) ** 2)
    costs = costs @ (near / near.sum(1, keepdims=True)).T
    at = np.round((tracked - fine[0]) / _FINE_STEP).astype(int).clip(0, len(fine) - 1)
    above = (costs[np.arange(len(costs)), at] - costs.min(1)) / np.ptp(costs, axis=1).clip(1e-9)
    costs = costs * (weight / _COST_DIVISOR / max(1.0, float(np.quantile(above, 0.75)) / _DISAGREEMENT) ** 4)

    usual = np.median(tracked)
    often = tracked < usual + 0.1
    middle = fine[(costs + 0.5 * ((fine - tracked[:, None]) / _OFFSET_SIGMA) ** 2).argmin(1)]
    shift = np.median((middle - tracked)[often])
    share = ((1 - fine) / max(1 - np.median(tracked[often]), 0.3)).clip(0, 1.2)
    # If the most open position is the best one, the pixels do not show an eye but hair, a brow or a hand.
    costs[costs[:, 0] <= costs.min(1)] = 0
    corrected = fine - shift * share
    far = np.log1p(((corrected - tracked[:, None]) / _FIT_SIGMA) ** 2)
    return corrected[(costs + far).argmin(1)]
