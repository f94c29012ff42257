"""A valid call of every native function, small and random: what `native_calls.py` makes invalid."""

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
    """Height and width."""
    return int(rng.choice([1, 3, 8, 33, 64])), int(rng.choice([6, 7, 16, 31, 65]))


def sigmoid(native: Any, rng: Rng) -> Arguments:
    shape = (few(rng), few(rng))
    return [normal(rng, *shape), empty(*shape)]


def sigmoid_backward(native: Any, rng: Rng) -> Arguments:
    n = few(rng)
    return [normal(rng, n), normal(rng, n), empty(n)]


# Faces

Sizes = tuple[int, int, int]


def sizes_of_face(rng: Rng) -> Sizes:
    """Vertices, expressions, free joints (the first joint is not free)."""
    return int(rng.choice([3, 15, 16, 50])), int(rng.integers(0, 6)), int(rng.integers(0, 4))


def make_face_model(native: Any, rng: Rng, sizes: Sizes | None = None) -> Arguments:
    v, e, j = sizes or sizes_of_face(rng)
    pose_basis = normal(rng, 9 * j, v, 3) if rng.random() < 0.5 else None
    bases = normal(rng, e, j + 1, 3), normal(rng, e, j + 1, 3)
    weights = np.abs(normal(rng, v, j + 1))
    parents = [int(rng.integers(-1, joint)) if joint else -1 for joint in range(j + 1)]
    return [normal(rng, e, v, 3), pose_basis, *bases, weights, parents, [False] + [True] * j]


def posing(native: Any, rng: Rng) -> tuple[Any, list[Any], Sizes, int]:
    """A model and the inputs of one to three timesteps."""
    sizes = v, e, j = sizes_of_face(rng)
    b = int(rng.integers(1, 4))
    head = [normal(rng, b, 3), normal(rng, b, 3)] if rng.random() < 0.7 else [None, None]
    inputs = [normal(rng, v, 3), normal(rng, j + 1, 3), normal(rng, b, e), normal(rng, b, j, 3), *head]
    return native.make_face_model(*make_face_model(native, rng, sizes)), inputs, sizes, b


def pose_face(native: Any, rng: Rng) -> Arguments:
    model, inputs, (v, _, _), b = posing(native, rng)
    return [model, *inputs, empty(b, v, 3), empty(b, v, 3)]


def pose_face_backward(native: Any, rng: Rng) -> Arguments:
    model, inputs, (v, e, j), b = posing(native, rng)
    outputs = [empty(b, v, 3), empty(b, j + 1, 3), empty(b, e), empty(b, j, 3), empty(b, 3), empty(b, 3)]
    return [model, *inputs, normal(rng, b, v, 3), normal(rng, b, v, 3), *outputs]


def head_poses(native: Any, rng: Rng) -> Arguments:
    b = few(rng)
    return [normal(rng, b, 3), normal(rng, b, 3), empty(b, 4, 4)]


def head_poses_backward(native: Any, rng: Rng) -> Arguments:
    b = few(rng)
    return [normal(rng, b, 3), normal(rng, b, 4, 4), empty(b, 3)]


def compose_rigid(native: Any, rng: Rng) -> Arguments:
    return [normal(rng, 4, 4), normal(rng, 4, 4), empty(4, 4)]


def compose_rigid_backward(native: Any, rng: Rng) -> Arguments:
    return [*(normal(rng, 4, 4) for _ in range(3)), empty(4, 4), empty(4, 4)]


# Meshes

VIEW = np.diag([1, -1, -1, 1]).astype(F32)


def camera(rng: Rng, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """K and viewmat of a camera 3 units before the origin."""
    focal = float(width)
    viewmat = VIEW.copy()
    viewmat[2, 3] = 3
    return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], F32), viewmat


def rasterize_mesh(native: Any, rng: Rng) -> Arguments:
    h, w = picture(rng)
    v, f = few(rng) + 2, few(rng)
    fragments = empty(h, w, dtype=I32), empty(h, w, 3), empty(h, w)
    return [normal(rng, v, 3), below(rng, v, f, 3), *camera(rng, h, w), bool(rng.random() < 0.5), *fragments]


