"""Make a valid call of every native function, small and random, for `native_calls.py` to mutate."""

from typing import Any

import numpy as np
from native_mesh_baselines import (
    F32,
    I32,
    MESHES,
    U8,
    Arguments,
    Baseline,
    Rng,
    below,
    camera,
    empty,
    few,
    normal,
    picture,
)


def of(*arrays: str) -> Baseline:
    """Return a baseline of arrays, such as "n 3" of random numbers, or "=n 3" to be filled; letters are lengths."""

    def make(native: Any, rng: Rng) -> Arguments:
        lengths: dict[str, int] = {}

        def length(name: str) -> int:
            if name.isdigit():
                return int(name)
            own = {"k": int(rng.integers(0, 5)), "r": int(rng.integers(1, 9))}
            return lengths.setdefault(name, own.get(name, few(rng)))

        shapes = [(array[0] == "=", [length(name) for name in array.removeprefix("=").split()]) for array in arrays]
        return [empty(*shape) if filled else normal(rng, *shape) for filled, shape in shapes]

    return make


# Changes with the expression


def expression_change(native: Any, rng: Rng) -> Arguments:
    shape, r = (few(rng), *([3] if rng.random() < 0.5 else [])), int(rng.integers(1, 9))
    return [normal(rng, *shape, r), normal(rng, r), empty(*shape)]


def expression_change_backward(native: Any, rng: Rng) -> Arguments:
    shape, r = (few(rng), *([3] if rng.random() < 0.5 else [])), int(rng.integers(1, 9))
    return [normal(rng, *shape, r), normal(rng, r), normal(rng, *shape), empty(*shape, r), empty(r)]


# Blended features


def network_of(native: Any, rng: Rng) -> tuple[Any, list[Any], tuple[int, ...]]:
    """Return a network, bases in both orders, and the numbers of Gaussians, features, hidden values and outputs."""
    n, f, x, h, o = few(rng), *(int(rng.integers(1, 20)) for _ in range(4))
    layers = normal(rng, h, f + x), normal(rng, h), normal(rng, o, h), normal(rng, o)
    k, j = int(rng.integers(0, 5)), int(rng.integers(0, 4))
    bases = [
        native.FeatureBases(normal(rng, n, k, f), normal(rng, k), False),
        native.FeatureBases(normal(rng, j, n, f), normal(rng, j), True),
    ]
    return native.FeatureNetwork(normal(rng, n, f), normal(rng, n, x), *layers), bases, (n, f, h, o)


