"""Hair of the face: brows, lashes, and a full beard. The strands grow on the skin and move with it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from mien.lab.synthetic import anatomy as places
from mien.lab.synthetic.anatomy import Anatomy, face_view, resample
from mien.lab.synthetic.arithmetic import SolidNoise, smoothstep, unit
from mien.lab.synthetic.hair import HeadPose, Strands
from mien.machine import exact

_BEARD_COUNT, _BEARD_STEPS = 5200, 7
"""Strands, and points per strand, of a beard."""


@dataclass(frozen=True, eq=False)
class RootedStrands:
    """Strands that each keep their shape in the frame of the skin where they grow."""

    corners: Int[np.ndarray, "n 3"]
    """Vertices of each root's triangle."""
    barycentric: Float[np.ndarray, "n 3"]
    local: Float[np.ndarray, "n s 3"]
    """Offsets from the root in the frame of `_frames`, in metres."""
    widths: Float[np.ndarray, "n s"]
    colors: Float[np.ndarray, "n s 3"]

    def posed(self, pose: HeadPose) -> Strands:
        """Return the strands on a posed head, in the head frame."""
        roots, frames = _frames(self.corners, self.barycentric, pose.head, pose.normals)
        points = roots[:, None] + exact.product(self.local, np.swapaxes(frames, 1, 2))
        outwards = np.repeat(frames[:, None, :, 2], points.shape[1], axis=1)
        return Strands(points.astype(np.float32), self.widths, self.colors, np.ascontiguousarray(outwards))