def fragments(native: Any, rng: Rng) -> tuple[list[Any], np.ndarray, np.ndarray]:
    """face_index, barycentric and depth of a drawn mesh; its image points; its faces."""
    vertices, faces, K, viewmat, _, *out = rasterize_mesh(native, rng)
    native.rasterize_mesh(vertices, faces, K, viewmat, False, *out)
    points = (vertices @ viewmat[:3, :3].T + viewmat[:3, 3]) @ K.T
    return out, np.ascontiguousarray(points, F32), faces


def edges(rng: Rng, points: np.ndarray, faces: np.ndarray) -> list[np.ndarray]:
    """edge_vertices, edge_faces and opposite: all edges of all faces, half of them with a second triangle."""
    vertices = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(I32)
    opposite = np.concatenate([faces[:, 2], faces[:, 0], faces[:, 1]]).astype(I32)
    own = np.tile(np.arange(len(faces), dtype=I32), 3)
    other = np.where(rng.random(len(own)) < 0.5, -1, below(rng, len(faces), len(own), dtype=I32))
    return [np.ascontiguousarray(array) for array in (vertices, np.stack([own, other], 1), opposite)]


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
    return [*out, points, faces, normal(rng, *out[1].shape), empty(*points.shape, dtype=F64)]


def sample_texture(native: Any, rng: Rng) -> Arguments:
    n, c = few(rng), int(rng.integers(1, 4))
    return [normal(rng, *picture(rng), c), normal(rng, n, 2), empty(n, c)]


def sample_texture_backward(native: Any, rng: Rng) -> Arguments:
    texture, uv, out = sample_texture(native, rng)
    return [texture, uv, normal(rng, *out.shape), empty(*texture.shape), empty(*uv.shape)]


def antialias(native: Any, rng: Rng) -> Arguments:
    out, points, faces = fragments(native, rng)
    shape = *out[0].shape, int(rng.integers(1, 4))
    return [*out, points, faces, *edges(rng, points, faces), normal(rng, *shape), empty(*shape)]


def antialias_backward(native: Any, rng: Rng) -> Arguments:
    *inputs, image, out = antialias(native, rng)
    return [*inputs, image, normal(rng, *out.shape), out, empty(*inputs[3].shape, dtype=F64)]


def mesh_loss(native: Any, rng: Rng) -> Arguments:
    out, points, faces = fragments(native, rng)
    size, texture, f = out[0].shape, normal(rng, few(rng), few(rng), 3), len(faces)
    surface = [normal(rng, *points.shape), normal(rng, f, 3, 2), np.abs(normal(rng, f)), texture, normal(rng, 9, 3)]
    target = [normal(rng, *size, 3), np.abs(normal(rng, *size)), 0.1, empty(*size, 3)]
    gradients = [empty(*points.shape, dtype=F64), empty(*points.shape), empty(*texture.shape), empty(9, 3, dtype=F64)]
    return [*out, points, faces, *edges(rng, points, faces), *surface, *target, *gradients]


def align_surface(native: Any, rng: Rng, v: int = 0) -> Arguments:
    f, texture = few(rng), picture(rng)
    uv = rng.random((f, 3, 2)).astype(F32)
    used = (rng.random(f) < 0.9).astype(U8)
    faces = below(rng, v or few(rng), f, 3)
    return [faces, uv, used, np.abs(normal(rng, *texture, 3)), np.abs(normal(rng, *texture)), 0.1, 3.0, 0.05]


def sighting(native: Any, rng: Rng) -> tuple[Any, list[Any], tuple[int, ...], Arguments]:
    """A surface, and a picture of it: vertices, normals, K, viewmat, image, mask, light."""
    v, (h, w) = few(rng) + 2, picture(rng)
    made = align_surface(native, rng, v)
    light = normal(rng, 9, 3)
    seen = [normal(rng, v, 3), normal(rng, v, 3), *camera(rng, h, w), normal(rng, h, w, 3), np.ones((h, w), F32), light]
    return native.AlignSurface(*made), seen, made[4].shape, made


def align_mesh(native: Any, rng: Rng) -> Arguments:
    surface, seen, _, _ = sighting(native, rng)
    p, out = int(rng.integers(1, 6)), [empty(*seen[4].shape), empty(*seen[4].shape)]
    derivatives = [normal(rng, len(seen[0]), 3, p), empty(p, p), empty(p)] if rng.random() < 0.7 else [None] * 3
    return [
        surface,
        *seen,
        int(rng.integers(0, 9)),
        *derivatives,
        *(one if rng.random() < 0.7 else None for one in out),
    ]


