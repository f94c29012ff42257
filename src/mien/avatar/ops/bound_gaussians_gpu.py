"""Gaussians in the frames of triangles, in kernels for a GPU: one launch forward and two backward.

A renderer on a GPU takes covariances. They carry the gradients: no quaternions of triangles are in between.
"""

from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from mien.avatar.ops import Tensors
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.face.posing_gpu import pose_face
from mien.gaussians import Gaussians
from mien.kernels import blocks, launch

_BLOCK = 128
_SHORTEST = tl.constexpr(1e-7)  # `DEGENERATE_LENGTH` of `triangle_frames`


def pose_bound_gaussians(
    face_model: FaceModel, face: FaceParams, store: Tensors, sh: Tensor, in_head: bool
) -> Gaussians | None:
    """`mien.avatar.ops.bound_gaussians.pose_bound_gaussians` of one timestep. None if the shape has a gradient."""
    posed = pose_face(face_model, face, not in_head)
    if posed is None:
        return None
    vertices, pose = posed
    local = (store[name] for name in ("means", "quats", "log_scales", "opacity_logits"))
    means, covariances, opacities, quats, scales = bind_gaussians(
        vertices, face_model.faces, store["face_index"], *local
    )
    return Gaussians(means, quats, scales, opacities, sh, pose if in_head else None, covariances).timestep(0)


def bind_gaussians(
    vertices: Tensor, faces: Tensor, face_index: Tensor, means: Tensor, quats: Tensor, log_scales: Tensor,
    opacity_logits: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """Means [1, n, 3], covariances [1, n, 6] and opacities [n]; quats and scales, which have no gradient."""
    given = (vertices, faces, face_index, means, quats, log_scales, opacity_logits)
    return _Bound.apply(*given)  # pyright: ignore[reportReturnType]


class _Bound(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *given: Tensor) -> tuple[Tensor, ...]:
        given = tuple(one.contiguous() for one in given)
        n = len(given[2])
        means, covariances, quats, scales = (given[3].new_empty(1, n, width) for width in (3, 6, 4, 3))
        opacities = given[3].new_empty(n)
        launch(
            _bind, blocks(n, _BLOCK), *given, means, covariances, quats, scales, opacities, n, BLOCK=_BLOCK
        )  # fmt: skip
        ctx.save_for_backward(*given, opacities)
        ctx.mark_non_differentiable(quats, scales)
        return means, covariances, opacities, quats, scales

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_means: Tensor, by_covariances: Tensor, by_opacities: Tensor, *_: Any) -> Any:
        *given, opacities = ctx.saved_tensors
        by_vertices, by_local = torch.zeros_like(given[0]), [torch.empty_like(one) for one in given[3:]]
        gradients = (by_means.contiguous(), by_covariances.contiguous(), by_opacities.contiguous())
        launch(
            _bind_backward, blocks(len(opacities), _BLOCK), *given, opacities, *gradients, by_vertices, *by_local,
            len(opacities), BLOCK=_BLOCK,
        )  # fmt: skip
        return by_vertices, None, None, *by_local


@no_type_check
@triton.jit
def _three(pointer, row, there):
    return (
        tl.load(pointer + 3 * row, mask=there, other=0.0),
        tl.load(pointer + 3 * row + 1, mask=there, other=0.0),
        tl.load(pointer + 3 * row + 2, mask=there, other=0.0),
    )


@no_type_check
@triton.jit
def _store_three(pointer, row, value, there):
    for i in tl.static_range(3):
        tl.store(pointer + 3 * row + i, value[i], mask=there)


@no_type_check
@triton.jit
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@no_type_check
@triton.jit
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@no_type_check
@triton.jit
def _times(a, factor):
    return a[0] * factor, a[1] * factor, a[2] * factor


@no_type_check
@triton.jit
def _sum(a, b):
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@no_type_check
@triton.jit
def _corners(faces, face_index, row, there):
    triangle = tl.load(face_index + row, mask=there, other=0)
    return (
        tl.load(faces + 3 * triangle, mask=there, other=0),
        tl.load(faces + 3 * triangle + 1, mask=there, other=0),
        tl.load(faces + 3 * triangle + 2, mask=there, other=0),
    )


@no_type_check
@triton.jit
def _frame(vertices, corners, there):
    """Edges, unit axes, lengths and centroid of each Gaussian's triangle, and whether it is degenerate."""
    v0, v1, v2 = (
        _three(vertices, corners[0], there),
        _three(vertices, corners[1], there),
        _three(vertices, corners[2], there),
    )
    first, second = _sum(v1, _times(v0, -1.0)), _sum(v2, _times(v0, -1.0))
    edge, area = tl.sqrt(_dot(first, first)), _cross(first, second)
    flat = (edge < _SHORTEST) | (tl.sqrt(_dot(area, area)) < _SHORTEST * edge)
    zero = edge * 0.0
    first = tl.where(flat, _SHORTEST, first[0]), tl.where(flat, zero, first[1]), tl.where(flat, zero, first[2])
    second = tl.where(flat, zero, second[0]), tl.where(flat, _SHORTEST, second[1]), tl.where(flat, zero, second[2])
    edge = tl.where(flat, _SHORTEST, edge)
    along = _times(first, 1 / edge)
    area = _cross(along, second)
    height = tl.sqrt(_dot(area, area))
    normal = _times(area, 1 / height)
    total = _sum(_sum(v0, v1), v2)
    center = total[0] / 3, total[1] / 3, total[2] / 3
    return second, along, normal, _cross(along, normal), edge, height, center, flat


