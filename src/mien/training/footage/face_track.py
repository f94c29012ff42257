"""FaceTrack: the face parameters of all timesteps during training, tuned frame by frame if settings ask for it."""

from collections.abc import Sequence as Items
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mien.avatar.avatar import ParameterGroup
from mien.avatar.settings import FaceTuning, Rate
from mien.avatar.store import Moments
from mien.face.params import FaceParams
from mien.machine.devices import upload
from mien.rotation import align_centered, axis_angle_from_matrix, matrix_from_axis_angle

_STILL_TURNS = 0.02
"""Standard deviation of a head's turns at which half of what follows them is removed, in radians. Less is removed of
what follows smaller turns, which explain less. Measured: 0 is as good on three clips that turn (log, 11-26); it would
take all corrections from a head that hardly turns."""

_FIELDS = ("expression", "joints", "head_rotation", "head_translation")


class FaceTrack:
    """One tensor per field, indexed by timestep, with the optimiser's state. The tensors start from the tracking.

    Each timestep has its own moments and step counts. A step changes only its own timestep. `face` has all timesteps of
    all sequences, one after the other, with `lengths` timesteps each. `trained` are the indices of those that training
    uses (default: all), and `away` is `turns_from_mean`, which would wait for a GPU.
    """

    def __init__(
        self,
        face: FaceParams,
        tuning: FaceTuning,
        lengths: Items[int] = (),
        bounds: Float[Tensor, "e 2"] | None = None,
        away: Float[Tensor, "t 3"] | None = None,
        trained: Items[int] | None = None,
    ):
        self._start = face.detach()
        self._bounds = None
        if tuning.enabled and tuning.within_bounds and bounds is not None:
            low, high = bounds.to(self._start.expression).unbind(-1)
            self._bounds = self._start.expression.minimum(low), self._start.expression.maximum(high)
        self._lengths = tuple(lengths) or (len(face),)
        assert sum(self._lengths) == len(face), "timesteps of the sequences"
        self._tuning = tuning
        self._fields = {name: getattr(self._start, name).clone() for name in _FIELDS}
        self._trained = list(range(len(face)) if trained is None else trained)
        self._away = turns_from_mean(self._start, self._trained) if away is None else away
        self._sequence = torch.arange(len(self._lengths)).repeat_interleave(torch.tensor(self._lengths))
        self._rows: dict[int, tuple[FaceParams, list[ParameterGroup]]] = {}
        names = _FIELDS if tuning.enabled else ()
        self._moments = {name: Moments.zeros(self._fields[name]) for name in names}
        for moments in self._moments.values():
            # Step counts stay on the CPU: numbers computed from them are needed there.
            moments.step = torch.zeros(len(face))

    def index_of(self, sequence: int, timestep: int) -> int:
        """The index, in the track, of a timestep of a sequence."""
        return sum(self._lengths[:sequence]) + timestep

    def face(self, index: int) -> FaceParams:
        """One timestep. With tuning, its tensors are leaves that share memory with the track."""
        return self._row(index)[0]

    def trained_face(self) -> FaceParams:
        """The timesteps that training uses, as they were tracked."""
        return self._start[self._trained]

    def parameter_groups(self, index: int) -> list[ParameterGroup]:
        """The parameter groups of one timestep. Their tensors are those of `face(index)`."""
        return self._row(index)[1]

    def confine(self, index: int) -> None:
        """Bring the expression of one timestep back within its bounds, if settings ask for it."""
        if self._bounds is not None:
            low, high = (bound[index] for bound in self._bounds)
            self._fields["expression"][index].clamp_(low, high)

    @torch.no_grad()
    def steady_pose(self) -> None:
        """Remove from the corrections of head poses what the settings do not allow.

        That is their mean over all timesteps that were tuned, and what is linear in the head's turns. Only the sum of
        Gaussians and poses shows in the pictures of one camera, so both could move together, and a head that is too
        deep could turn less. Timesteps that training does not use lose the same, but decide nothing of it.
        """
        tuning, seen = self._tuning, self._seen()
        if not (tuning.enabled and (tuning.keep_mean_pose or tuning.keep_turns) and bool(seen.any())):
            return
        rows = upload(seen.nonzero()[:, 0], self._start.expression)  # A mask would make a GPU wait.
        start, now = self._start[rows], replace(self._start, **self._fields)[rows]
        corrections = pose_corrections(start, now)
        trained = torch.zeros_like(seen).index_fill(0, torch.tensor(self._trained, dtype=torch.long), True)[seen]
        known = trained if bool(trained.any()) else torch.ones_like(trained)
        if tuning.keep_turns:
            corrections = without_turns(corrections, self._away[seen], self._sequence[seen], known)
        if tuning.keep_mean_pose:
            corrections = corrections - corrections[upload(known.nonzero()[:, 0], corrections)].mean(0)
        steady = corrected_poses(start, corrections)
        self._fields["head_rotation"].index_copy_(0, rows, steady.head_rotation)
        self._fields["head_translation"].index_copy_(0, rows, steady.head_translation)

    def _row(self, index: int) -> tuple[FaceParams, list[ParameterGroup]]:
        # Cached, because a dozen views would otherwise be made in every step. The track's tensors are never replaced.
        if index not in self._rows:
            rows = {name: tensor[index : index + 1] for name, tensor in self._fields.items()}
            if self._tuning.enabled:
                rows = {name: row.detach().requires_grad_() for name, row in rows.items()}
            groups = []
            for name, state in self._moments.items():
                row = Moments(state.first[index : index + 1], state.second[index : index + 1], state.step[index])
                rate, begin = Rate(getattr(self._tuning, name)), self._tuning.begin
                groups.append(ParameterGroup(f"face.{name}", {name: rows[name]}, rate, {name: row}, begin=begin))
            self._rows[index] = replace(self._start, **rows), groups
        return self._rows[index]

    def params(self) -> FaceParams:
        """The current parameters of all timesteps. Timesteps without training get corrections from their neighbours.

        Errors of the tracking (depth, a tilt of the head) change slowly. A held-out timestep therefore gets its
        sequence's corrections: linear between the nearest trained timesteps, and constant before the first and after
        the last. A sequence without any trained timestep gets the mean correction of the head's pose
        (`mean_pose_correction`). This uses no pixel of a held-out frame.
        """
        fields = {name: tensor.clone() for name, tensor in self._fields.items()}
        ends = np.cumsum(self._lengths).tolist()
        parts = [slice(end - length, end) for end, length in zip(ends, self._lengths, strict=True)]
        for name, state in self._moments.items():
            for part in parts:
                spread_corrections(fields[name][part], getattr(self._start, name)[part], state.step[part] > 0)
        face = replace(self._start, **fields)
        seen = self._seen()
        if not bool(seen.any()):
            return face
        rotation, translation = mean_pose_correction(self._start[seen], face[seen])
        for part in parts:
            if not bool(seen[part].any()):
                pose = self._start.T_world_head[part]
                fields["head_translation"][part] += pose[:, :3, :3] @ translation
                fields["head_rotation"][part] = axis_angle_from_matrix(pose[:, :3, :3] @ rotation)
        return replace(self._start, **fields)

    def _seen(self) -> Bool[Tensor, " t"]:
        """Return which timesteps training has changed. Every field counts, as one with a rate of 0 has no steps."""
        seen = torch.zeros(len(self._start), dtype=torch.bool)
        for moments in self._moments.values():
            seen |= moments.step > 0
        return seen

    def state(self) -> dict[str, Tensor]:
        """Tensors that a checkpoint has to save. They share memory with the track."""
        state = {name: self._fields[name] for name in self._moments}
        for name, moments in self._moments.items():
            state |= {f"{name}.first": moments.first, f"{name}.second": moments.second, f"{name}.step": moments.step}
        return state

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Restore what `state` returned."""
        for name, own in self.state().items():
            with torch.no_grad():
                own.copy_(state[name])


def pose_corrections(tracked: FaceParams, tuned: FaceParams) -> Float[Tensor, "t 6"]:
    """Return training's changes of head poses in the tracked head frame: rotation vectors, then shifts in metres."""
    from_tracked = tracked.T_world_head[:, :3, :3].mT
    shift = from_tracked @ (tuned.head_translation - tracked.head_translation)[:, :, None]
    return torch.cat([axis_angle_from_matrix(from_tracked @ tuned.T_world_head[:, :3, :3]), shift[:, :, 0]], 1)


