"""Native computation of vertices and head poses: autograd around the C++ core, for float32 on a CPU."""

from importlib import import_module
from typing import TYPE_CHECKING, Any, final
from weakref import WeakKeyDictionary

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from mien import _native
from mien.arrays import is_native, unpacked
from mien.face.params import FaceParams
from mien.kernels import on_gpu

if TYPE_CHECKING:
    from mien.face.model import FaceModel


_MAX_SHAPES = 256  # largest number of expressions plus nine per free joint: kMostFaceShapes of native/face.h


def has_native_posing(model: "FaceModel", face: FaceParams) -> bool:
    """Whether `pose_vertices` supports this model and these parameters."""
    if model.expression_basis.shape[0] + 9 * len(model.free_joint_names) > _MAX_SHAPES:
        return False
    return is_native(model.template, *face.tensors().values())


def pose_vertices(model: "FaceModel", face: FaceParams, in_world: bool) -> Float[Tensor, "b v 3"]:
    """Compute `FaceModel.__call__` (in world space) or `FaceModel.head_vertices`, differentiable in all fields."""
    compiled = compiled_model(model)
    rest, joint_rest = compiled.rest.of(model, face)
    head = (face.head_rotation, face.head_translation) if in_world else (None, None)
    return _PoseVertices.apply(compiled.data, rest, joint_rest, face.expression, face.joints, *head)


def head_poses(face: FaceParams) -> Float[Tensor, "b 4 4"]:
    """Return `FaceParams.T_world_head` with the rounding of `mien.runtime`.

    They are differentiable, and computed natively for float32 on a CPU.

    The two agree to 1e-6. Avatars pass this one to renderers, so that pictures are the same as those without torch.
    """
    rotation, translation = face.head_rotation, face.head_translation
    if on_gpu(rotation, translation):
        return import_module("mien.face.posing_gpu").head_poses(rotation, translation)
    return _HeadPoses.apply(rotation, translation) if is_native(rotation, translation) else face.T_world_head


class _HeadPoses(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rotation: Tensor, translation: Tensor) -> Tensor:
        rotation = rotation.contiguous()
        transforms = rotation.new_empty(len(rotation), 4, 4)
        _native.head_poses(*unpacked(rotation, translation.contiguous(), transforms))
        ctx.save_for_backward(rotation)
        return transforms

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_transforms: Tensor) -> tuple[Tensor, Tensor]:
        (rotation,) = ctx.saved_tensors
        grad_transforms, grad_rotation = grad_transforms.contiguous(), torch.empty_like(rotation)
        _native.head_poses_backward(*unpacked(rotation, grad_transforms, grad_rotation))
        return grad_rotation, grad_transforms[:, :3, 3].contiguous()


class CompiledModel:
    """A model's constants in the core's layout, and the last person's shape."""

    def __init__(self, model: "FaceModel"):
        pose_basis = model.pose_basis
        self.data = _native.make_face_model(
            model.expression_basis.contiguous(),
            None if pose_basis is None else pose_basis.contiguous(),
            model.joint_rotation_basis.contiguous(),
            model.joint_translation_basis.contiguous(),
            model.skinning_weights.contiguous(),
            parents=model.joint_parents,
            is_free=model.joint_free,
        )
        self.rest = RestShape()


@final
class RestShape:
    """The last person's shape without expression, which training needs in every step."""

    def __init__(self):
        self._last: tuple[Any, ...] | None = None

    def of(self, model: "FaceModel", face: FaceParams) -> tuple[Tensor, Tensor]:
        """Return vertices and joints of this person without expression."""
        identity, offsets = face.identity, face.vertex_offsets
        versions = (identity._version, None if offsets is None else offsets._version)
        # The stored tensors stay alive, so the same object with the same version is the same person.
        if self._last and self._last[0] is identity and self._last[1] is offsets and self._last[2] == versions:
            return self._last[3]
        shape = model.rest_vertices(face), model.rest_joints(face)
        # A stored shape has to serve gradients too, although it may have been computed without them.
        if not (identity.requires_grad or (offsets is not None and offsets.requires_grad)):
            self._last = identity, offsets, versions, shape
        return shape


def compiled_model(model: "FaceModel") -> CompiledModel:
    """Return the model in the core's layout, which is made once."""
    compiled = _compiled.get(model)
    if compiled is None:
        compiled = _compiled[model] = CompiledModel(model)
    return compiled


_compiled: "WeakKeyDictionary[FaceModel, CompiledModel]" = WeakKeyDictionary()


class _PoseVertices(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, data: Any, *inputs: Tensor | None) -> Tensor:
        rest, joint_rest, expression, joints, rotation, translation = (
            None if tensor is None else tensor.contiguous() for tensor in inputs
        )
        assert rest is not None
        assert joint_rest is not None
        assert expression is not None
        assert joints is not None
        shaped, vertices = (rest.new_empty(len(expression), *rest.shape) for _ in range(2))
        arrays = (rest, joint_rest, expression, joints, rotation, translation)
        _native.pose_face(data, _native.FaceArrays(*unpacked(*arrays)), *unpacked(shaped, vertices))
        ctx.data = data
        ctx.save_for_backward(*arrays, shaped)
        return vertices

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_vertices: Tensor) -> tuple[Tensor | None, ...]:
        *arrays, shaped = ctx.saved_tensors
        rest, joint_rest, expression, joints, head_rotation, _ = arrays
        b = len(expression)
        grad_rest, grad_joint_rest = rest.new_empty(b, *rest.shape), rest.new_empty(b, *joint_rest.shape)
        grad_expression, grad_joints = torch.empty_like(expression), torch.empty_like(joints)
        grad_head = rest.new_empty(b, 3), rest.new_empty(b, 3)
        known = unpacked(*arrays, shaped, grad_vertices.contiguous())
        found = unpacked(grad_rest, grad_joint_rest, grad_expression, grad_joints, *grad_head)
        face, gradients = _native.FaceArrays(*known[:6]), _native.FaceArrays(*found)
        _native.pose_face_backward(ctx.data, face, known[6], known[7], gradients)
        needs = ctx.needs_input_grad
        return (
            None,
            grad_rest.sum(0) if needs[1] else None,
            grad_joint_rest.sum(0) if needs[2] else None,
            grad_expression,
            grad_joints,
            *(grad_head if head_rotation is not None else (None, None)),
        )
