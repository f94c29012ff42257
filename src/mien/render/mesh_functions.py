"""Autograd functions of the native mesh operations, for `mien.render.mesh` and `mien.render.mesh_gradients`."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from mien import _native

attach_barycentrics: Callable[..., Tensor]
"""(barycentric, points, face_index, depth, faces): the same barycentrics, with a gradient to the image points."""
interpolate_rows: Callable[..., Tensor]
"""(attributes, barycentric, face_index, corners): rows of attributes mixed by barycentrics."""
look_up_texture: Callable[..., Tensor]
"""(texture, uv): `mien.render.mesh.sample_texture`."""
blend_silhouettes: Callable[..., Tensor]
"""(image, points, face_index, barycentric, depth, faces, edge_vertices, edge_faces, opposite):
`mien.render.mesh_gradients.antialias`."""
compare_picture: Callable[..., Tensor]
"""(points, normals, texture, light, mesh, target, picture): `mien.render.mesh_gradients.mesh_loss`."""


class _Barycentrics(torch.autograd.Function):
    """The identity on barycentrics. The gradient goes to the image points that they were computed from."""

    @staticmethod
    def forward(ctx: Any, barycentric: Tensor, points: Tensor, face_index: Tensor, depth: Tensor, faces: Tensor):
        ctx.save_for_backward(face_index, barycentric, depth, points.detach(), faces)
        return barycentric.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor):
        face_index, barycentric, depth, points, faces = ctx.saved_tensors
        grad_points = torch.zeros(points.shape, dtype=torch.float64)
        fragments = _native.Fragments(face_index, barycentric, depth)
        _native.barycentric_backward(fragments, points, faces, grad.contiguous(), grad_points)
        return None, grad_points.float(), None, None, None


class _Interpolate(torch.autograd.Function):
    """Rows of attributes mixed by barycentrics."""

    @staticmethod
    def forward(ctx: Any, attributes: Tensor, barycentric: Tensor, face_index: Tensor, corners: Tensor):
        attributes, barycentric = attributes.detach().contiguous(), barycentric.detach()
        out = torch.empty(*face_index.shape, attributes.shape[1])
        _native.interpolate_mesh(face_index, barycentric, attributes, corners, out)
        ctx.save_for_backward(attributes, barycentric, face_index, corners)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor):
        attributes, barycentric, face_index, corners = ctx.saved_tensors
        grad_attributes = torch.zeros_like(attributes) if ctx.needs_input_grad[0] else None
        grad_barycentric = torch.empty_like(barycentric) if ctx.needs_input_grad[1] else None
        _native.interpolate_mesh_backward(
            face_index, barycentric, attributes, corners, grad.contiguous(), grad_attributes, grad_barycentric
        )
        return grad_attributes, grad_barycentric, None, None


class _SampleTexture(torch.autograd.Function):
    """Bilinear texture look-up at any number of points."""

    @staticmethod
    def forward(ctx: Any, texture: Tensor, uv: Tensor):
        texture, flat = texture.detach().contiguous(), uv.detach().reshape(-1, 2).contiguous()
        out = torch.empty(len(flat), texture.shape[2])
        _native.sample_texture(texture, flat, out)
        ctx.save_for_backward(texture, flat)
        return out.view(*uv.shape[:-1], -1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor):
        texture, flat = ctx.saved_tensors
        grad_texture = torch.zeros_like(texture) if ctx.needs_input_grad[0] else None
        grad_uv = torch.empty_like(flat) if ctx.needs_input_grad[1] else None
        rows = grad.reshape(len(flat), -1).contiguous()
        _native.sample_texture_backward(texture, flat, rows, grad_texture, grad_uv)
        return grad_texture, None if grad_uv is None else grad_uv.view(*grad.shape[:-1], 2)


class _Antialias(torch.autograd.Function):
    """A picture blended along the silhouettes of the mesh that it shows."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, points: Tensor, *mesh: Tensor):
        *fragments, faces, edge_vertices, edge_faces, opposite = mesh
        image, points = image.detach().contiguous(), points.detach()
        out = torch.empty_like(image)
        edges = _native.MeshEdges(edge_vertices, edge_faces, opposite)
        _native.antialias(_native.Fragments(*fragments), points, faces, edges, image, out)
        ctx.save_for_backward(image, points, *mesh)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor):
        image, points, *fragments, faces, edge_vertices, edge_faces, opposite = ctx.saved_tensors
        grad_image, grad_points = torch.empty_like(image), torch.zeros(points.shape, dtype=torch.float64)
        edges = _native.MeshEdges(edge_vertices, edge_faces, opposite)
        _native.antialias_backward(
            _native.Fragments(*fragments), points, faces, edges, image, grad.contiguous(), grad_image, grad_points
        )
        return grad_image, grad_points.float(), *([None] * (len(ctx.saved_tensors) - 2))


class _MeshLoss(torch.autograd.Function):
    """`mesh_loss`. The forward pass computes the value and all gradients at once and keeps them for `backward`."""

    @staticmethod
    def forward(
        ctx: Any, points: Tensor, normals: Tensor, texture: Tensor, light: Tensor, mesh: tuple, target: tuple,
        picture: Tensor | None,
    ):  # fmt: skip
        tensors = [tensor.detach().contiguous() for tensor in (points, normals, texture, light)]
        face_index, barycentric, depth, faces, edge_vertices, edge_faces, opposite, uv, face_weights = mesh
        grad_points = torch.zeros(points.shape, dtype=torch.float64)
        grad_normals, grad_texture = torch.zeros(normals.shape), torch.zeros(texture.shape)
        grad_light = torch.zeros(9, 3, dtype=torch.float64)
        total, weight = _native.mesh_loss(
            _native.Fragments(face_index, barycentric, depth),
            tensors[0],
            faces,
            _native.MeshEdges(edge_vertices, edge_faces, opposite),
            _native.LitSurface(tensors[1], uv, face_weights, tensors[2], tensors[3]),
            _native.LossTarget(*target),
            picture,
            _native.LossGradients(grad_points, grad_normals, grad_texture, grad_light),
        )
        weight = max(weight, 1.0)
        ctx.weight = weight
        ctx.save_for_backward(grad_points.float(), grad_normals, grad_texture, grad_light.float())
        return points.new_tensor(total / weight)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor):
        scale = float(grad) / ctx.weight
        return *(saved * scale for saved in ctx.saved_tensors), None, None, None


attach_barycentrics = _Barycentrics.apply
interpolate_rows = _Interpolate.apply
look_up_texture = _SampleTexture.apply
blend_silhouettes = _Antialias.apply
compare_picture = _MeshLoss.apply