def corrected_poses(tracked: FaceParams, corrections: Float[Tensor, "t 6"]) -> FaceParams:
    """The tracked faces with these changes of head poses: the inverse of `pose_corrections`."""
    upright = tracked.T_world_head[:, :3, :3]
    turned = axis_angle_from_matrix(upright @ matrix_from_axis_angle(corrections[:, :3]))
    shifted = tracked.head_translation + (upright @ corrections[:, 3:, None])[:, :, 0]
    return replace(tracked, head_rotation=turned, head_translation=shifted)


def mean_pose_correction(tracked: FaceParams, tuned: FaceParams) -> tuple[Float[Tensor, "3 3"], Float[Tensor, " 3"]]:
    """The part of training's corrections that all timesteps share, in the head frame: a rotation and a shift in metres.

    Gaussians and poses can move together during training, since only their sum shows in the pictures. On 16 cameras,
    the head moves by 1.6 mm, with a deviation between timesteps of 0.2 mm.
    """
    mean = pose_corrections(tracked, tuned).mean(0)
    return matrix_from_axis_angle(mean[:3]), mean[3:]


def turns_from_mean(tracked: FaceParams, trained: Items[int] | None = None) -> Float[Tensor, "t 3"]:
    """Return the rotation vectors of head poses from their mean, in radians, in float64 on the CPU.

    The mean is that of the `trained` ones (default: all).
    """
    rotations = tracked.T_world_head[:, :3, :3].double().cpu()
    own = rotations if trained is None else rotations[list(trained)]
    # The rotation that is nearest to the mean matrix aligns the axes with its columns.
    mean, _ = align_centered(np.eye(3), own.mean(0).T.numpy())
    return axis_angle_from_matrix(torch.from_numpy(mean).mT @ rotations)


