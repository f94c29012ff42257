"""Some Gaussians of a baked avatar, or all of them in another order."""

from dataclasses import fields, replace
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Int

from mien.runtime.baked import BakedAvatar, BlendSkinned, MeshBound, Static

Baked = TypeVar("Baked", bound=BakedAvatar)


def with_rows(baked: Baked, rows: Int[np.ndarray, " k"]) -> Baked:
    """A baked avatar with the Gaussians of these indices alone, in the order of the indices."""
    attributes = _rows(baked.attributes, rows, *(field.name for field in fields(baked.attributes)))
    match baked:
        case MeshBound():
            changes = _rows(baked.changes, rows, "color", "opacity_logits", "means")
            if changes is not None:
                changes = replace(changes, features=_rows(changes.features, rows, "neutral", "basis", "own"))
            face_index, means = baked.face_index[rows], baked.means[rows]
            return replace(baked, face_index=face_index, means=means, attributes=attributes, changes=changes)
        case Static():
            bases, network = _bases(baked, rows), _network(baked, rows)
            return replace(baked, means=baked.means[rows], attributes=attributes, bases=bases, network=network)
        case BlendSkinned():
            own = ("expression_basis", "pose_basis")
            rig = _rows(baked.rig, rows, "template", "skinning_weights", second=own)
            still = None if baked.still_weights is None else baked.still_weights[rows]
            bases, network = _bases(baked, rows), _network(baked, rows)
            return replace(baked, rig=rig, attributes=attributes, bases=bases, network=network, still_weights=still)


def _bases(baked: BlendSkinned | Static, rows: Int[np.ndarray, " k"]) -> Any:
    return _rows(baked.bases, rows, second=("means", "log_scales", "opacity_logits", "sh"))


def _network(baked: BlendSkinned | Static, rows: Int[np.ndarray, " k"]) -> Any:
    network = _rows(baked.network, rows, "base")
    return network if network is None else replace(network, along=_rows(network.along, rows, "basis"))


def _rows(record: Any, rows: Int[np.ndarray, " k"], *first: str, second: tuple[str, ...] = ()) -> Any:
    """A record, or None, with some rows of its arrays along their first or second axis. None stays None."""
    if record is None:
        return None
    axes = dict.fromkeys(first, 0) | dict.fromkeys(second, 1)
    found = {name: getattr(record, name) for name in axes}
    kept = {name: np.take(array, rows, axes[name]) for name, array in found.items() if array is not None}
    return replace(record, **kept)
