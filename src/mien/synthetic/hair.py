"""Strands of hair: scalp, brows and lashes. They are curves with a width, drawn as ribbons that face the camera."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from mien.exact import dot, length, mixed, product
from mien.synthetic.anatomy import BROWS_LOWER, BROWS_UPPER, LOWER_LIDS, SIDES, UPPER_LIDS, Anatomy, resample
from mien.synthetic.noise import SolidNoise, smoothstep


@dataclass(frozen=True, eq=False)
class Strands:
    """n strands of s points that move rigidly with the head."""

    points: Float[np.ndarray, "n s 3"]
    """Positions in the head frame, in metres."""
    widths: Float[np.ndarray, "n s"]
    """Widths in metres."""
    colors: Float[np.ndarray, "n s 3"]
    """Linear albedo, darker where hair shades itself."""
    outwards: Float[np.ndarray, "n s 3"]
    """Unit directions away from the surface under the hair."""

    @cached_property
    def tangents(self) -> Float[np.ndarray, "n s 3"]:
        """Unit directions along the strands."""
        return unit(np.gradient(self.points, axis=1).astype(np.float32))

    def ribbon_vertices(self, viewpoint: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "v 3"]:
        """Return two vertices per point, one width apart, across the view from `viewpoint` (head frame)."""
        across = np.cross(self.tangents, viewpoint - self.points)
        return ribbon(self.points, unit(across), self.widths)


def ribbon_faces(strands: int, points: int) -> Int[np.ndarray, "f 3"]:
    """Return the triangles over `ribbon_vertices`, given the numbers of strands and of points per strand."""
    start = 2 * (np.arange(strands)[:, None] * points + np.arange(points - 1))
    quads = np.stack([start, start + 1, start + 3, start, start + 3, start + 2], -1)
    return quads.reshape(-1, 3).astype(np.int64)


def ribbon(points: np.ndarray, across: np.ndarray, widths: np.ndarray) -> Float[np.ndarray, "v 3"]:
    """Return the left and right edges of every point."""
    half = 0.5 * widths[..., None] * across
    return np.stack([points - half, points + half], axis=2).reshape(-1, 3).astype(np.float32)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Return the vectors scaled to length 1."""
    return vectors * (1 / np.sqrt(dot(vectors, vectors) + 1e-20))[..., None]


