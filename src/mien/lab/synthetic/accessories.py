"""Build what a person wears: glasses, and a shirt over shoulders. The face model has none of it."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int

from mien.lab.synthetic.anatomy import NOSE_BRIDGE, Anatomy
from mien.lab.synthetic.arithmetic import SolidNoise, smoothstep, unit


@dataclass(frozen=True, eq=False)
class RigidMesh:
    """A rigid piece of mesh."""

    vertices: Float[np.ndarray, "v 3"]
    normals: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]


@dataclass(frozen=True, eq=False)
class Glasses:
    """A pair of glasses in the head frame."""

    frame: RigidMesh
    lenses: RigidMesh


def build_glasses(anatomy: Anatomy) -> Glasses:
    """Build rims around both eyes, a bridge over the nose, and temples to the ears."""
    pupils = np.stack([anatomy.landmarks[468], anatomy.landmarks[473]])
    middle = pupils.mean(0)
    front = float(anatomy.landmarks[[33, 133, 362, 263, 159, 386], 2].max()) + 0.010
    front = max(front, float(anatomy.landmarks[NOSE_BRIDGE, 2]) + 0.002)
    half_width, half_height = 0.026, 0.0195
    tubes, lenses = [], []
    for x in pupils[:, 0]:
        side = float(np.sign(x))
        center = np.array([x * 1.04, middle[1] - 0.003, front])
        turn = np.linspace(0, 2 * np.pi, 56, endpoint=False)
        shape = np.stack([_power(np.cos(turn), 0.62) * half_width, _power(np.sin(turn), 0.62) * half_height], -1)
        shape[:, 0] += 0.003 * side * np.abs(np.sin(turn))  # leaves room for the nose
        # The rims wrap around the face and lean forward at the top.
        depth = -0.25 * (center[0] + shape[:, 0]) ** 2 / 0.06 + 0.12 * shape[:, 1]
        rim = np.stack([center[0] + shape[:, 0], center[1] + shape[:, 1], front + depth + 0.004], -1)
        tubes.append(_tube(rim, 0.00165, closed=True))
        lenses.append(_lens(rim, side))
        tubes.append(_tube(_temple(anatomy, rim, side), 0.0016, closed=False))
    inner = pupils[:, 0] * 1.04 - np.sign(pupils[:, 0]) * half_width
    across = np.linspace(inner[0], inner[1], 12)
    arch = 1 - ((across - np.mean(inner)) / (0.5 * (inner[1] - inner[0]))) ** 2
    bridge = np.stack([across, middle[1] + 0.004 + 0.0035 * arch, front + 0.0035 + 0.002 * arch], -1)
    tubes.append(_tube(bridge, 0.0016, closed=False))
    return Glasses(_join(tubes), _join(lenses))


def _power(values: np.ndarray, exponent: float | np.ndarray) -> np.ndarray:
    return np.sign(values) * np.abs(values) ** exponent


def _temple(anatomy: Anatomy, rim: np.ndarray, side: float) -> Float[np.ndarray, "p 3"]:
    outer = rim[np.argmax(rim[:, 0] * side - 0.002 * np.abs(rim[:, 1] - rim[:, 1].max() + 0.012) / 0.01)]
    ears = anatomy.vertices[np.unique(anatomy.faces[anatomy.region("ears")])]
    ear = ears[ears[:, 0] * side > 0]
    z_ear = float(ear[:, 2].mean()) if len(ear) else float(anatomy.landmarks[234, 2])
    y_ear = float(ear[:, 1].max()) - 0.008 if len(ear) else float(outer[1])
    z = np.linspace(outer[2], z_ear - 0.012, 20)
    share = np.linspace(0, 1, 20)
    y = outer[1] + (y_ear - outer[1]) * share - 0.022 * smoothstep(0.85, 1.0, share)
    around = unit(np.stack([np.full(20, 0.07 * side), y, z], -1) - anatomy.skull_center)
    x_skin = np.abs(anatomy.skull_center[0] + around[:, 0] * anatomy.skull_radius(around))
    x = np.maximum(x_skin + 0.0025, np.abs(outer[0]) * (1 - share) + 0.06 * share)
    x[0] = np.abs(outer[0])
    x = np.lib.stride_tricks.sliding_window_view(np.pad(x, 2, mode="edge"), 5).mean(-1)
    x[0] = np.abs(outer[0])
    return np.stack([side * x, y, z], -1)


def _tube(path: Float[np.ndarray, "p 3"], radius: float, *, closed: bool, sides: int = 8) -> RigidMesh:
    tangent = unit(np.roll(path, -1, 0) - np.roll(path, 1, 0) if closed else np.gradient(path, axis=0))
    reference = np.where(np.abs(tangent[:, 2:3]) > 0.8, [[0.0, 1.0, 0.0]], [[0.0, 0.0, 1.0]])
    first = unit(np.cross(tangent, reference))
    second = np.cross(tangent, first)
    turn = np.linspace(0, 2 * np.pi, sides, endpoint=False)[None, :, None]
    normals = np.cos(turn) * first[:, None] + np.sin(turn) * second[:, None]
    vertices = path[:, None] + radius * normals
    return RigidMesh(_flat(vertices), _flat(normals), _grid_faces(len(path), sides, closed_rows=closed))


def _lens(rim: Float[np.ndarray, "p 3"], side: float) -> RigidMesh:
    center = rim.mean(0) + np.array([0, 0, 0.002])
    vertices = np.concatenate([center[None], rim])
    bulge = (rim - center) * np.array([8.0, 8.0, 0])
    normals = unit(np.concatenate([[[0.0, 0.0, 1.0]], bulge + np.array([0.25 * side, 0, 1.0])]))
    ring = np.arange(len(rim))
    faces = np.stack([np.zeros_like(ring), ring + 1, (ring + 1) % len(rim) + 1], -1)
    return RigidMesh(vertices.astype(np.float32), normals.astype(np.float32), faces.astype(np.int64))


def build_shirt(
    neck: Float[np.ndarray, " 3"], neck_size: tuple[float, float], shoulder_points: Float[np.ndarray, "p 3"], seed: int,
) -> RigidMesh:  # fmt: skip
    """Build shoulders in a shirt with a round collar, which covers the shoulders' points.

    `neck` is the middle of the neck at the height of the collar, `neck_size` its half width and half depth there.
    """
    wide_neck, deep_neck = neck_size
    noise = SolidNoise(seed + 77)
    turn = np.linspace(0, 2 * np.pi, 96, endpoint=False)
    # One ring per row: height above the collar, half width, half depth, shift forward (metres), exponent of the
    # superellipse.
    rings = np.array([
        [-0.012, 0.90 * wide_neck, 0.90 * deep_neck, 0.0, 1.0],
        [0.006, 1.05 * wide_neck, 1.05 * deep_neck, 0.0, 1.0],
        [0.004, 1.13 * wide_neck, 1.14 * deep_neck, 0.002, 1.0],
        [-0.006, 1.23 * wide_neck, 1.24 * deep_neck, 0.004, 1.0],
        [-0.018, 0.100, 0.088, 0.004, 0.95],
        [-0.034, 0.138, 0.100, 0.004, 0.9],
        [-0.052, 0.172, 0.108, 0.004, 0.85],
        [-0.075, 0.198, 0.114, 0.006, 0.8],
        [-0.110, 0.216, 0.120, 0.010, 0.8],
        [-0.170, 0.226, 0.126, 0.014, 0.8],
        [-0.400, 0.230, 0.130, 0.016, 0.8],
    ])  # fmt: skip
    dense = np.stack([np.interp(np.linspace(0, len(rings) - 1, 60), np.arange(len(rings)), c) for c in rings.T], -1)
    height, wide, deep, ahead, power = (dense[:, i, None] for i in range(5))
    cosine, sine = np.cos(turn)[None], np.sin(turn)[None]
    x = wide * _power(cosine, power)
    z = ahead + deep * _power(sine, power)
    # The collar is lower in front than at the nape.
    y = height - 0.13 * np.clip(z, -0.06, 0.06) * smoothstep(-0.12, 0.0, height)
    vertices = _laid_over(neck + np.stack(np.broadcast_arrays(x, y, z), -1), shoulder_points).reshape(-1, 3)
    folds = noise.octaves(vertices * np.array([1, 0.5, 1]), 0.06, 3) * smoothstep(
        -0.02, -0.08, vertices[:, 1] - neck[1]
    )
    faces = _grid_faces(60, 96, closed_rows=False)
    outwards = unit(vertices - (neck + np.array([0, -0.2, 0])))
    vertices = (vertices + 0.006 * folds[:, None] * outwards).astype(np.float32)
    corners = vertices[faces]
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], areas)
    normals = unit(normals)
    normals *= np.sign((normals * (vertices - vertices.mean(0))).sum(-1).sum() or 1.0)
    return RigidMesh(vertices, normals.astype(np.float32), faces)


def _laid_over(grid: Float[np.ndarray, "r c 3"], points: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "r c 3"]:
    """Lift the cloth smoothly until it is 5 mm above all points under it."""
    flat = grid.reshape(-1, 3)
    lift = np.zeros(len(flat))
    for start in range(0, len(flat), 256):
        part = flat[start : start + 256]
        away = np.hypot(part[:, None, 0] - points[:, 0], part[:, None, 2] - points[:, 2])
        above = np.where(away < 0.009, points[:, 1] + 0.005 - part[:, 1, None], 0)
        lift[start : start + 256] = np.clip(above.max(1, initial=0), 0, 0.05)
    smooth = lift.reshape(grid.shape[:2]).astype(np.float32)
    for _ in range(3):
        wrapped = np.concatenate([smooth[:, -6:], smooth, smooth[:, :6]], axis=1)
        smooth = np.maximum(cv2.blur(wrapped, (7, 7))[:, 6:-6], 0.97 * smooth)
    return grid + smooth[..., None] * np.array([0.0, 1.0, 0.0])


def _grid_faces(rows: int, columns: int, *, closed_rows: bool) -> Int[np.ndarray, "f 3"]:
    """Return the triangles of a grid whose rows are rings. With `closed_rows` the last row joins the first."""
    row = np.arange(rows if closed_rows else rows - 1)[:, None]
    column = np.arange(columns)[None]
    after, beside = (row + 1) % rows, (column + 1) % columns
    a, b, c, d = row * columns + column, row * columns + beside, after * columns + beside, after * columns + column
    return np.stack([a, b, c, a, c, d], -1).reshape(-1, 3).astype(np.int64)


def _flat(array: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(array.reshape(-1, 3).astype(np.float32))


def _join(parts: list[RigidMesh]) -> RigidMesh:
    vertices, faces = stack_meshes([(part.vertices, part.faces) for part in parts])
    return RigidMesh(vertices, np.concatenate([part.normals for part in parts]), faces)


def stack_meshes(
    meshes: Sequence[tuple[Float[np.ndarray, "_ 3"], Int[np.ndarray, "_ 3"]]],
) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Return the vertices (float32) and triangles of several meshes as one mesh."""
    offsets = np.cumsum([0] + [len(vertices) for vertices, _ in meshes[:-1]])
    vertices = np.concatenate([vertices for vertices, _ in meshes]).astype(np.float32)
    return vertices, np.concatenate([faces + offset for (_, faces), offset in zip(meshes, offsets, strict=True)])