def bake_texture(native: Any, rng: Rng) -> Arguments:
    surface, seen, texture, (faces, *_) = sighting(native, rng)
    texels = [below(rng, len(faces) + 1, *texture, dtype=I32) - I32(1), normal(rng, *texture, 3)]
    return [surface, *seen, *texels, empty(*texture), *(empty(*texture, 3) for _ in range(3))]


def light_equations(native: Any, rng: Rng) -> Arguments:
    surface, seen, _, _ = sighting(native, rng)
    return [surface, *seen, empty(3, 9, 9, dtype=F64), empty(3, 9, dtype=F64)]


# Rigs

FRAME = 20
"""Numbers of a triangle's frame (TRIANGLE_FRAME_FLOATS)."""


def rig(rng: Rng, v: int) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """faces, face_index, and local means, quats, log_scales."""
    f, n = few(rng), few(rng)
    return below(rng, v, f, 3), below(rng, f, n), [normal(rng, n, 3), normal(rng, n, 4), normal(rng, n, 3)]


def world(n: int, b: int) -> list[np.ndarray]:
    return [empty(b, n, 3), empty(b, n, 4), empty(b, n, 3)]


def rig_forward(native: Any, rng: Rng) -> Arguments:
    b, v = int(rng.integers(1, 3)), few(rng) + 2
    faces, face_index, local = rig(rng, v)
    return [normal(rng, b, v, 3), faces, face_index, *local, empty(b, len(faces), FRAME), *world(len(face_index), b)]


def make_rig_topology(native: Any, rng: Rng) -> Arguments:
    v = few(rng) + 2
    faces, face_index, _ = rig(rng, v)
    return [v, faces, face_index]


def rig_backward(native: Any, rng: Rng) -> Arguments:
    vertices, faces, face_index, *rest = rig_forward(native, rng)
    native.rig_forward(vertices, faces, face_index, *rest)
    *local, frames, _, _, scales = rest
    topology = native.make_rig_topology(vertices.shape[1], faces, face_index)
    by_world = [normal(rng, *array.shape) for array in world(len(face_index), len(vertices))]
    outputs = [empty(*array.shape) for array in local] + [empty(*vertices.shape)]
    return [topology, vertices, *local, frames, scales, *by_world, *outputs]


def ride(native: Any, rng: Rng) -> Arguments:
    sizes = v, e, j = sizes_of_face(rng)
    model = native.make_face_model(*make_face_model(native, rng, sizes))
    faces, face_index, local = rig(rng, v)
    topology, n = native.make_rig_topology(v, faces, face_index), len(face_index)
    face = [normal(rng, v, 3), normal(rng, j + 1, 3), normal(rng, 1, e), normal(rng, 1, j, 3)]
    head = [normal(rng, 1, 3), normal(rng, 1, 3), bool(rng.random() < 0.5)]
    return [model, topology, *face, *head, *local, normal(rng, n), *world(n, 1), empty(n), empty(1, 4, 4)]


def ride_backward(native: Any, rng: Rng) -> Arguments:
    arguments = ride(native, rng)
    own = native.ride(*arguments)
    *inputs, _, _, scales, opacities, _ = arguments
    n = len(opacities)
    by_world = [normal(rng, *array.shape) for array in world(n, 1)] + [normal(rng, n), normal(rng, 1, 4, 4)]
    local = [empty(*array.shape) for array in inputs[9:13]]
    face = [empty(*array.shape) for array in inputs[4:8]] if rng.random() < 0.7 else [None] * 4
    return [own, *inputs, scales, opacities, *by_world, *local, *face]


# Pictures of Gaussians


def view(rng: Rng, height: int, width: int) -> tuple[Any, ...]:
    n, k = int(rng.choice([0, 1, 5, 17, 300])), int(rng.choice([1, 4, 9, 16]))
    scales = np.exp(normal(rng, n, 3) - 3).astype(F32)
    gaussians = [
        normal(rng, n, 3, scale=0.5),
        normal(rng, n, 4),
        scales,
        rng.random(n).astype(F32),
        normal(rng, n, k, 3),
    ]
    K, viewmat = camera(rng, height, width)
    out = empty(height, width, 3), empty(height, width), empty(n, dtype=I32)
    return *gaussians, np.ones(3, F32), viewmat, K, *out


def rasterize_forward(native: Any, rng: Rng) -> Arguments:
    return list(view(rng, *picture(rng)))