def without_turns(
    corrections: Float[Tensor, "t c"],
    away: Float[Tensor, "t 3"],
    sequence: Int[Tensor, " t"],
    known: Bool[Tensor, " t"] | None = None,
) -> Float[Tensor, "t c"]:
    """Corrections without the part that is linear in the head's turns. Their mean stays.

    All sequences share the slopes, which come from the turns within each of them: how a sequence differs from another
    may have other reasons. `away` is `turns_from_mean`, and `known` says which timesteps decide (default: all). All but
    the corrections is on the CPU, so that nothing waits for a GPU.
    """
    known = torch.ones(len(away), dtype=torch.bool) if known is None else known
    within, places = away[known], sequence[known]
    for index in places.unique():
        within[places == index] -= within[places == index].mean(0)
    doubt = len(within) * _STILL_TURNS**2 * torch.eye(3).to(away)
    slopes_of = torch.linalg.solve(within.T @ within + doubt, within.T)
    slopes = upload(slopes_of, corrections) @ corrections[upload(known.nonzero()[:, 0], corrections)]
    return corrections - upload(away - away[known].mean(0), corrections) @ slopes


def spread_corrections(tuned: Tensor, tracked: Tensor, seen: Tensor) -> None:
    """Give the timesteps that are not `seen` corrections `tuned - tracked`, interpolated from the others, in place."""
    if not bool(seen.any()) or bool(seen.all()) or tuned.numel() == 0:
        return
    known, unseen = seen.nonzero()[:, 0].numpy(), (~seen).nonzero()[:, 0].numpy()
    corrections = (tuned - tracked).flatten(1).double().cpu().numpy()
    columns = [np.interp(unseen, known, column[known]) for column in corrections.T]
    spread = torch.from_numpy(np.stack(columns, axis=1)).to(tuned).reshape(-1, *tuned.shape[1:])
    tuned[torch.from_numpy(unseen)] = tracked[torch.from_numpy(unseen)] + spread
