"""Make valid calls of the native functions on meshes, and the parts of all baselines."""

from collections.abc import Callable
from typing import Any

import numpy as np

Rng = np.random.Generator
Arguments = list[Any]
Baseline = Callable[[Any, Rng], Arguments]
F32, F64, I32, I64, U8 = np.float32, np.float64, np.int32, np.int64, np.uint8


def normal(rng: Rng, *shape: int, scale: float = 1.0) -> np.ndarray:
    return (scale * rng.standard_normal(shape)).astype(F32)


def empty(*shape: int, dtype: type = F32) -> np.ndarray:
    return np.zeros(shape, dtype)


def below(rng: Rng, count: int, *shape: int, dtype: type = I64) -> np.ndarray:
    return rng.integers(0, count, shape).astype(dtype)


def few(rng: Rng) -> int:
    return int(rng.choice([1, 2, 5, 16, 17, 40]))


def picture(rng: Rng) -> tuple[int, int]:
    """Return height and width of a picture."""
    return int(rng.choice([1, 3, 8, 33, 64])), int(rng.choice([6, 7, 16, 31, 65]))


VIEW = np.diag([1, -1, -1, 1]).astype(F32)


def camera(rng: Rng, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Return K and viewmat of a camera 3 units in front of the origin."""
    focal = float(width)
    viewmat = VIEW.copy()
    viewmat[2, 3] = 3
    return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], F32), viewmat


def rasterize_mesh(native: Any, rng: Rng) -> Arguments:
    h, w = picture(rng)
    v, f = few(rng) + 2, few(rng)
    fragments = native.Fragments(empty(h, w, dtype=I32), empty(h, w, 3), empty(h, w))
    return [normal(rng, v, 3), below(rng, v, f, 3), *camera(rng, h, w), bool(rng.random() < 0.5), fragments]


def fragments(native: Any, rng: Rng) -> tuple[Any, np.ndarray, np.ndarray]:
    """Return a drawn mesh, its image points and its faces."""
    vertices, faces, K, viewmat, _, out = rasterize_mesh(native, rng)
    native.rasterize_mesh(vertices, faces, K, viewmat, False, out)
    points = (vertices @ viewmat[:3, :3].T + viewmat[:3, 3]) @ K.T
    return out, np.ascontiguousarray(points, F32), faces


def edges(native: Any, rng: Rng, faces: np.ndarray) -> Any:
    """Return all edges of all faces; half of them have a second triangle."""
    vertices = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(I32)
    opposite = np.concatenate([faces[:, 2], faces[:, 0], faces[:, 1]]).astype(I32)
    own = np.tile(np.arange(len(faces), dtype=I32), 3)
    other = np.where(rng.random(len(own)) < 0.5, -1, below(rng, len(faces), len(own), dtype=I32))
    arrays = vertices, np.stack([own, other], 1), opposite
    return native.MeshEdges(*(np.ascontiguousarray(array) for array in arrays))


def interpolate_mesh(native: Any, rng: Rng) -> Arguments:
    (face_index, barycentric, _), points, faces = fragments(native, rng)
    c = int(rng.integers(1, 5))
    return [face_index, barycentric, normal(rng, len(points), c), faces, empty(*face_index.shape, c)]


def interpolate_mesh_backward(native: Any, rng: Rng) -> Arguments:
    face_index, barycentric, attributes, faces, out = interpolate_mesh(native, rng)
    gradients = [empty(*attributes.shape), empty(*barycentric.shape)]
    return [face_index, barycentric, attributes, faces, normal(rng, *out.shape), *gradients]


def barycentric_backward(native: Any, rng: Rng) -> Arguments:
    out, points, faces = fragments(native, rng)
    return [out, points, faces, normal(rng, *out.barycentric.shape), empty(*points.shape, dtype=F64)]


def sample_texture(native: Any, rng: Rng) -> Arguments:
    n, c = few(rng), int(rng.integers(1, 4))
    return [normal(rng, *picture(rng), c), normal(rng, n, 2), empty(n, c)]


def sample_texture_backward(native: Any, rng: Rng) -> Arguments:
    texture, uv, out = sample_texture(native, rng)
    return [texture, uv, normal(rng, *out.shape), empty(*texture.shape), empty(*uv.shape)]


def antialias(native: Any, rng: Rng) -> Arguments:
    out, points, faces = fragments(native, rng)
    shape = *out.face_index.shape, int(rng.integers(1, 4))
    return [out, points, faces, edges(native, rng, faces), normal(rng, *shape), empty(*shape)]


def antialias_backward(native: Any, rng: Rng) -> Arguments:
    *inputs, image, out = antialias(native, rng)
    return [*inputs, image, normal(rng, *out.shape), out, empty(*inputs[1].shape, dtype=F64)]


def mesh_loss(native: Any, rng: Rng) -> Arguments:
    out, points, faces = fragments(native, rng)
    size, texture, f = out.face_index.shape, normal(rng, few(rng), few(rng), 3), len(faces)
    surface = [normal(rng, *points.shape), normal(rng, f, 3, 2), np.abs(normal(rng, f)), texture, normal(rng, 9, 3)]
    target = native.LossTarget(normal(rng, *size, 3), np.abs(normal(rng, *size)), 0.1)
    gradients = [empty(*points.shape, dtype=F64), empty(*points.shape), empty(*texture.shape), empty(9, 3, dtype=F64)]
    drawn = native.LitSurface(*surface), target, empty(*size, 3), native.LossGradients(*gradients)
    return [out, points, faces, edges(native, rng, faces), *drawn]


def align_surface(native: Any, rng: Rng, v: int = 0) -> Arguments:
    f, texture = few(rng), picture(rng)
    uv = rng.random((f, 3, 2)).astype(F32)
    used = (rng.random(f) < 0.9).astype(U8)
    faces = below(rng, v or few(rng), f, 3)
    return [faces, uv, used, np.abs(normal(rng, *texture, 3)), np.abs(normal(rng, *texture)), 0.1, 3.0, 0.05]


def sighting(native: Any, rng: Rng) -> tuple[Any, Any, tuple[int, ...], Arguments]:
    """Return a surface, a picture of it, the texture's size, and the arguments that made the surface."""
    v, (h, w) = few(rng) + 2, picture(rng)
    made = align_surface(native, rng, v)
    light = normal(rng, 9, 3)
    seen = [normal(rng, v, 3), normal(rng, v, 3), *camera(rng, h, w), normal(rng, h, w, 3), np.ones((h, w), F32), light]
    return native.AlignSurface(*made), native.SightingArrays(*seen), made[4].shape, made


def align_mesh(native: Any, rng: Rng) -> Arguments:
    surface, seen, _, _ = sighting(native, rng)
    p, out = int(rng.integers(1, 6)), [empty(*seen.image.shape), empty(*seen.image.shape)]
    derivatives = native.AlignDerivatives(normal(rng, len(seen.vertices), 3, p), empty(p, p), empty(p))
    outputs = [one if rng.random() < 0.7 else None for one in (derivatives, *out)]
    return [surface, seen, int(rng.integers(0, 9)), *outputs]


def bake_texture(native: Any, rng: Rng) -> Arguments:
    surface, seen, texture, (faces, *_) = sighting(native, rng)
    texels = [below(rng, len(faces) + 1, *texture, dtype=I32) - I32(1), normal(rng, *texture, 3)]
    sums = native.TextureSums(empty(*texture), *(empty(*texture, 3) for _ in range(3)))
    return [surface, seen, *texels, sums]


def light_equations(native: Any, rng: Rng) -> Arguments:
    surface, seen, _, _ = sighting(native, rng)
    return [surface, seen, empty(3, 9, 9, dtype=F64), empty(3, 9, dtype=F64)]


MESHES: dict[str, Baseline] = {
    one.__name__: one
    for one in (
        rasterize_mesh, interpolate_mesh, interpolate_mesh_backward, barycentric_backward, sample_texture,
        sample_texture_backward, antialias, antialias_backward, mesh_loss, align_mesh, bake_texture, light_equations,
    )
} | {"AlignSurface": align_surface}  # fmt: skip
"""Functions that make the positional arguments of a valid call, by the name of the native function."""