def rasterize_views(native: Any, rng: Rng) -> Arguments:
    return [[view(rng, *picture(rng)) for _ in range(int(rng.integers(1, 3)))], bool(rng.random() < 0.7)]


def rasterize_views_backward(native: Any, rng: Rng) -> Arguments:
    views, _ = rasterize_views(native, rng)
    tasks = []
    for own, frame in zip(views, native.rasterize_views(views, True), strict=True):
        gaussians, (image, alpha, _) = list(own[:5]), own[8:]
        by_alpha = normal(rng, *alpha.shape) if rng.random() < 0.5 else None
        gradients = [empty(*array.shape) for array in gaussians] + [empty(len(own[0]), 2), empty(4, 4), empty(3, 3)]
        tasks.append((frame, *gaussians, image, alpha, normal(rng, *image.shape), by_alpha, *gradients))
    return [tasks]


# Training


def photometric_loss(native: Any, rng: Rng) -> Arguments:
    h, w = picture(rng)
    left, top = int(rng.integers(0, w)), int(rng.integers(0, h))
    box = (left, top, int(rng.integers(0, w - left + 1)), int(rng.integers(0, h - top + 1)))
    target = below(rng, 256, h, w, 3, dtype=U8) if rng.random() < 0.5 else normal(rng, h, w, 3)
    drawn = np.maximum(normal(rng, h, w), 0) if rng.random() < 0.5 else None
    gradient = empty(h, w, 3) if rng.random() < 0.7 else None
    return [box, (0.8, 0.2), normal(rng, h, w, 3), target, drawn, gradient, empty()]


def adam_update(native: Any, rng: Rng) -> Arguments:
    def task() -> tuple[Any, ...]:
        shape = few(rng), int(rng.integers(1, 4))
        moments = normal(rng, *shape), np.abs(normal(rng, *shape)), np.array(rng.integers(0, 9), F32)
        return normal(rng, *shape), normal(rng, *shape), *moments, 0.01

    return [[task() for _ in range(int(rng.integers(1, 3)))]]


def triangle_penalties(native: Any, rng: Rng) -> Arguments:
    n = few(rng)
    inputs = normal(rng, n, 3), normal(rng, n, 3), below(rng, 3, n, dtype=I32)
    return [(1.0, 0.6), (0.01, 1.0), *inputs, empty(n, 3), empty(n, 3), empty(), empty()]


def observe_view(native: Any, rng: Rng) -> Arguments:
    n = few(rng)
    inputs = normal(rng, n, 2), below(rng, 3, n, dtype=I32), normal(rng, n)
    return [(2.0, 3.0), *inputs, empty(n), empty(n), empty(n, dtype=I32), empty(n)]


def mean_squared_difference(native: Any, rng: Rng) -> Arguments:
    size = *picture(rng), 3
    return [normal(rng, *size), below(rng, 256, *size, dtype=U8)]


def box_of_nonzero(native: Any, rng: Rng) -> Arguments:
    return [np.maximum(normal(rng, *picture(rng)) - 2, 0).astype(F32)]


BASELINES: dict[str, Baseline] = {
    one.__name__: one
    for one in (
        sigmoid, sigmoid_backward, make_face_model, pose_face, pose_face_backward, head_poses, head_poses_backward,
        compose_rigid, compose_rigid_backward, rasterize_mesh, interpolate_mesh, interpolate_mesh_backward,
        barycentric_backward, sample_texture, sample_texture_backward, antialias, antialias_backward, mesh_loss,
        align_mesh, bake_texture, light_equations, rig_forward, make_rig_topology, rig_backward, ride, ride_backward,
        rasterize_forward, rasterize_views, rasterize_views_backward, photometric_loss, adam_update,
        triangle_penalties, observe_view, mean_squared_difference, box_of_nonzero,
    )
} | {
    "AlignSurface": align_surface,
    "recycled": lambda native, rng: [[few(rng), few(rng)]],
    "thread_count": lambda native, rng: [],
    "set_thread_count": lambda native, rng: [int(rng.integers(1, 4))],
    "rasterize_isa": lambda native, rng: [],
    "set_rasterize_isa": lambda native, rng: [str(rng.choice(["avx512", "avx2", "sse4", "baseline", ""]))],
}  # fmt: skip
"""By name: what makes the positional arguments of a valid call."""
