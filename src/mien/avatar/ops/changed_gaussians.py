"""Bound Gaussians that also change with the activations of the face, posed as one operation."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from mien import _native
from mien.adam import FactoredGradient, FactoredTerm
from mien.arrays import left_to_autograd, recycled, recycled_like, recycled_twice, unpacked
from mien.avatar.ops import Tensors
from mien.avatar.ops.bound_gaussians import LOCAL, pose_bound_gaussians, prepare_posing
from mien.avatar.ops.feature_network import Layers, feature_network
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.gaussians import Gaussians
from mien.kernels import on_gpu

BASES = ("offset_basis", "color_basis", "opacity_basis")
"""Names of the bases of linear changes, which are also those of the changes."""
FEATURES = ("feature_color", "feature_opacity")
"""Names of the changes by features."""
PENALTIES = ("expression", "appearance")
"""Names of the weighted mean squares of linear changes, and of those by features."""
_FEATURE_TENSORS = ("neutral_features", "feature_bases")


@dataclass(frozen=True, eq=False)
class Changes:
    """How Gaussians change with a face. The network has no biases: features of 0 change nothing."""

    activations: Float[Tensor, "f a"]
    """The activations of each triangle. They have no gradient."""
    bases: tuple[str, ...]
    """Those of `BASES` that the store has: [n, 3, r], that of the opacity [n, r]. They take the first r activations."""
    layers: Layers | None
    """The network of the features, or None without features."""
    gradient: FactoredGradient
    """Receives the gradient of the features' bases."""
    weights: tuple[float, float]
    """Weights of the mean squares of linear changes, and of those by features."""


def pose_changed_gaussians(
    face_model: FaceModel, face: FaceParams, store: Tensors, sh: Float[Tensor, "n k 3"], in_head: bool, changes: Changes
) -> tuple[Gaussians, dict[str, Tensor]]:
    """The posed Gaussians of one timestep without a batch axis, and by name changes and their weighted mean squares.

    Changes are added up before they join a value, as `mien.runtime` does, which gives the same bytes. Differentiable
    in the store, the layers and `face`; one native call forward and two backward for float32 on a CPU.
    """
    prepared = prepare_posing(face_model, face, store)
    if prepared is None:
        return pose_changed_gaussians_reference(face_model, face, store, sh, in_head, changes)
    data, topology, posing = prepared
    constant = sh if sh.shape[1] == 1 else sh[:, :1]
    bases = [store[name] if name in changes.bases else None for name in BASES]
    layers = changes.layers
    network = [None] * 4 if layers is None else [*(store[name] for name in _FEATURE_TENSORS), layers[0], layers[2]]
    found: Any = _ChangedGaussians.apply(
        data, topology, in_head, changes, store["face_index"], *posing, constant, *bases, *network
    )
    means, quats, scales, opacities, head_pose, own, *values = found
    # Joining with nothing takes ten times as long as the sum.
    sh = own if sh.shape[1] == 1 else torch.cat([own, sh[:, 1:]], dim=1)
    named = {name: value for name, value in zip(_VALUES, values, strict=True) if value is not None}
    return Gaussians(means, quats, scales, opacities, sh, head_pose), named


_VALUES = (*BASES, *FEATURES, *PENALTIES)


def pose_changed_gaussians_reference(
    face_model: FaceModel, face: FaceParams, store: Tensors, sh: Float[Tensor, "n k 3"], in_head: bool, changes: Changes
) -> tuple[Gaussians, dict[str, Tensor]]:
    """`pose_changed_gaussians` composed from its parts, for any dtype and device."""
    local = {name: store[name] for name in ("face_index", *LOCAL)}
    if on_gpu(store["means"], changes.activations):
        from mien.avatar.ops.changed_gaussians_gpu import changed

        local["means"], local["opacity_logits"], constant, found = changed(store, sh, changes)
        sh = constant if sh.shape[1] == 1 else torch.cat([constant, sh[:, 1:]], dim=1)
        return pose_bound_gaussians(face_model, face, local, sh, in_head), found
    rows, found = store["face_index"], dict[str, Tensor]()
    for name in changes.bases:
        basis = store[name]
        own = changes.activations[rows, : basis.shape[-1]]
        found[name] = (basis * own.view(-1, *[1] * (basis.ndim - 2), basis.shape[-1])).sum(-1)
    if changes.layers is not None:
        neutral, bases = (store[name] for name in _FEATURE_TENSORS)
        nothing = neutral.new_zeros(len(neutral), 0)
        outputs = feature_network(bases, changes.activations, rows, neutral, nothing, changes.layers, changes.gradient)
        found |= zip(FEATURES, outputs, strict=True)
    local["means"] = _joined(local["means"], found, "offset_basis")
    local["opacity_logits"] = _joined(local["opacity_logits"], found, "opacity_basis", "feature_opacity")
    constant = _joined(sh[:, 0], found, "color_basis", "feature_color")[:, None]
    sh = constant if sh.shape[1] == 1 else torch.cat([constant, sh[:, 1:]], dim=1)
    return pose_bound_gaussians(face_model, face, local, sh, in_head), found | mean_squares(found, changes.weights)


def mean_squares(changes: Mapping[str, Tensor], weights: tuple[float, float]) -> dict[str, Float[Tensor, ""]]:
    """The weighted mean squares over all Gaussians, in plain PyTorch: of linear changes, and of those by features."""
    losses = {}
    for loss, names, weight in zip(PENALTIES, (BASES, FEATURES), weights, strict=True):
        own = [changes[name].square().mean() for name in names if name in changes]
        if own:
            losses[loss] = weight * torch.stack(own).sum()
    return losses


