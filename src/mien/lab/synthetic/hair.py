"""Hair on the scalp as strands: curves with a width, drawn as ribbons that face the camera."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from mien.lab.synthetic.anatomy import CHIN, FOREHEAD_TOP, Anatomy
from mien.lab.synthetic.arithmetic import SolidNoise, smoothstep, unit
from mien.machine import exact
from mien.machine.exact import dot, length, mixed

_LONG_STEPS, _LONG_COUNT = 22, 7500
"""Points per strand, and strands, of long hair."""


@dataclass(frozen=True, eq=False)
class HeadPose:
    """What hair follows at one timestep, in the head frame."""

    head: Float[np.ndarray, "v 3"]
    """The face model's vertices."""
    normals: Float[np.ndarray, "v 3"]
    landmarks: Float[np.ndarray, "l 3"]
    eye_centers: Float[np.ndarray, "2 3"]
    T_head_shoulders: Float[np.ndarray, "4 4"]


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

    def posed(self, _: HeadPose) -> "Strands":
        """Return the strands themselves."""
        return self

    @cached_property
    def tangents(self) -> Float[np.ndarray, "n s 3"]:
        """Unit directions along the strands."""
        return unit(np.gradient(self.points, axis=1).astype(np.float32))

    def ribbon_vertices(self, viewpoint: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "v 3"]:
        """Return two vertices per point, one width apart, across the view from `viewpoint` (head frame)."""
        return ribbon(self.points, unit(np.cross(self.tangents, viewpoint - self.points)), self.widths)


def ribbon_faces(strands: int, points: int) -> Int[np.ndarray, "f 3"]:
    """Return the triangles over `ribbon_vertices`, given the numbers of strands and of points per strand."""
    start = 2 * (np.arange(strands)[:, None] * points + np.arange(points - 1))
    quads = np.stack([start, start + 1, start + 3, start, start + 3, start + 2], -1)
    return quads.reshape(-1, 3).astype(np.int64)


def ribbon(points: np.ndarray, across: np.ndarray, widths: np.ndarray) -> Float[np.ndarray, "v 3"]:
    """Return the left and right edges of every point."""
    half = 0.5 * widths[..., None] * across
    return np.stack([points - half, points + half], axis=2).reshape(-1, 3).astype(np.float32)


def grow_short_hair(anatomy: Anatomy, color: Float[np.ndarray, " 3"], seed: int, count: int = 9000) -> Strands:
    """Grow short hair with a side parting: long on top, short at the sides and the nape.

    A strand follows the skull in the direction in which it is combed, at the height of its layer, so it never enters
    the head.
    """
    random, noise = np.random.default_rng([seed, 3]), SolidNoise(seed + 31)
    roots = _scalp_points(anatomy, count, random)
    part = random.choice([-1.0, 1.0]) * 0.028
    center = anatomy.skull_center
    direction = unit(roots - center)
    top = smoothstep(0.45, 0.8, direction[:, 1])  # 1 on top of the head, 0 at its sides
    low = smoothstep(0.05, -0.25, direction[:, 1])
    reach = (0.024 - 0.012 * low + 0.055 * top) * random.uniform(0.75, 1.15, count) * (1 + 0.25 * noise(roots, 0.03))
    stray = random.uniform(size=count) < 0.025
    layer = random.uniform(0.12, 1.0, count) + np.where(stray, random.uniform(0, 0.5, count), 0)
    parting = 1 - 0.75 * np.exp(-(((roots[:, 0] - part) / 0.006) ** 2)) * (roots[:, 2] > center[2] - 0.04)
    height = (0.008 - 0.004 * low + 0.017 * top) * layer * parting * (1 + 0.3 * noise(roots, 0.025))
    wobble = random.normal(0, 1, (count, 3)) * np.where(stray, 0.28, 0.09)[:, None]
    steps = 10
    points = np.empty((count, steps, 3), np.float32)
    outwards = np.empty_like(points)
    for step in range(steps):
        place = step / (steps - 1)
        rise = height * (1 - np.exp(-place * reach / (0.5 * height + 1e-4))) * (1 - 0.3 * place**2)
        radius = anatomy.skull_radius(direction) + rise - 0.001 * (step == 0)
        points[:, step] = center + direction * radius[:, None]
        outwards[:, step] = direction
        combed = _combed(points[:, step], center, part, noise) + wobble
        combed -= dot(combed, direction)[:, None] * direction
        direction = unit(direction + unit(combed) * (reach / (steps - 1) / radius)[:, None])
    taper = np.linspace(1, 0.45, steps) * random.uniform(0.75, 1.25, count)[:, None]
    shade = 0.35 + 0.65 * np.clip(layer, 0, 1)[:, None] * smoothstep(-0.15, 0.5, np.linspace(0, 1, steps))
    tint = np.exp(0.16 * random.normal(size=(count, 1)) + 0.2 * noise(roots, 0.012)[:, None])
    colors = color * (shade * tint)[..., None]
    return Strands(points, (0.00095 * taper).astype(np.float32), colors.astype(np.float32), outwards)


