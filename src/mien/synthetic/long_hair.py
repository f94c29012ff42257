"""Shoulder-length hair: a parting, and locks that fall beside the face and over the ears onto the shoulders."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mien import exact
from mien.synthetic.anatomy import CHIN, FOREHEAD_TOP, Anatomy
from mien.synthetic.hair import Strands, scalp_points, unit
from mien.synthetic.noise import SolidNoise, smoothstep

_STEPS = 22
_COUNT = 7500


@dataclass(frozen=True, eq=False)
class DrapedStrands:
    """Strands that move with the head at their roots, and partly with the shoulders at their ends."""

    rest: Strands
    follow: Float[np.ndarray, "n s"]
    """Share of the shoulders' motion that each point follows, 0..1."""

    def posed(self, T_head_shoulders: Float[np.ndarray, "4 4"]) -> Strands:
        """Return the strands in the head frame when the shoulders are turned relative to the head."""
        points = self.rest.points
        on_shoulders = exact.rotated(points, T_head_shoulders[:3, :3], T_head_shoulders[:3, 3])
        moved = points + self.follow[..., None] * (on_shoulders - points)
        return Strands(moved.astype(np.float32), self.rest.widths, self.rest.colors, self.rest.outwards)


def long_hair(anatomy: Anatomy, color: Float[np.ndarray, " 3"], collar: float, seed: int) -> DrapedStrands:
    """Grow strands that are combed away from a parting and then hang. They stay outside of skull, ears and face.

    Args:
        anatomy: Anatomy of the head.
        color: Linear albedo.
        collar: Height of the collar in the head frame, in metres. The hair ends near it.
        seed: Seed of this hair.
    """
    random, noise = np.random.default_rng([seed, 3]), SolidNoise(seed + 31)
    roots = scalp_points(anatomy, _COUNT, random)
    part = random.choice([-1.0, 1.0]) * 0.018
    centre = anatomy.skull_centre
    layer = random.uniform(0.08, 1.0, _COUNT)
    side = np.where(np.abs(roots[:, 0] - part) < 0.002, random.choice([-1.0, 1.0], _COUNT), np.sign(roots[:, 0] - part))
    path = _Path(anatomy, centre, side.astype(np.float32), layer)
    ends = collar - 0.012 + 0.014 * noise(roots, 0.03) + random.normal(0, 0.006, _COUNT)
    length = 0.06 + 1.12 * (roots[:, 1] - ends)
    points = np.empty((_COUNT, _STEPS, 3), np.float32)
    outwards = np.empty_like(points)
    place = path.lifted(roots - 0.001 * unit(roots - centre), 0.0)
    wobble = random.normal(0, 0.05, (_COUNT, 3))
    for step in range(_STEPS):
        points[:, step] = place
        outwards[:, step] = unit((place - centre) * np.array([1, 0.35, 1], np.float32))
        locks = np.stack(
            [noise(roots + 0.1 * axis + 0.02 * step * np.array([0, 0.12, 0]), 0.017) for axis in range(3)], -1
        )
        heading = unit(path.heading(place, part) + 0.22 * locks + wobble)
        place = path.lifted(place + heading * (length / (_STEPS - 1))[:, None], (step + 1) / (_STEPS - 1))
    along = np.linspace(0, 1, _STEPS)
    taper = (1 - 0.45 * along**3) * random.uniform(0.8, 1.2, (_COUNT, 1))
    inner = 0.3 + 0.7 * layer[:, None] * smoothstep(-0.2, 0.3, along)
    lighter = 1 + 0.25 * smoothstep(0.4, 1.0, along)  # the sun has bleached the ends
    tint = np.exp(0.14 * random.normal(size=(_COUNT, 1)) + 0.2 * noise(roots, 0.010)[:, None])
    colors = color * (inner * tint * lighter)[..., None]
    strands = Strands(points, (0.00125 * taper).astype(np.float32), colors.astype(np.float32), outwards)
    chin = float(anatomy.landmarks[CHIN, 1])
    return DrapedStrands(strands, 0.55 * smoothstep(chin + 0.03, collar, points[..., 1]))


class _Path:
    """Constrains where a strand may be, and directs where it goes next."""

    def __init__(self, anatomy: Anatomy, centre: np.ndarray, side: np.ndarray, layer: np.ndarray) -> None:
        self._anatomy, self._centre, self._side, self._layer = anatomy, centre, side, layer
        ears = anatomy.vertices[np.unique(anatomy.faces[anatomy.region("ears")])]
        self._ear = np.abs(ears).mean(0) * np.array([1, 0, 0]) + ears.mean(0) * np.array([0, 1, 1])
        self._brow = float(anatomy.landmarks[[105, 334], 1].mean())
        self._top = float(anatomy.landmarks[FOREHEAD_TOP, 1])
        self._chin = float(anatomy.landmarks[CHIN, 1])

    def heading(self, points: Float[np.ndarray, "n 3"], part: float) -> Float[np.ndarray, "n 3"]:
        """Return the direction: sideways and back on top of the head, along it at its sides, then straight down."""
        relative = points - self._centre
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
        relative = points - self._centre
        radius = exact.length(relative)
        outward = relative / radius[:, None]
        top = smoothstep(0.3, 0.85, outward[:, 1])
        mirrored = points * np.array([1, 1, 1], np.float32)
        mirrored[:, 0] = np.abs(mirrored[:, 0])
        at_ear = np.exp(-((mirrored - self._ear) ** 2).sum(-1) / (2 * 0.042**2))
        height = self._layer * (0.011 + 0.009 * top) * smoothstep(-0.02, 0.25, np.full(len(points), along))
        height = height + 0.003 + 0.016 * at_ear * (along > 0.05)
        least = self._anatomy.skull_radius(outward.astype(np.float32)) + height
        upper = smoothstep(self._chin - 0.06, self._chin - 0.02, points[:, 1])
        # A strand lies on the skull. Where the skull recedes, it hangs free.
        slack = np.where(outward[:, 1] > -0.1, 0.002 + 0.25 * smoothstep(0.25, -0.1, outward[:, 1]), 1.0)
        held = np.clip(radius, least, least + slack)
        return (self._centre + outward * (radius + upper * (held - radius))[:, None]).astype(np.float32)

    def _beside_the_face(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Turn points about the skull's vertical axis until they leave the face free."""
        x, z = points[:, 0] - self._centre[0], points[:, 2] - self._centre[2]
        around = np.arctan2(np.abs(x), z)
        side = np.where(np.abs(x) > 0.03, np.sign(x), self._side)
        heights = [self._chin - 0.08, self._chin, self._brow - 0.03, self._brow, self._top, self._top + 0.03]
        least = np.radians(np.interp(points[:, 1], heights, [46, 54, 62, 52, 16, 0]))
        around = np.maximum(around, least + 0.10 * self._layer)
        around = np.where(points[:, 1] > self._top + 0.03, np.arctan2(np.abs(x), z), around)
        distance = np.hypot(x, z)
        moved = np.stack([self._centre[0] + side * distance * np.sin(around), points[:, 1],
                          self._centre[2] + distance * np.cos(around)], -1)  # fmt: skip
        return np.where((points[:, 1] > self._top + 0.03)[:, None], points, moved).astype(np.float32)