def beard_zone(anatomy: Anatomy, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Return 1 where a beard grows and 0 elsewhere, with soft borders. The lips are not excluded."""
    marks = anatomy.landmarks
    nose, mouth = marks[places.NOSE_BASE], marks[places.MOUTH_TOP]
    width = 0.5 * abs(marks[454, 0] - marks[234, 0])
    border = np.interp(np.abs(points[:, 0]), [0, 0.2 * width, 0.5 * width, 0.85 * width, width],
                       [nose[1], nose[1], mouth[1] - 0.004, nose[1] - 0.01, nose[1] + 0.02])  # fmt: skip
    zone = smoothstep(0.004, -0.008, points[:, 1] - border) * smoothstep(-0.055, -0.035, points[:, 1] - marks[152, 1])
    return zone * smoothstep(-0.02, 0.01, points[:, 2] - marks[234, 2])


def grow_beard(anatomy: Anatomy, color: Float[np.ndarray, " 3"], length: float, seed: int) -> RootedStrands:
    """Grow hairs that leave the skin at a slant, down and sideways, and curl; `length` at the chin is in metres."""
    random, noise = np.random.default_rng([seed, 10]), SolidNoise(seed + 53)
    triangles, barycentric, roots = _roots(anatomy, random)
    _, frames = _frames(triangles, barycentric, anatomy.vertices, anatomy.normals)
    normals, marks = frames[:, :, 2], anatomy.landmarks
    mouth, chin = marks[places.MOUTH_TOP, 1], marks[places.CHIN, 1]
    moustache = smoothstep(mouth - 0.004, mouth + 0.002, roots[:, 1]) * (np.abs(roots[:, 0]) < 0.034)
    at_chin = smoothstep(mouth - 0.01, chin, roots[:, 1])
    sideways = np.tanh(roots[:, 0] / 0.008)
    down = np.stack([
        sideways * (0.15 + 1.0 * moustache), -1.0 + 0.45 * moustache, 0.35 * at_chin - 0.1 + 0.0 * moustache
    ], -1)  # fmt: skip
    locks = np.stack([noise(roots + 0.1 * axis, 0.011) for axis in range(3)], -1)
    down = unit(down + 0.5 * locks + random.normal(0, 0.22, down.shape))
    reach = length * (0.30 + 0.25 * moustache + 0.75 * at_chin) * random.uniform(0.6, 1.15, _BEARD_COUNT)
    reach = np.where(moustache > 0.5, np.minimum(reach, 0.45 * length), reach)
    curl = unit(random.normal(0, 1, (_BEARD_COUNT, 3))) * 0.0012
    t = np.linspace(0, 1, _BEARD_STEPS)[None, :, None]
    slant = normals[:, None] * (0.75 - 0.45 * t) + down[:, None] * (0.35 + 0.75 * t)
    bend = curl[:, None] * np.sin(2 * np.pi * t * random.uniform(0.8, 1.6, (_BEARD_COUNT, 1, 1)))
    offsets = reach[:, None, None] * t * slant + bend * t - 0.0006 * normals[:, None]
    tint = np.exp(0.22 * random.normal(size=(_BEARD_COUNT, 1)) + 0.15 * noise(roots, 0.01)[:, None])
    gray = random.uniform(size=(_BEARD_COUNT, 1)) < 0.05
    shade = (0.45 + 0.55 * np.linspace(0, 1, _BEARD_STEPS)) * tint
    colors = np.where(gray[..., None], 0.25, color) * shade[..., None]
    return RootedStrands(
        corners=triangles,
        barycentric=barycentric,
        local=exact.product(offsets, frames).astype(np.float32),
        widths=(0.00062 * np.linspace(1, 0.45, _BEARD_STEPS) * random.uniform(0.8, 1.2, (_BEARD_COUNT, 1))).astype(
            np.float32
        ),
        colors=colors.astype(np.float32),
    )


def _roots(anatomy: Anatomy, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Choose triangles, barycentric coordinates and positions of the roots in the beard zone, but not on the lips."""
    candidates = np.flatnonzero(anatomy.skin & ~anatomy.region("ears", "nose"))
    corners = anatomy.vertices[anatomy.faces[candidates]]
    areas = exact.length(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    weights = areas * (beard_zone(anatomy, corners.mean(1)) > 0.01)
    view = face_view(anatomy)
    lips = view.polygon(anatomy.landmarks[list(places.LIPS_OUTER)], 0.0012)
    kept: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    while sum(len(part[0]) for part in kept) < _BEARD_COUNT:
        chosen = random.choice(len(candidates), size=_BEARD_COUNT, p=weights / weights.sum())
        barycentric = random.dirichlet((1, 1, 1), _BEARD_COUNT).astype(np.float32)
        points = exact.mixed(barycentric, corners[chosen]).astype(np.float32)
        in_front = points[:, 2] > anatomy.landmarks[list(places.LIPS_OUTER), 2].min() - 0.008
        on_lips = view.look_up(lips, points) * in_front > 0.25
        above_neck = smoothstep(-0.026, -0.012, points[:, 1] - anatomy.landmarks[places.CHIN, 1])
        grows = (above_neck * beard_zone(anatomy, points) > random.uniform(0.05, 1.0, _BEARD_COUNT)) & ~on_lips
        kept.append((candidates[chosen[grows]], barycentric[grows], points[grows]))
    faces, barycentric, points = (np.concatenate(parts)[:_BEARD_COUNT] for parts in zip(*kept, strict=True))
    return anatomy.faces[faces], barycentric, points


def _frames(
    triangles: np.ndarray, barycentric: np.ndarray, vertices: np.ndarray, normals: np.ndarray
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 3"]]:
    """Return roots, and frames with these columns: tangent along the triangle's first edge, second tangent, normal."""
    corners = vertices[triangles]
    normal = unit(exact.mixed(barycentric, normals[triangles]))
    edge = corners[:, 1] - corners[:, 0]
    tangent = unit(edge - exact.dot(edge, normal)[:, None] * normal)
    frames = np.stack([tangent, np.cross(normal, tangent), normal], -1).astype(np.float32)
    return exact.mixed(barycentric, corners), frames


@dataclass(frozen=True, eq=False)
class SkinStrands:
    """Brow hairs. Every point lies over a triangle of the skin and moves with it."""

    corners: Int[np.ndarray, "n s 3"]
    """Vertices of each point's triangle."""
    barycentric: Float[np.ndarray, "n s 3"]
    heights: Float[np.ndarray, "n s"]
    """Heights above the skin, in metres."""
    widths: Float[np.ndarray, "n s"]
    colors: Float[np.ndarray, "n s 3"]

    def posed(self, pose: HeadPose) -> Strands:
        """Return the strands on a posed head, in the head frame."""
        outwards = unit(exact.mixed(self.barycentric, pose.normals[self.corners]))
        points = exact.mixed(self.barycentric, pose.head[self.corners]) + self.heights[..., None] * outwards
        return Strands(points, self.widths, self.colors, outwards)


def grow_brows(
    anatomy: Anatomy, color: Float[np.ndarray, " 3"], seed: int, per_side: int = 620, steps: int = 4
) -> SkinStrands:
    """Grow hairs that rise at the inner end of the brow and lie along it towards the temple."""
    random = np.random.default_rng([seed, 4])
    curves = []
    for side in places.SIDES:
        upper, lower = (
            resample(anatomy.landmarks[list(c[side])], 24) for c in (places.BROWS_UPPER, places.BROWS_LOWER)
        )
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
    faces, barycentric = _front_points(anatomy, points.reshape(-1, 3))
    count = len(points)
    heights = np.linspace(0.0001, 0.0012, steps) * random.uniform(0.5, 1.2, (count, 1))
    tint = np.exp(0.2 * random.normal(size=(count, 1, 1)))
    return SkinStrands(
        corners=anatomy.faces[faces].reshape(count, steps, 3),
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


def _front_points(
    anatomy: Anatomy, points: Float[np.ndarray, "n 3"]
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
    """Return the skin triangle and the barycentric coordinates nearest to each point, by the triangles' planes."""
    candidates = np.flatnonzero(anatomy.skin)
    corners = anatomy.vertices[anatomy.faces[candidates]]
    centers = corners.mean(1)
    squares = exact.dot(centers, centers)
    faces = np.empty(len(points), np.int64)
    weights = np.empty((len(points), 3), np.float32)
    for start in range(0, len(points), 512):
        part = points[start : start + 512]
        near = np.argpartition(squares - 2 * exact.product(part, centers.T), 12, axis=1)[:, :12]
        clamped = np.clip(_barycentric(part[:, None], corners[near]), 0, 1)
        clamped /= clamped.sum(-1, keepdims=True)
        best = exact.length(exact.mixed(clamped, corners[near]) - part[:, None]).argmin(1)
        rows = np.arange(len(part))
        faces[start : start + 512] = candidates[near[rows, best]]
        weights[start : start + 512] = clamped[rows, best]
    return faces, weights


def _barycentric(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    a, b, c = corners[..., 0, :], corners[..., 1, :], corners[..., 2, :]
    e1, e2, d = b - a, c - a, points - a
    d11, d12, d22 = exact.dot(e1, e1), exact.dot(e1, e2), exact.dot(e2, e2)
    p1, p2 = exact.dot(d, e1), exact.dot(d, e2)
    determinant = np.maximum(d11 * d22 - d12 * d12, 1e-18)
    v, w = (d22 * p1 - d12 * p2) / determinant, (d11 * p2 - d12 * p1) / determinant
    return np.stack([1 - v - w, v, w], -1)


@dataclass(frozen=True)
class Lashes:
    """Lashes along the posed rims of the lids, outwards from the eyeball. Upper ones curl up."""

    eye_radius: float
    """Radius of an eyeball in metres."""

    def posed(self, pose: HeadPose) -> Strands:
        """Return the strands on a posed head, in the head frame."""
        points, outwards, widths, steps = [], [], [], 4
        on_lid = self.eye_radius + 0.0012
        for side, center in zip(places.SIDES, pose.eye_centers, strict=True):
            for rims, longest, curl, count in (
                (places.UPPER_LIDS, 0.0058, 0.62, 44),
                (places.LOWER_LIDS, 0.0030, -0.5, 24),
            ):
                roots = resample(pose.landmarks[list(rims[side])], count + 6)[3:-3]
                radial = unit(roots - center)
                # If landmarks lie on the inner fold of a lid, lashes still start on its outside.
                roots = center + np.maximum(exact.length(roots - center)[:, None], on_lid) * radial
                aside = np.linspace(0.6, -0.25, count)[:, None] * np.array([1.0 if side == "left" else -1.0, 0, 0])
                vary = 1 + 0.25 * np.sin(np.arange(count) * 12.9898) * np.cos(np.arange(count) * 4.1)
                upward = np.array([0.0, 1.0, 0.0]) - radial[:, 1:2] * radial
                t = np.linspace(0, 1, steps)[None, :, None]
                reach = (longest * vary * (0.65 + 0.35 * np.sin(np.linspace(0.2, 2.6, count))))[:, None, None]
                bend = t * (radial + 0.5 * aside)[:, None] + curl * t * t * upward[:, None]
                points.append(roots[:, None] + reach * bend)
                outwards.append(np.repeat(radial[:, None], steps, 1))
                widths.append(np.repeat((0.0003 if curl > 0 else 0.00016) * np.linspace(1, 0.4, steps)[None], count, 0))
        return Strands(
            np.concatenate(points).astype(np.float32), np.concatenate(widths).astype(np.float32),
            np.full((sum(map(len, points)), steps, 3), 0.012, np.float32), np.concatenate(outwards).astype(np.float32),
        )  # fmt: skip