def _scalp_points(anatomy: Anatomy, count: int, random: np.random.Generator) -> Float[np.ndarray, "n 3"]:
    """Sample roots on the scalp, evenly spread and sparser towards the hairline."""
    faces = anatomy.faces[anatomy.skin & ~anatomy.region("ears")]
    corners = anatomy.vertices[faces]
    areas = length(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    weights = areas * (anatomy.hair_share(corners.mean(1)) > 0.02)
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
    points: Float[np.ndarray, "n 3"], center: np.ndarray, part: float, noise: SolidNoise
) -> Float[np.ndarray, "n 3"]:
    """Return the combing direction in locks: away from the parting on top, down and back at the sides and behind."""
    relative = points - center
    top = smoothstep(0.2, 0.85, relative[:, 1] / length(relative))
    front = smoothstep(0.0, 0.08, relative[:, 2])
    aside = np.tanh((points[:, 0] - part) / 0.006) * (0.3 + 0.7 * top)
    high = smoothstep(-0.05, 0.35, relative[:, 1] / length(relative))
    sweep = front * high  # from the forehead the hair goes up, aside and back
    down = -0.15 - 1.1 * (1 - top) * (1 - sweep) + 0.35 * sweep
    combed = np.stack([aside * (1 + 0.2 * sweep), down, -0.5 - 0.25 * sweep], -1)
    return combed + 0.4 * np.stack([noise(points + 0.1 * axis, 0.016) for axis in range(3)], -1)


@dataclass(frozen=True, eq=False)
class DrapedStrands:
    """Strands that move with the head at their roots, and partly with the shoulders at their ends."""

    rest: Strands
    follow: Float[np.ndarray, "n s"]
    """Share of the shoulders' motion that each point follows, 0..1."""

    def posed(self, pose: HeadPose) -> Strands:
        """Return the strands in the head frame when the shoulders are turned relative to the head."""
        points, T = self.rest.points, pose.T_head_shoulders
        moved = points + self.follow[..., None] * (exact.rotated(points, T[:3, :3], T[:3, 3]) - points)
        return Strands(moved.astype(np.float32), self.rest.widths, self.rest.colors, self.rest.outwards)


def grow_long_hair(anatomy: Anatomy, color: Float[np.ndarray, " 3"], collar: float, seed: int) -> DrapedStrands:
    """Grow strands that hang from a parting to near the collar's height in the head frame, in metres.

    They stay outside of skull, ears and face.
    """
    random, noise = np.random.default_rng([seed, 3]), SolidNoise(seed + 31)
    roots = _scalp_points(anatomy, _LONG_COUNT, random)
    part = random.choice([-1.0, 1.0]) * 0.018
    center = anatomy.skull_center
    layer = random.uniform(0.08, 1.0, _LONG_COUNT)
    side = np.where(
        np.abs(roots[:, 0] - part) < 0.002, random.choice([-1.0, 1.0], _LONG_COUNT), np.sign(roots[:, 0] - part)
    )
    path = _Path(anatomy, center, side.astype(np.float32), layer)
    ends = collar - 0.012 + 0.014 * noise(roots, 0.03) + random.normal(0, 0.006, _LONG_COUNT)
    length = 0.06 + 1.12 * (roots[:, 1] - ends)
    points = np.empty((_LONG_COUNT, _LONG_STEPS, 3), np.float32)
    outwards = np.empty_like(points)
    place = path.lifted(roots - 0.001 * unit(roots - center), 0.0)
    wobble = random.normal(0, 0.05, (_LONG_COUNT, 3))
    for step in range(_LONG_STEPS):
        points[:, step] = place
        outwards[:, step] = unit((place - center) * np.array([1, 0.35, 1], np.float32))
        locks = np.stack(
            [noise(roots + 0.1 * axis + 0.02 * step * np.array([0, 0.12, 0]), 0.017) for axis in range(3)], -1
        )
        heading = unit(path.heading(place, part) + 0.22 * locks + wobble)
        place = path.lifted(place + heading * (length / (_LONG_STEPS - 1))[:, None], (step + 1) / (_LONG_STEPS - 1))
    along = np.linspace(0, 1, _LONG_STEPS)
    taper = (1 - 0.45 * along**3) * random.uniform(0.8, 1.2, (_LONG_COUNT, 1))
    inner = 0.3 + 0.7 * layer[:, None] * smoothstep(-0.2, 0.3, along)
    lighter = 1 + 0.25 * smoothstep(0.4, 1.0, along)  # the sun has bleached the ends
    tint = np.exp(0.14 * random.normal(size=(_LONG_COUNT, 1)) + 0.2 * noise(roots, 0.010)[:, None])
    colors = color * (inner * tint * lighter)[..., None]
    strands = Strands(points, (0.00125 * taper).astype(np.float32), colors.astype(np.float32), outwards)
    chin = float(anatomy.landmarks[CHIN, 1])
    return DrapedStrands(strands, 0.55 * smoothstep(chin + 0.03, collar, points[..., 1]))