@no_type_check
@triton.jit
def _rotation(quats, row, there):
    """Unit quaternions, one over their norms before, and the columns of their matrices."""
    w, x = tl.load(quats + 4 * row, mask=there, other=1.0), tl.load(quats + 4 * row + 1, mask=there, other=0.0)
    y, z = tl.load(quats + 4 * row + 2, mask=there, other=0.0), tl.load(quats + 4 * row + 3, mask=there, other=0.0)
    norm = tl.sqrt(w * w + x * x + y * y + z * z)
    scale = 1 / tl.where(norm < 1e-12, 1e-12, norm)
    w, x, y, z = w * scale, x * scale, y * scale, z * scale
    columns = (
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    )
    return (w, x, y, z), scale, columns


@no_type_check
@triton.jit
def _turned(along, normal, across, vector):
    return _sum(_sum(_times(along, vector[0]), _times(normal, vector[1])), _times(across, vector[2]))


@no_type_check
@triton.jit
def _bind(
    vertices, faces, face_index, means, quats, log_scales, opacity_logits, by_means, covariances, by_quats, scales,
    opacities, n, BLOCK: tl.constexpr,
):  # fmt: skip
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    there = row < n
    _, along, normal, across, edge, height, center, _ = _frame(vertices, _corners(faces, face_index, row, there), there)
    size = (edge + height) / 2
    place = _times(_turned(along, normal, across, _three(means, row, there)), size)
    _store_three(by_means, row, _sum(place, center), there)
    _, _, columns = _rotation(quats, row, there)
    raw = _three(log_scales, row, there)
    own = tl.exp(raw[0]) * size, tl.exp(raw[1]) * size, tl.exp(raw[2]) * size
    _store_three(scales, row, own, there)
    one = _turned(along, normal, across, columns[0])
    two = _turned(along, normal, across, columns[1])
    three = _turned(along, normal, across, columns[2])
    squares = own[0] * own[0], own[1] * own[1], own[2] * own[2]
    for i in tl.static_range(3):
        for j in tl.static_range(i, 3):
            value = squares[0] * one[i] * one[j] + squares[1] * two[i] * two[j] + squares[2] * three[i] * three[j]
            # Places of the upper triangle, row by row: 0 1 2, 3 4, 5.
            tl.store(covariances + 6 * row + (i * (5 - i)) // 2 + j, value, mask=there)
    _store_quaternion(by_quats, row, one, two, three, there)
    logit = tl.load(opacity_logits + row, mask=there, other=0.0)
    tl.store(opacities + row, 1 / (1 + tl.exp(-logit)), mask=there)


@no_type_check
@triton.jit
def _store_quaternion(quats, row, one, two, three, there):
    """The unit quaternion of a matrix with these columns, from the largest of its numbers."""
    m00, m11, m22 = one[0], two[1], three[2]
    w, x, y, z = 1 + m00 + m11 + m22, 1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22
    wx, wy, wz = two[2] - three[1], three[0] - one[2], one[1] - two[0]
    xy, xz, yz = two[0] + one[1], three[0] + one[2], three[1] + two[2]
    of_x, of_y = (x >= y) & (x >= z), (y > x) & (y >= z)
    of_w = (w >= x) & (w >= y) & (w >= z)
    a = tl.where(of_w, w, tl.where(of_x, wx, tl.where(of_y, wy, wz)))
    b = tl.where(of_w, wx, tl.where(of_x, x, tl.where(of_y, xy, xz)))
    c = tl.where(of_w, wy, tl.where(of_x, xy, tl.where(of_y, y, yz)))
    d = tl.where(of_w, wz, tl.where(of_x, xz, tl.where(of_y, yz, z)))
    scale = 1 / tl.sqrt(a * a + b * b + c * c + d * d)
    tl.store(quats + 4 * row, a * scale, mask=there)
    tl.store(quats + 4 * row + 1, b * scale, mask=there)
    tl.store(quats + 4 * row + 2, c * scale, mask=there)
    tl.store(quats + 4 * row + 3, d * scale, mask=there)


@no_type_check
@triton.jit
def _by_column(i: tl.constexpr, a, b, c, w, x, y, z):
    """The derivative by a unit quaternion of a column of its matrix, times the gradient a, b, c."""
    if i == 0:
        by_w, by_x = z * b - y * c, y * b + z * c
        by_y, by_z = x * b - w * c - 2 * y * a, w * b + x * c - 2 * z * a
    elif i == 1:
        by_w, by_y = x * c - z * a, x * a + z * c
        by_x, by_z = y * a + w * c - 2 * x * b, y * c - w * a - 2 * z * b
    else:
        by_w, by_z = y * a - x * b, x * a + y * b
        by_x, by_y = z * a - w * b - 2 * x * c, w * a + z * b - 2 * y * c
    return 2 * by_w, 2 * by_x, 2 * by_y, 2 * by_z


@no_type_check
@triton.jit
def _by_edges(second, along, normal, edge, height, by_along, by_normal, by_across, by_size):
    """The derivative by the triangle's edges of a frame with these gradients.

    across = along x normal, normal = (along x second) / height, along = first / edge.
    """
    by_along = _sum(by_along, _cross(normal, by_across))
    by_normal = _sum(by_normal, _cross(by_across, along))
    by_area = _times(_sum(by_normal, _times(normal, -_dot(normal, by_normal))), 1 / height)
    by_area = _sum(by_area, _times(normal, by_size / 2))
    by_along = _sum(by_along, _cross(second, by_area))
    by_first = _times(_sum(by_along, _times(along, -_dot(along, by_along))), 1 / edge)
    by_first = _sum(by_first, _times(along, by_size / 2))
    return by_first, _cross(by_area, along)


@no_type_check
@triton.jit
def _bind_backward(
    vertices, faces, face_index, means, quats, log_scales, opacity_logits, opacities, by_places, by_covariances,
    by_opacities, by_vertices, by_means, by_quats, by_scales, by_logits, n, BLOCK: tl.constexpr,
):  # fmt: skip
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    there = row < n
    opacity = tl.load(opacities + row, mask=there, other=0.0)
    by_opacity = tl.load(by_opacities + row, mask=there, other=0.0)
    tl.store(by_logits + row, by_opacity * opacity * (1 - opacity), mask=there)
    corners = _corners(faces, face_index, row, there)
    second, along, normal, across, edge, height, _, flat = _frame(vertices, corners, there)
    size, local, by_place = (edge + height) / 2, _three(means, row, there), _three(by_places, row, there)
    # The centre: size R m + centroid.
    back = _dot(along, by_place), _dot(normal, by_place), _dot(across, by_place)
    _store_three(by_means, row, _times(back, size), there)
    by_size = _dot(back, local)
    by_along, by_normal = _times(by_place, size * local[0]), _times(by_place, size * local[1])
    by_across = _times(by_place, size * local[2])
    # The covariance is M M^T with M = R Q S: its derivative by M is twice that by the covariance, times M.
    unit, scale, columns = _rotation(quats, row, there)
    raw = _three(log_scales, row, there)
    xx, xy, xz = _three(by_covariances, 2 * row, there)
    yy, yz, zz = _three(by_covariances, 2 * row + 1, there)
    by_w, by_x, by_y, by_z = size * 0.0, size * 0.0, size * 0.0, size * 0.0
    w, x, y, z = unit
    for i in tl.static_range(3):
        bare = tl.exp(raw[i])
        own, column = bare * size, _turned(along, normal, across, columns[i])
        by_column = (
            2 * xx * column[0] + xy * column[1] + xz * column[2],
            xy * column[0] + 2 * yy * column[1] + yz * column[2],
            xz * column[0] + yz * column[1] + 2 * zz * column[2],
        )
        by_own = own * _dot(by_column, column)
        tl.store(by_scales + 3 * row + i, by_own * own, mask=there)
        by_size += by_own * bare
        by_column = _times(by_column, own * own)
        by_along = _sum(by_along, _times(by_column, columns[i][0]))
        by_normal = _sum(by_normal, _times(by_column, columns[i][1]))
        by_across = _sum(by_across, _times(by_column, columns[i][2]))
        a, b, c = _dot(along, by_column), _dot(normal, by_column), _dot(across, by_column)
        to_w, to_x, to_y, to_z = _by_column(i, a, b, c, w, x, y, z)
        by_w, by_x, by_y, by_z = by_w + to_w, by_x + to_x, by_y + to_y, by_z + to_z
    along_unit = w * by_w + x * by_x + y * by_y + z * by_z
    tl.store(by_quats + 4 * row, scale * (by_w - w * along_unit), mask=there)
    tl.store(by_quats + 4 * row + 1, scale * (by_x - x * along_unit), mask=there)
    tl.store(by_quats + 4 * row + 2, scale * (by_y - y * along_unit), mask=there)
    tl.store(by_quats + 4 * row + 3, scale * (by_z - z * along_unit), mask=there)
    by_first, by_second = _by_edges(second, along, normal, edge, height, by_along, by_normal, by_across, by_size)
    for i in tl.static_range(3):
        of_first, of_second = tl.where(flat, 0.0, by_first[i]), tl.where(flat, 0.0, by_second[i])
        tl.atomic_add(by_vertices + 3 * corners[0] + i, by_place[i] / 3 - of_first - of_second, mask=there)
        tl.atomic_add(by_vertices + 3 * corners[1] + i, by_place[i] / 3 + of_first, mask=there)
        tl.atomic_add(by_vertices + 3 * corners[2] + i, by_place[i] / 3 + of_second, mask=there)