def _joined(values: Tensor, changes: Mapping[str, Tensor], *names: str) -> Tensor:
    own = [changes[name] for name in names if name in changes]
    return values + sum(own[1:], own[0]) if own else values


_FACE, _LOCAL_AT, _SH, _BASES_AT, _NETWORK = slice(6), slice(6, 10), 10, slice(11, 14), slice(14, 18)
"""Places of the inputs of `_ChangedGaussians`: shape and pose of the face, Gaussians, their colours, and what changes
them. What does not exist is None."""


class _ChangedGaussians(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, data: Any, topology: Any, in_head: bool, changes: Changes, rows: Tensor, *inputs: Tensor | None
    ) -> tuple[Tensor | None, ...]:
        arrays = [None if tensor is None else tensor.contiguous() for tensor in inputs]
        sh, bases, neutral = arrays[_SH], arrays[_BASES_AT], arrays[14]
        assert sh is not None
        count = len(sh)
        shapes = [(count, 3), (count, 4), (count, 3), (count,), (4, 4), tuple(sh.shape)]
        shapes += [None if basis is None else tuple(basis.shape[:-1]) for basis in bases]
        shapes += [None, None] if neutral is None else [(count, 3), (count,)]
        pairs = [(None, None) if shape is None else recycled_twice(shape) for shape in (*shapes, (), ())]
        returned, kept = map(list, zip(*pairs, strict=True))
        posed, changed = returned[:5], returned[5:]
        ctx.ride = _native.ride(
            data, topology, in_head, *_posing_groups(arrays), _native.PosedGaussians(*unpacked(*posed)),
            _change_arrays(arrays, changes), _native.ChangedArrays(*unpacked(*changed)), changes.weights,
        )  # fmt: skip
        ctx.fixed, ctx.rows = (data, topology, in_head, changes), rows
        ctx.neutral = inputs[14] if neutral is not None and neutral.is_leaf else None
        ctx.set_materialize_grads(False)
        # PyTorch would make a tensor of each that it saves.
        ctx.inputs, ctx.arrays, ctx.found = inputs, arrays, kept[2:4] + kept[5:]
        linear = changed[-2] if any(basis is not None for basis in bases) else None
        return (
            *posed[:4],
            posed[4] if in_head else None,
            *changed[:-2],
            linear,
            changed[-1] if neutral is not None else None,
        )

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        data, topology, in_head, changes = ctx.fixed
        arrays, (scales, opacities, *changed) = ctx.arrays, ctx.found
        shapes = [(len(opacities), width) for width in (3, 4, 3)] + [opacities.shape]
        *by_posed, by_head_pose = (None if one is None else one.contiguous() for one in gradients[:5])
        by_posed = [torch.zeros(shape) if one is None else one for one, shape in zip(by_posed, shapes, strict=True)]
        by_changed = [None if one is None else one.contiguous() for one in gradients[5:]]
        moves_face = any(ctx.needs_input_grad[7:11])
        of_face = [recycled_like(tensor) if moves_face else None for tensor in arrays[2:6]]
        of_local = [recycled_like(tensor) for tensor in arrays[_LOCAL_AT]]
        face, local = _posing_groups(arrays)
        known = unpacked(scales, opacities, of_local[0], of_local[3])
        _native.ride_backward(
            ctx.ride, data, topology, face, local, known[0], known[1],
            _native.PosedGaussians(*unpacked(*by_posed, by_head_pose)), _native.LocalGaussians(*unpacked(*of_local)),
            _native.FaceParameterGradients(*unpacked(*of_face)) if moves_face else None,
        )  # fmt: skip
        of_changes = [
            None if tensor is None else recycled(*tensor.shape)
            for tensor in (*arrays[_BASES_AT], arrays[14], *arrays[16:])
        ]
        _native.ride_changes_backward(
            ctx.ride, topology, _change_arrays(arrays, changes), _native.ChangedArrays(*unpacked(*changed)),
            changes.weights, known[2], known[3], _native.ByChangedArrays(*unpacked(*by_changed)),
            _native.ChangeGradients(*unpacked(*of_changes)),
        )  # fmt: skip
        *of_bases, of_features, of_layer1, of_layer2 = of_changes
        if of_features is not None:
            if ctx.neutral is not None and ctx.neutral.grad is not None:
                # It may share the memory of an earlier term, and autograd adds to it in place.
                ctx.neutral.grad = ctx.neutral.grad.clone()
            # Autograd copies gradients that somebody else holds. It does not know of a second tensor in their memory.
            changes.gradient.terms.append(FactoredTerm(of_features.data, changes.activations, ctx.rows))
        of_network = (of_features, None, of_layer1, of_layer2)
        found = (None, None, *of_face, *of_local, by_changed[0], *of_bases, *of_network)
        return *[None] * 5, *left_to_autograd(ctx.inputs, found)


def _posing_groups(arrays: Sequence[Tensor | None]) -> tuple[Any, Any]:
    face = _native.FaceArrays(*unpacked(*arrays[_FACE]))
    return face, _native.LocalGaussians(*unpacked(*arrays[_LOCAL_AT]))


def _change_arrays(arrays: Sequence[Tensor | None], changes: Changes) -> Any:
    known = unpacked(arrays[_SH], changes.activations, *arrays[_BASES_AT], *arrays[_NETWORK])
    return _native.ChangeArrays(*known)