class _Path:
    """Constrains where a strand may be, and directs where it goes next."""

    def __init__(self, anatomy: Anatomy, center: np.ndarray, side: np.ndarray, layer: np.ndarray) -> None:
        self._anatomy, self._center, self._side, self._layer = anatomy, center, side, layer
        ears = anatomy.vertices[np.unique(anatomy.faces[anatomy.region("ears")])]
        self._ear = np.abs(ears).mean(0) * np.array([1, 0, 0]) + ears.mean(0) * np.array([0, 1, 1])
        self._brow = float(anatomy.landmarks[[105, 334], 1].mean())
        self._top = float(anatomy.landmarks[FOREHEAD_TOP, 1])
        self._chin = float(anatomy.landmarks[CHIN, 1])

    def heading(self, points: Float[np.ndarray, "n 3"], part: float) -> Float[np.ndarray, "n 3"]:
        """Return the direction: sideways and back on top of the head, along it at its sides, then straight down."""
        relative = points - self._center
        outward = unit(relative)
        top = smoothstep(0.25, 0.9, outward[:, 1])
        front = smoothstep(0.0, 0.08, relative[:, 2]) * smoothstep(-0.05, 0.3, outward[:, 1])
        aside = self._side * (0.15 + 1.1 * top + 0.35 * front)
        combed = np.stack([aside, -1.0 + 0.6 * top + 0.35 * front, -0.35 * top - 0.5 * front], -1)
        on_skull = smoothstep(0.1, 0.5, outward[:, 1])[:, None]
        inward = exact.dot(combed, outward)[:, None] * outward
        down = np.stack([-0.04 * np.sign(points[:, 0]), -np.ones(len(points)), np.full(len(points), 0.02)], -1)
        return unit(on_skull * (combed - inward) + (1 - on_skull) * down)

    def lifted(self, points: Float[np.ndarray, "n 3"], along: float) -> Float[np.ndarray, "n 3"]:
        """Return the points moved off the head by their layer's height, and off the face."""
        points = self._beside_the_face(points.astype(np.float32))
        relative = points - self._center
        radius = exact.length(relative)
        outward = relative / radius[:, None]
        top = smoothstep(0.3, 0.85, outward[:, 1])
        mirrored = points.copy()
        mirrored[:, 0] = np.abs(mirrored[:, 0])
        at_ear = np.exp(-((mirrored - self._ear) ** 2).sum(-1) / (2 * 0.042**2))
        height = self._layer * (0.011 + 0.009 * top) * smoothstep(-0.02, 0.25, np.full(len(points), along))
        height = height + 0.003 + 0.016 * at_ear * (along > 0.05)
        least = self._anatomy.skull_radius(outward.astype(np.float32)) + height
        upper = smoothstep(self._chin - 0.06, self._chin - 0.02, points[:, 1])
        # A strand lies on the skull. Where the skull recedes, it hangs free.
        slack = np.where(outward[:, 1] > -0.1, 0.002 + 0.25 * smoothstep(0.25, -0.1, outward[:, 1]), 1.0)
        held = np.clip(radius, least, least + slack)
        return (self._center + outward * (radius + upper * (held - radius))[:, None]).astype(np.float32)

    def _beside_the_face(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Turn points about the skull's vertical axis until they leave the face free."""
        x, z = points[:, 0] - self._center[0], points[:, 2] - self._center[2]
        around = np.arctan2(np.abs(x), z)
        side = np.where(np.abs(x) > 0.03, np.sign(x), self._side)
        heights = [self._chin - 0.08, self._chin, self._brow - 0.03, self._brow, self._top, self._top + 0.03]
        least = np.radians(np.interp(points[:, 1], heights, [46, 54, 62, 52, 16, 0]))
        around = np.maximum(around, least + 0.10 * self._layer)
        around = np.where(points[:, 1] > self._top + 0.03, np.arctan2(np.abs(x), z), around)
        distance = np.hypot(x, z)
        moved = np.stack([self._center[0] + side * distance * np.sin(around), points[:, 1],
                          self._center[2] + distance * np.cos(around)], -1)  # fmt: skip
        return np.where((points[:, 1] > self._top + 0.03)[:, None], points, moved).astype(np.float32)