def along(vectors: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return scalar products with one direction, in the dtype of `vectors`."""
    x, y, z = direction.tolist()
    return vectors[..., 0] * x + vectors[..., 1] * y + vectors[..., 2] * z


def short_hair(anatomy: Anatomy, color: Float[np.ndarray, " 3"], seed: int, count: int = 9000) -> Strands:
    """Grow short hair with a side parting: long on top, short at the sides and the nape.

    A strand follows the skull in the direction in which it is combed, at the height of its layer, so it never enters
    the head.
    """
    random, noise = np.random.default_rng([seed, 3]), SolidNoise(seed + 31)
    roots = scalp_points(anatomy, count, random)
    part = random.choice([-1.0, 1.0]) * 0.028
    centre = anatomy.skull_centre
    direction = unit(roots - centre)
    top = smoothstep(0.45, 0.8, direction[:, 1])  # 1 on top of the head, 0 at its sides
    low = smoothstep(0.05, -0.25, direction[:, 1])
    reach = (0.024 - 0.012 * low + 0.055 * top) * random.uniform(0.75, 1.15, count) * (1 + 0.25 * noise(roots, 0.03))
    stray = random.uniform(size=count) < 0.025
    layer = random.uniform(0.12, 1.0, count) + np.where(stray, random.uniform(0, 0.5, count), 0)
    parting = 1 - 0.75 * np.exp(-(((roots[:, 0] - part) / 0.006) ** 2)) * (roots[:, 2] > centre[2] - 0.04)
    height = (0.008 - 0.004 * low + 0.017 * top) * layer * parting * (1 + 0.3 * noise(roots, 0.025))
    wobble = random.normal(0, 1, (count, 3)) * np.where(stray, 0.28, 0.09)[:, None]
    steps = 10
    points = np.empty((count, steps, 3), np.float32)
    outwards = np.empty_like(points)
    for step in range(steps):
        place = step / (steps - 1)
        rise = height * (1 - np.exp(-place * reach / (0.5 * height + 1e-4))) * (1 - 0.3 * place**2)
        radius = anatomy.skull_radius(direction) + rise - 0.001 * (step == 0)
        points[:, step] = centre + direction * radius[:, None]
        outwards[:, step] = direction
        combed = _combed(points[:, step], centre, part, noise) + wobble
        combed -= dot(combed, direction)[:, None] * direction
        direction = unit(direction + unit(combed) * (reach / (steps - 1) / radius)[:, None])
    taper = np.linspace(1, 0.45, steps) * random.uniform(0.75, 1.25, count)[:, None]
    shade = 0.35 + 0.65 * np.clip(layer, 0, 1)[:, None] * smoothstep(-0.15, 0.5, np.linspace(0, 1, steps))
    tint = np.exp(0.16 * random.normal(size=(count, 1)) + 0.2 * noise(roots, 0.012)[:, None])
    colors = color * (shade * tint)[..., None]
    return Strands(points, (0.00095 * taper).astype(np.float32), colors.astype(np.float32), outwards)


def scalp_points(anatomy: Anatomy, count: int, random: np.random.Generator) -> Float[np.ndarray, "n 3"]:
    """Sample roots on the scalp, evenly spread and sparser towards the hairline."""
    faces = anatomy.faces[anatomy.skin & ~anatomy.region("ears")]
    corners = anatomy.vertices[faces]
    areas = length(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    inside = anatomy.hair_share(corners.mean(1)) > 0.02
    weights = areas * inside
    found: list[np.ndarray] = []
    total = 0
    while total < count:
        chosen = random.choice(len(faces), size=count, p=weights / weights.sum())
        points = mixed(random.dirichlet((1, 1, 1), count), corners[chosen]).astype(np.float32)
        kept = points[anatomy.hair_share(points + random.normal(0, 0.0015, points.shape)) > random.uniform(size=count)]
        found.append(kept)
        total += len(kept)
    return np.concatenate(found)[:count]


def _combed(
    points: Float[np.ndarray, "n 3"], centre: np.ndarray, part: float, noise: SolidNoise
) -> Float[np.ndarray, "n 3"]:
    """Return the combing direction in locks: away from the parting on top, down and back at the sides and behind."""
    relative = points - centre
    top = smoothstep(0.2, 0.85, relative[:, 1] / length(relative))
    front = smoothstep(0.0, 0.08, relative[:, 2])
    aside = np.tanh((points[:, 0] - part) / 0.006) * (0.3 + 0.7 * top)
    high = smoothstep(-0.05, 0.35, relative[:, 1] / length(relative))
    sweep = front * high  # from the forehead the hair goes up, aside and back
    down = -0.15 - 1.1 * (1 - top) * (1 - sweep) + 0.35 * sweep
    combed = np.stack([aside * (1 + 0.2 * sweep), down, -0.5 - 0.25 * sweep], -1)
    locks = np.stack([noise(points + 0.1 * axis, 0.016) for axis in range(3)], -1)
    return combed + 0.4 * locks


@dataclass(frozen=True, eq=False)
class SkinStrands:
    """Brow hairs. Every point lies over a triangle of the skin and moves with it."""

    faces: Int[np.ndarray, "n s"]
    """Index of each point's triangle in the face model."""
    barycentric: Float[np.ndarray, "n s 3"]
    heights: Float[np.ndarray, "n s"]
    """Heights above the skin, in metres."""
    widths: Float[np.ndarray, "n s"]
    colors: Float[np.ndarray, "n s 3"]

    def posed(self, anatomy: Anatomy, vertices: Float[np.ndarray, "v 3"], normals: Float[np.ndarray, "v 3"]) -> Strands:
        """Return the strands on a posed head, in the head frame."""
        corners = anatomy.faces[self.faces]
        outwards = unit(mixed(self.barycentric, normals[corners]))
        points = mixed(self.barycentric, vertices[corners]) + self.heights[..., None] * outwards
        return Strands(points, self.widths, self.colors, outwards)


def brow_strands(
    anatomy: Anatomy, color: Float[np.ndarray, " 3"], seed: int, per_side: int = 620, steps: int = 4
) -> SkinStrands:
    """Grow hairs that rise at the inner end of the brow and lie along it towards the temple."""
    random = np.random.default_rng([seed, 4])
    curves = []
    for side in SIDES:
        upper, lower = (resample(anatomy.landmarks[list(c[side])], 24) for c in (BROWS_UPPER, BROWS_LOWER))
        along = random.uniform(0, 1, per_side) ** 0.9
        across = np.clip(random.normal(0.5, 0.27, per_side), 0.0, 1.0)
        across = 0.45 + (across - 0.45) * (1 - 0.65 * along**2)  # the tail is thin
        reach = random.uniform(0.10, 0.2, per_side) * (1 - 0.4 * along)
        slant = (0.42 * (1 - along) ** 2 - 0.12 * (across - 0.5)) + random.normal(0, 0.06, per_side)
        t = np.linspace(0, 1, steps)
        u = np.clip(along[:, None] + reach[:, None] * t, 0, 1.12)
        v = np.clip(across[:, None] + slant[:, None] * t * (1 - 0.4 * t), -0.1, 1.1)
        curves.append(_between(lower, upper, u, v))
    points = np.concatenate(curves)
    faces, barycentric = front_points(anatomy, points.reshape(-1, 3))
    count = len(points)
    heights = np.linspace(0.0001, 0.0012, steps) * random.uniform(0.5, 1.2, (count, 1))
    tint = np.exp(0.2 * random.normal(size=(count, 1, 1)))
    return SkinStrands(
        faces=faces.reshape(count, steps),
        barycentric=barycentric.reshape(count, steps, 3),
        heights=heights.astype(np.float32),
        widths=(0.00055 * np.linspace(1, 0.4, steps) * np.ones((count, 1))).astype(np.float32),
        colors=(color * tint * np.ones((count, steps, 1))).astype(np.float32),
    )


def _between(lower: np.ndarray, upper: np.ndarray, u: np.ndarray, v: np.ndarray) -> Float[np.ndarray, "n s 3"]:
    """Interpolate bilinearly in the band between two chains; `u` runs along it (and may exceed 1), `v` across."""
    place = u * (len(lower) - 1)
    index = np.clip(place.astype(int), 0, len(lower) - 2)
    fraction = (place - index)[..., None]
    low = lower[index] + fraction * (lower[index + 1] - lower[index])
    high = upper[index] + fraction * (upper[index + 1] - upper[index])
    return low + v[..., None] * (high - low)


def front_points(
    anatomy: Anatomy, points: Float[np.ndarray, "n 3"]
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
    """Return the skin triangle and the barycentric coordinates nearest to each point, by the triangles' planes."""
    candidates = np.flatnonzero(anatomy.skin)
    corners = anatomy.vertices[anatomy.faces[candidates]]
    centres = corners.mean(1)
    squares = dot(centres, centres)
    faces = np.empty(len(points), np.int64)
    weights = np.empty((len(points), 3), np.float32)
    for start in range(0, len(points), 512):
        part = points[start : start + 512]
        away = squares - 2 * product(part, centres.T)
        near = np.argpartition(away, 12, axis=1)[:, :12]
        barycentric = _barycentric(part[:, None], corners[near])
        clamped = np.clip(barycentric, 0, 1)
        clamped /= clamped.sum(-1, keepdims=True)
        distance = length(mixed(clamped, corners[near]) - part[:, None])
        best = distance.argmin(1)
        rows = np.arange(len(part))
        faces[start : start + 512] = candidates[near[rows, best]]
        weights[start : start + 512] = clamped[rows, best]
    return faces, weights


def _barycentric(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    a, b, c = corners[..., 0, :], corners[..., 1, :], corners[..., 2, :]
    e1, e2, d = b - a, c - a, points - a
    d11, d12, d22 = dot(e1, e1), dot(e1, e2), dot(e2, e2)
    p1, p2 = dot(d, e1), dot(d, e2)
    determinant = np.maximum(d11 * d22 - d12 * d12, 1e-18)
    v, w = (d22 * p1 - d12 * p2) / determinant, (d11 * p2 - d12 * p1) / determinant
    return np.stack([1 - v - w, v, w], -1)


def lash_strands(
    landmarks: Float[np.ndarray, "l 3"],
    eye_centres: Float[np.ndarray, "2 3"],
    eye_radius: float,
    steps: int = 4,
) -> Strands:
    """Grow lashes along the posed rims of the lids, outwards from the eyeball. Upper ones curl up."""
    points, outwards, widths = [], [], []
    on_lid = eye_radius + 0.0012
    for side, centre in zip(SIDES, eye_centres, strict=True):
        for rims, longest, curl, count in ((UPPER_LIDS, 0.0058, 0.62, 44), (LOWER_LIDS, 0.0030, -0.5, 24)):
            roots = resample(landmarks[list(rims[side])], count + 6)[3:-3]
            radial = unit(roots - centre)
            # If landmarks lie on the inner fold of a lid, lashes still start on its outside.
            roots = centre + np.maximum(length(roots - centre)[:, None], on_lid) * radial
            aside = np.linspace(0.6, -0.25, count)[:, None] * np.array([1.0 if side == "left" else -1.0, 0, 0])
            vary = 1 + 0.25 * np.sin(np.arange(count) * 12.9898) * np.cos(np.arange(count) * 4.1)
            upward = np.array([0.0, 1.0, 0.0]) - radial[:, 1:2] * radial
            t = np.linspace(0, 1, steps)[None, :, None]
            reach = (longest * vary * (0.65 + 0.35 * np.sin(np.linspace(0.2, 2.6, count))))[:, None, None]
            bend = t * (radial + 0.5 * aside)[:, None] + curl * t * t * upward[:, None]
            points.append(roots[:, None] + reach * bend)
            outwards.append(np.repeat(radial[:, None], steps, 1))
            widths.append(np.repeat((0.0003 if curl > 0 else 0.00016) * np.linspace(1, 0.4, steps)[None], count, 0))
    total = sum(len(part) for part in points)
    return Strands(
        np.concatenate(points).astype(np.float32),
        np.concatenate(widths).astype(np.float32),
        np.full((total, steps, 3), 0.012, np.float32),
        np.concatenate(outwards).astype(np.float32),
    )
