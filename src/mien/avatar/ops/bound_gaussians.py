"""Bound Gaussians: posing of the face, frames of the triangles and opacities as one operation."""

from importlib import import_module
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from mien import _native
from mien.arrays import left_to_autograd, recycled, recycled_like, recycled_twice, unpacked
from mien.avatar.ops import Tensors
from mien.avatar.ops.activation import sigmoid
from mien.avatar.ops.triangle_frames import bind_to_world, rig_topology
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.face.posing import compiled_model, has_native_posing, head_poses
from mien.gaussians import Gaussians
from mien.kernels import on_gpu

LOCAL = ("means", "quats", "log_scales", "opacity_logits")
"""Names of the tensors of Gaussians in the frames of their triangles."""
FACE_FIELDS = ("expression", "joints", "head_rotation", "head_translation")
"""Names of the parameters of a face that change from timestep to timestep."""


def pose_bound_gaussians(
    face_model: FaceModel,
    face: FaceParams,
    store: Tensors,
    sh: Float[Tensor, "n k 3"],
    in_head: bool,
) -> Gaussians:
    """The posed Gaussians of a store, or of such tensors by name.

    The tensors are `face_index`, `means, quats, log_scales` in triangle units, and `opacity_logits`. The Gaussians are
    in world space or, with `in_head`, in the head frame together with its pose. There is one batch entry per timestep,
    and no batch axis for a single one. Differentiable in the store and in `face`. A single timestep on a CPU, which is
    the case in training, takes one native call forward and one backward.
    """
    prepared = prepare_posing(face_model, face, store)
    if prepared is None:
        posed = _posed_on_gpu(face_model, face, store, sh, in_head)
        return pose_bound_gaussians_reference(face_model, face, store, sh, in_head) if posed is None else posed
    data, topology, inputs = prepared
    means, quats, scales, opacities, *head = _BoundGaussians.apply(data, topology, in_head, *inputs)
    return Gaussians(means, quats, scales, opacities, sh, *head)


def _posed_on_gpu(
    face_model: FaceModel, face: FaceParams, store: Tensors, sh: Float[Tensor, "n k 3"], in_head: bool
) -> Gaussians | None:
    """The posed Gaussians of one timestep by kernels of a GPU, or None if these cannot pose them."""
    if len(face) != 1 or not on_gpu(face_model.template, store["means"], *face.tensors().values()):
        return None
    return import_module(f"{__name__}_gpu").pose_bound_gaussians(face_model, face, store, sh, in_head)


def prepare_posing(
    face_model: FaceModel, face: FaceParams, store: Tensors
) -> tuple[Any, _native.RigTopology, list[Tensor]] | None:
    """Return the face model and the topology as the core takes them, and the ten tensors that a pose depends on.

    None if the core cannot pose: more or fewer timesteps than one, a shape with a gradient, another dtype or device.
    """
    if len(face) != 1 or not has_native_posing(face_model, face) or store["means"].dtype != torch.float32:
        return None
    compiled = compiled_model(face_model)
    rest = compiled.rest.of(face_model, face)
    if rest[0].requires_grad:
        return None
    topology = rig_topology(len(face_model.template), face_model.faces, store["face_index"])
    pose = (getattr(face, name) for name in FACE_FIELDS)
    return compiled.data, topology, [*rest, *pose, *(store[name] for name in LOCAL)]


def pose_bound_gaussians_reference(
    face_model: FaceModel,
    face: FaceParams,
    store: Tensors,
    sh: Float[Tensor, "n k 3"],
    in_head: bool,
) -> Gaussians:
    """`pose_bound_gaussians` composed from its parts, for any dtype, device and number of timesteps."""
    vertices = face_model.head_vertices(face) if in_head else face_model(face)
    means, quats, log_scales, opacity_logits = (store[name] for name in LOCAL)
    bound = bind_to_world(vertices, face_model.faces, store["face_index"], means, quats, log_scales)
    posed = Gaussians(*bound, sigmoid(opacity_logits), sh, head_poses(face) if in_head else None)
    return posed.timestep(0) if len(face) == 1 else posed


class _BoundGaussians(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, data: Any, topology: Any, in_head: bool, *inputs: Tensor) -> tuple[Tensor, ...]:
        arrays = [tensor.contiguous() for tensor in inputs]
        count = len(arrays[-1])
        means, quats, head_pose = recycled(count, 3), recycled(count, 4), recycled(4, 4)
        (scales, kept_scales), (opacities, kept_opacities) = recycled_twice((count, 3)), recycled_twice((count,))
        known = unpacked(*arrays, means, quats, scales, opacities, head_pose)
        face, local = _native.FaceArrays(*known[:6]), _native.LocalGaussians(*known[6:10])
        posed = _native.PosedGaussians(*known[10:])
        ctx.ride = _native.ride(data, topology, in_head, face, local, posed)
        ctx.data, ctx.topology, ctx.in_head = data, topology, in_head
        # PyTorch would make a tensor of each that it saves, and look whether other threads changed what shares memory
        # with it: rows of one track.
        ctx.inputs, ctx.arrays, ctx.posed = inputs, arrays, (kept_scales, kept_opacities)
        return (means, quats, scales, opacities, head_pose) if in_head else (means, quats, scales, opacities)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        saved, (scales, opacities) = ctx.arrays, ctx.posed
        moves_face = any(ctx.needs_input_grad[5:9])
        of_face = [recycled_like(tensor) if moves_face else None for tensor in saved[2:6]]
        of_gaussians = [recycled_like(tensor) for tensor in saved[6:]]
        head_pose = () if ctx.in_head else (None,)
        by_posed = (*(gradient.contiguous() for gradient in gradients), *head_pose)
        known = unpacked(*saved, *by_posed, *of_gaussians, scales, opacities)
        _native.ride_backward(
            ctx.ride,
            ctx.data,
            ctx.topology,
            _native.FaceArrays(*known[:6]),
            _native.LocalGaussians(*known[6:10]),
            known[19],
            known[20],
            _native.PosedGaussians(*known[10:15]),
            _native.LocalGaussians(*known[15:19]),
            _native.FaceParameterGradients(*unpacked(*of_face)) if moves_face else None,
        )
        return None, None, None, *left_to_autograd(ctx.inputs, [None, None, *of_face, *of_gaussians])
