"""A full beard: moustache, chin and jaw, made of strands that grow on the skin and move with it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from mien import exact
from mien.synthetic import anatomy as places
from mien.synthetic.anatomy import Anatomy, face_view
from mien.synthetic.hair import Strands, unit
from mien.synthetic.noise import SolidNoise, smoothstep

_COUNT, _STEPS = 5200, 7


@dataclass(frozen=True, eq=False)
class RootedStrands:
    """Strands that each keep their shape in the frame of the skin where they grow."""

    faces: Int[np.ndarray, " n"]
    """Index of each root's triangle in the face model."""
    barycentric: Float[np.ndarray, "n 3"]
    local: Float[np.ndarray, "n s 3"]
    """Offsets from the root in the frame of `_frames`, in metres."""
    widths: Float[np.ndarray, "n s"]
    colors: Float[np.ndarray, "n s 3"]

    def posed(self, anatomy: Anatomy, vertices: Float[np.ndarray, "v 3"], normals: Float[np.ndarray, "v 3"]) -> Strands:
        """Return the strands on a posed head, in the head frame."""
        roots, frames = _frames(anatomy, self.faces, self.barycentric, vertices, normals)
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


def full_beard(anatomy: Anatomy, color: Float[np.ndarray, " 3"], length: float, seed: int) -> RootedStrands:
    """Grow hairs that leave the skin at a slant, down and sideways, and curl; `length` at the chin is in metres."""
    random, noise = np.random.default_rng([seed, 10]), SolidNoise(seed + 53)
    faces, barycentric, roots = _roots(anatomy, random)
    _, frames = _frames(anatomy, faces, barycentric, anatomy.vertices, anatomy.normals)
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
    reach = length * (0.30 + 0.25 * moustache + 0.75 * at_chin) * random.uniform(0.6, 1.15, _COUNT)
    reach = np.where(moustache > 0.5, np.minimum(reach, 0.45 * length), reach)
    curl = unit(random.normal(0, 1, (_COUNT, 3))) * 0.0012
    t = np.linspace(0, 1, _STEPS)[None, :, None]
    slant = normals[:, None] * (0.75 - 0.45 * t) + down[:, None] * (0.35 + 0.75 * t)
    bend = curl[:, None] * np.sin(2 * np.pi * t * random.uniform(0.8, 1.6, (_COUNT, 1, 1)))
    offsets = reach[:, None, None] * t * slant + bend * t - 0.0006 * normals[:, None]
    tint = np.exp(0.22 * random.normal(size=(_COUNT, 1)) + 0.15 * noise(roots, 0.01)[:, None])
    grey = random.uniform(size=(_COUNT, 1)) < 0.05
    shade = (0.45 + 0.55 * np.linspace(0, 1, _STEPS)) * tint
    colors = np.where(grey[..., None], 0.25, color) * shade[..., None]
    return RootedStrands(
        faces=faces,
        barycentric=barycentric,
        local=exact.product(offsets, frames).astype(np.float32),
        widths=(0.00062 * np.linspace(1, 0.45, _STEPS) * random.uniform(0.8, 1.2, (_COUNT, 1))).astype(np.float32),
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
    while sum(len(part[0]) for part in kept) < _COUNT:
        chosen = random.choice(len(candidates), size=_COUNT, p=weights / weights.sum())
        barycentric = random.dirichlet((1, 1, 1), _COUNT).astype(np.float32)
        points = exact.mixed(barycentric, corners[chosen]).astype(np.float32)
        in_front = points[:, 2] > anatomy.landmarks[list(places.LIPS_OUTER), 2].min() - 0.008
        on_lips = view.look_up(lips, points) * in_front > 0.25
        above_neck = smoothstep(-0.026, -0.012, points[:, 1] - anatomy.landmarks[places.CHIN, 1])
        grows = (above_neck * beard_zone(anatomy, points) > random.uniform(0.05, 1.0, _COUNT)) & ~on_lips
        kept.append((candidates[chosen[grows]], barycentric[grows], points[grows]))
    faces, barycentric, points = (np.concatenate(parts)[:_COUNT] for parts in zip(*kept, strict=True))
    return faces, barycentric, points


def _frames(
    anatomy: Anatomy, faces: np.ndarray, barycentric: np.ndarray, vertices: np.ndarray, normals: np.ndarray
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 3"]]:
    """Return roots, and frames with these columns: tangent along the triangle's first edge, second tangent, normal."""
    index = anatomy.faces[faces]
    corners = vertices[index]
    normal = unit(exact.mixed(barycentric, normals[index]))
    edge = corners[:, 1] - corners[:, 0]
    tangent = unit(edge - exact.dot(edge, normal)[:, None] * normal)
    frames = np.stack([tangent, np.cross(normal, tangent), normal], -1).astype(np.float32)
    return exact.mixed(barycentric, corners), frames