def feature_network(native: Any, rng: Rng) -> Arguments:
    network, bases, (n, f, h, o) = network_of(native, rng)
    kept = native.FeatureKept(empty(n, f), empty(n, -(-h // 16) * 16)) if rng.random() < 0.5 else None
    return [network, bases, kept, empty(n, o - 1), empty(n)]


def feature_network_backward(native: Any, rng: Rng) -> Arguments:
    network, bases, (n, f, h, o) = network_of(native, rng)
    kept = native.FeatureKept(normal(rng, n, f), normal(rng, n, -(-h // 16) * 16))
    by_layers = [np.empty_like(array) for array in network[2:]]
    by_inputs = empty(sum(len(one.inputs) for one in bases))
    by_own = np.empty_like(network.own) if rng.random() < 0.5 else empty(0, 0)
    gradients = native.FeatureGradients(
        normal(rng, n, o - 1), normal(rng, n), empty(n, f), *by_layers, by_inputs, by_own
    )
    return [network, bases, kept, gradients]


def factored_update(native: Any, rng: Rng) -> Arguments:
    n, k, f, terms = few(rng), int(rng.integers(0, 5)), int(rng.integers(1, 20)), int(rng.integers(0, 4))
    moments = np.abs(normal(rng, n, f)), np.abs(normal(rng, n))
    rows, columns = ([normal(rng, *shape) for _ in range(terms)] for shape in ((n, f), (k,)))
    return [normal(rng, n, k, f), rows, columns, *moments, 0.01]


def point_layers(native: Any, rng: Rng) -> tuple[list[Any], Any, int]:
    n, widths, layers = few(rng), [int(rng.integers(1, 20))], []
    for index in range(int(rng.integers(1, 5))):
        extra = int(rng.integers(-1, index)) if index > 0 else -1
        reads = widths[-1] + (widths[extra] if extra >= 0 else 0)
        widths.append(int(rng.integers(1, 40)))
        layers.append([normal(rng, widths[-1], reads), normal(rng, widths[-1]), int(rng.integers(0, 3)), extra])
    layers[-1][2] = 0
    kept = sum(-(-width // 16) * 16 for width in widths[1:-1])
    return [native.PointLayer(*layer) for layer in layers], normal(rng, n, widths[0]), kept


def point_network(native: Any, rng: Rng) -> Arguments:
    layers, inputs, kept = point_layers(native, rng)
    room = empty(len(inputs), kept) if rng.random() < 0.5 else None
    return [layers, inputs, room, empty(len(inputs), len(layers[-1].bias))]


def point_network_backward(native: Any, rng: Rng) -> Arguments:
    layers, inputs, kept = point_layers(native, rng)
    gradients = [native.PointLayerGradients(*(np.empty_like(array) for array in layer[:2])) for layer in layers]
    by_inputs = np.empty_like(inputs) if rng.random() < 0.5 else None
    by_outputs = normal(rng, len(inputs), len(layers[-1].bias))
    return [layers, inputs, normal(rng, len(inputs), kept), by_outputs, gradients, by_inputs]


def activate_points(native: Any, rng: Rng) -> Arguments:
    n = few(rng)
    raw = native.RawPoints(normal(rng, n, 11), normal(rng, n, 3), normal(rng, n, 4), normal(rng, n), normal(rng, n, 3))
    out = native.ActivatedPoints(empty(n, 3), empty(n, 4), empty(n), empty(n, 1, 3))
    return [raw, 0.5, 0.1, out]


def skin_arrays(native: Any, rng: Rng) -> tuple[Any, tuple[int, int, int]]:
    n, b, k = few(rng), int(rng.integers(0, 4)), int(rng.integers(1, 7))
    points = normal(rng, n, 3), normal(rng, b, n, 3), normal(rng, n, k), normal(rng, k, 3, 4), normal(rng, b, k, 3, 4)
    return native.SkinPoints(*points), (n, b, k)


def skin_points(native: Any, rng: Rng) -> Arguments:
    points, (n, b, _) = skin_arrays(native, rng)
    return [points, empty(b, n, 3)]


def skin_points_backward(native: Any, rng: Rng) -> Arguments:
    points, (n, b, k) = skin_arrays(native, rng)
    filled = empty(n, 3), empty(b, n, 3), empty(n, k), empty(b, k, 3, 4)
    return [points, native.SkinPointsGradients(normal(rng, b, n, 3), *filled)]


# Faces

Sizes = tuple[int, int, int]


def sizes_of_face(rng: Rng) -> Sizes:
    """Return the numbers of vertices, expressions and free joints (the first joint is not free)."""
    return int(rng.choice([3, 15, 16, 50])), int(rng.integers(0, 6)), int(rng.integers(0, 4))


def make_face_model(native: Any, rng: Rng, sizes: Sizes | None = None) -> Arguments:
    v, e, j = sizes or sizes_of_face(rng)
    pose_basis = normal(rng, 9 * j, v, 3) if rng.random() < 0.5 else None
    bases = normal(rng, e, j + 1, 3), normal(rng, e, j + 1, 3)
    weights = np.abs(normal(rng, v, j + 1))
    parents = [int(rng.integers(-1, joint)) if joint else -1 for joint in range(j + 1)]
    return [normal(rng, e, v, 3), pose_basis, *bases, weights, parents, [False] + [True] * j]


def posing(native: Any, rng: Rng) -> tuple[Any, Any, Sizes, int]:
    """Return a model, the inputs of one to three timesteps, and the sizes of both."""
    sizes = v, e, j = sizes_of_face(rng)
    b = int(rng.integers(1, 4))
    head = [normal(rng, b, 3), normal(rng, b, 3)] if rng.random() < 0.7 else [None, None]
    inputs = [normal(rng, v, 3), normal(rng, j + 1, 3), normal(rng, b, e), normal(rng, b, j, 3), *head]
    return native.make_face_model(*make_face_model(native, rng, sizes)), native.FaceArrays(*inputs), sizes, b


def pose_face(native: Any, rng: Rng) -> Arguments:
    model, face, (v, _, _), b = posing(native, rng)
    return [model, face, empty(b, v, 3), empty(b, v, 3)]


def pose_face_backward(native: Any, rng: Rng) -> Arguments:
    model, face, (v, e, j), b = posing(native, rng)
    outputs = [empty(b, v, 3), empty(b, j + 1, 3), empty(b, e), empty(b, j, 3), empty(b, 3), empty(b, 3)]
    return [model, face, normal(rng, b, v, 3), normal(rng, b, v, 3), native.FaceArrays(*outputs)]


# Rigs

FRAME = 20
"""Number of floats in a triangle's frame (TRIANGLE_FRAME_FLOATS)."""


def rig(rng: Rng, v: int) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Return faces, face_index, and local means, quats and log_scales."""
    f, n = few(rng), few(rng)
    return below(rng, v, f, 3), below(rng, f, n), [normal(rng, n, 3), normal(rng, n, 4), normal(rng, n, 3)]


def world(n: int, b: int) -> list[np.ndarray]:
    return [empty(b, n, 3), empty(b, n, 4), empty(b, n, 3)]


def rig_forward(native: Any, rng: Rng) -> Arguments:
    b, v = int(rng.integers(1, 3)), few(rng) + 2
    faces, face_index, local = rig(rng, v)
    outputs = empty(b, len(faces), FRAME), native.WorldShapes(*world(len(face_index), b))
    return [normal(rng, b, v, 3), faces, face_index, native.LocalShapes(*local), *outputs]


def make_rig_topology(native: Any, rng: Rng) -> Arguments:
    v = few(rng) + 2
    faces, face_index, _ = rig(rng, v)
    return [v, faces, face_index]


def rig_backward(native: Any, rng: Rng) -> Arguments:
    vertices, faces, face_index, local, frames, posed = rig_forward(native, rng)
    native.rig_forward(vertices, faces, face_index, local, frames, posed)
    topology = native.make_rig_topology(vertices.shape[1], faces, face_index)
    by_world = native.WorldShapes(*(normal(rng, *array.shape) for array in posed))
    outputs = native.LocalShapes(*(empty(*array.shape) for array in local)), empty(*vertices.shape)
    return [topology, vertices, local, frames, posed.scales, by_world, *outputs]


def ride(native: Any, rng: Rng) -> Arguments:
    sizes = v, e, j = sizes_of_face(rng)
    model = native.make_face_model(*make_face_model(native, rng, sizes))
    faces, face_index, local = rig(rng, v)
    topology, n = native.make_rig_topology(v, faces, face_index), len(face_index)
    parameters = normal(rng, 1, e), normal(rng, 1, j, 3), normal(rng, 1, 3), normal(rng, 1, 3)
    face = native.FaceArrays(normal(rng, v, 3), normal(rng, j + 1, 3), *parameters)
    posed = native.PosedGaussians(*world(n, 1), empty(n), empty(1, 4, 4))
    return [model, topology, bool(rng.random() < 0.5), face, native.LocalGaussians(*local, normal(rng, n)), posed]


def ride_backward(native: Any, rng: Rng) -> Arguments:
    model, topology, in_head, face, local, posed = ride(native, rng)
    own = native.ride(model, topology, in_head, face, local, posed)
    by_posed = native.PosedGaussians(*(normal(rng, *array.shape) for array in posed))
    by_local = native.LocalGaussians(*(empty(*array.shape) for array in local))
    by_face = native.FaceParameterGradients(*(empty(*array.shape) for array in face[2:]))
    moved = by_face if rng.random() < 0.7 else None
    return [own, model, topology, face, local, posed.scales, posed.opacities, by_posed, by_local, moved]


# Pictures of Gaussians


def view(native: Any, rng: Rng, height: int, width: int) -> Any:
    n, k = int(rng.choice([0, 1, 5, 17, 300])), int(rng.choice([1, 4, 9, 16]))
    scales = np.exp(normal(rng, n, 3) - 3).astype(F32)
    shapes = normal(rng, n, 3, scale=0.5), normal(rng, n, 4), scales
    gaussians = native.GaussianArrays(*shapes, rng.random(n).astype(F32), normal(rng, n, k, 3))
    K, viewmat = camera(rng, height, width)
    out = empty(height, width, 3), empty(height, width), empty(n, dtype=I32)
    return native.RasterizeView(gaussians, np.ones(3, F32), viewmat, K, *out)


def rasterize_views(native: Any, rng: Rng) -> Arguments:
    views = [view(native, rng, *picture(rng)) for _ in range(int(rng.integers(1, 3)))]
    return [views, bool(rng.random() < 0.7)]


def rasterize_views_backward(native: Any, rng: Rng) -> Arguments:
    views, _ = rasterize_views(native, rng)
    tasks = []
    for own, frame in zip(views, native.rasterize_views(views, True), strict=True):
        known = frame, own.gaussians, own.image, own.alpha
        by_alpha = normal(rng, *own.alpha.shape) if rng.random() < 0.5 else None
        gradients = native.GaussianArrays(*(empty(*array.shape) for array in own.gaussians))
        of_view = empty(len(gradients.means), 2), empty(4, 4), empty(3, 3)
        by_image = normal(rng, *own.image.shape)
        tasks.append(native.RasterizeGradients(*known, by_image, by_alpha, gradients, *of_view))
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


def factored_adam_update(native: Any, rng: Rng) -> Arguments:
    values, rows, columns, *_ = factored_update(native, rng)
    first, second = normal(rng, *values.shape), np.abs(normal(rng, *values.shape))
    return [values, rows, columns, first, second, np.array(rng.integers(0, 9), np.float32), 0.01]


def adam_update(native: Any, rng: Rng) -> Arguments:
    def task() -> Any:
        shape = few(rng), int(rng.integers(1, 4))
        moments = normal(rng, *shape), np.abs(normal(rng, *shape)), np.array(rng.integers(0, 9), F32)
        return native.AdamTask(normal(rng, *shape), normal(rng, *shape), *moments, 0.01)

    return [[task() for _ in range(int(rng.integers(1, 3)))]]


def triangle_penalties(native: Any, rng: Rng) -> Arguments:
    n = few(rng)
    inputs = normal(rng, n, 3), normal(rng, n, 3), below(rng, 3, n, dtype=I32)
    return [(1.0, 0.6), (0.01, 1.0), *inputs, empty(n, 3), empty(n, 3), empty(), empty()]


def observe_view(native: Any, rng: Rng) -> Arguments:
    n = few(rng)
    inputs = normal(rng, n, 2), below(rng, 3, n, dtype=I32), normal(rng, n)
    return [(2.0, 3.0), *inputs, empty(n), empty(n), empty(n, dtype=I32), empty(n)]


def keep_on_surface(native: Any, rng: Rng) -> Arguments:
    n, f = few(rng), int(rng.integers(1, 9))
    pulls = normal(rng, f, 4) if rng.random() < 0.5 else None
    shapes = normal(rng, n, 3), normal(rng, n, 4), normal(rng, n, 3)
    return [below(rng, f, n, dtype=np.int64), normal(rng, f, 5), 1.6, *shapes, pulls, normal(rng, n, 3)]


def clear_rows(native: Any, rng: Rng) -> Arguments:
    n = few(rng)
    return [below(rng, 2, n, dtype=U8), [normal(rng, n), normal(rng, n, 3), normal(rng, n, 2, 4)]]


def mean_squared_difference(native: Any, rng: Rng) -> Arguments:
    size = *picture(rng), 3
    return [normal(rng, *size), below(rng, 256, *size, dtype=U8)]


def absolute_difference(native: Any, rng: Rng) -> Arguments:
    size = picture(rng)
    return [normal(rng, *size), below(rng, 256, *size, dtype=U8), 0.5, empty(*size), empty()]


def box_of_nonzero(native: Any, rng: Rng) -> Arguments:
    return [np.maximum(normal(rng, *picture(rng)) - 2, 0).astype(F32)]


def composite(native: Any, rng: Rng) -> Arguments:
    height, width = picture(rng)
    image, matte = below(rng, 256, height, width, 3, dtype=U8), below(rng, 256, height, width, dtype=U8)
    left, top = int(rng.integers(0, width)), int(rng.integers(0, height))
    box = [left, top, int(rng.integers(0, width - left + 1)), int(rng.integers(0, height - top + 1))]
    return [image, matte, [1, 2, 255], box, empty(height, width, 3, dtype=U8)]


BASELINES: dict[str, Baseline] = {
    one.__name__: one
    for one in (
        expression_change, expression_change_backward, feature_network, feature_network_backward, factored_update,
        point_network, point_network_backward, skin_points, skin_points_backward, activate_points, make_face_model,
        pose_face, pose_face_backward, rig_forward, make_rig_topology, rig_backward, ride, ride_backward,
        rasterize_views, rasterize_views_backward, photometric_loss, adam_update, factored_adam_update,
        triangle_penalties, observe_view, keep_on_surface, clear_rows, mean_squared_difference, absolute_difference,
        box_of_nonzero, composite,
    )
} | {
    **MESHES,
    "sigmoid": of("n m", "=n m"),
    "sigmoid_backward": of("n", "n", "=n"),
    "expression_activations": of("i", "i", "i r", "k r", "=r"),
    "expression_activations_backward": of("i", "i", "i r", "k r", "r", "=i"),
    "add_bone": of("n 3", "n", "3 4", "n 3"),
    "head_poses": of("b 3", "b 3", "=b 4 4"),
    "head_poses_backward": of("b 3", "b 4 4", "=b 3"),
    "compose_rigid": of("4 4", "4 4", "=4 4"),
    "compose_rigid_backward": of("4 4", "4 4", "4 4", "=4 4", "=4 4"),
    "recycled": lambda native, rng: [[few(rng), few(rng)]],
    "thread_count": lambda native, rng: [],
    "set_thread_count": lambda native, rng: [int(rng.integers(1, 4))],
    "rasterize_isa": lambda native, rng: [],
    "set_rasterize_isa": lambda native, rng: [str(rng.choice(["avx512", "avx2", "sse4", "baseline", ""]))],
}  # fmt: skip
"""Functions that make the positional arguments of a valid call, by the name of the native function."""
