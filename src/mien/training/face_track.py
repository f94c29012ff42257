"""FaceTrack: the face parameters of all timesteps as training sees them, tuned frame by frame where asked for."""

from dataclasses import replace

import torch
from torch import Tensor

from mien.avatar import FaceTuning, Moments, ParameterGroup
from mien.face import FaceParams

_FIELDS = ("expression", "joints", "head_rotation", "head_translation")


class FaceTrack:
    """One tensor per field, indexed by timestep, that starts from the tracking; with the optimiser's state.

    Each timestep has its own moments and step counts, and only the timestep of a step moves.
    """

    def __init__(self, face: FaceParams, tuning: FaceTuning):
        self._start = face.detach()
        self._tuning = tuning
        self._fields = {name: getattr(self._start, name).clone() for name in _FIELDS}
        names = _FIELDS if tuning.enabled else ()
        self._moments = {name: Moments.zeros(self._fields[name]) for name in names}
        for name, moments in self._moments.items():
            moments.step = self._fields[name].new_zeros(len(face))

    def face(self, index: int) -> FaceParams:
        """One timestep; where tuning is on, its tensors are leaves that share memory with the track."""
        rows = {name: tensor[index : index + 1] for name, tensor in self._fields.items()}
        if self._tuning.enabled:
            rows = {name: row.detach().requires_grad_() for name, row in rows.items()}
        return replace(self._start, **rows)

    def parameter_groups(self, face: FaceParams, index: int) -> list[ParameterGroup]:
        """The groups of one timestep, for the `face` that `face(index)` returned and that was used since."""
        groups = []
        for name, state in self._moments.items():
            row = Moments(state.first[index : index + 1], state.second[index : index + 1], state.step[index])
            rate = getattr(self._tuning, name)
            groups.append(ParameterGroup(f"face.{name}", {name: getattr(face, name)}, rate, {name: row}))
        return groups

    def params(self) -> FaceParams:
        """All timesteps as they are now."""
        return replace(self._start, **{name: tensor.clone() for name, tensor in self._fields.items()})

    def state(self) -> dict[str, Tensor]:
        """What a checkpoint has to keep; the tensors are the track's own."""
        state = {name: self._fields[name] for name in self._moments}
        for name, moments in self._moments.items():
            state |= {f"{name}.first": moments.first, f"{name}.second": moments.second, f"{name}.step": moments.step}
        return state

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Go on from what `state` returned."""
        for name, own in self.state().items():
            with torch.no_grad():
                own.copy_(state[name])
