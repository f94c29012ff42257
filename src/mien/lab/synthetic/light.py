"""Light as 9 spherical-harmonic coefficients (a soft key from one side, a fill, a rim and the room), and shadows."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int

from mien.camera import Camera, look_at
from mien.lab.synthetic.posing import project
from mien.machine import exact
from mien.render.mesh import rasterize_mesh, sh_basis

# Clamped cosine in spherical harmonics of degrees 0, 1, 2 (Ramamoorthi and Hanrahan 2001, "An efficient representation
# for irradiance environment maps").
_CLAMPED_COSINE = np.array([math.pi] + [2 * math.pi / 3] * 3 + [math.pi / 4] * 5, np.float32)
# Factors of `mien.render.mesh.sh_basis`.
_SH_FACTORS = np.array([
    0.28209479177387814, *[0.4886025119029199] * 3, *[1.0925484305920792] * 2, 0.31539156525252005,
    1.0925484305920792, 0.5462742152960396,
])  # fmt: skip
_DIRECTION_COUNT = 112
_MAP_SIZE = 224
_MAP_DISTANCE = 20.0  # metres: nearly parallel rays, and depths that float32 can still separate


@dataclass(frozen=True, eq=False)
class Lamp:
    """A distant soft light."""

    direction: Float[np.ndarray, " 3"]
    """Unit direction towards the lamp, in world space."""
    color: Float[np.ndarray, " 3"]
    """Linear colour that a white surface facing the lamp reflects."""
    spread: float
    """Concentration of the lamp's lobe in shadows and highlights. A larger value is smaller and harder."""


@dataclass(frozen=True, eq=False)
class Lighting:
    """All light of a scene, fixed in world space."""

    lamps: tuple[Lamp, ...]
    ambient: Float[np.ndarray, " 3"]
    """Linear colour that a white surface reflects from the room's light."""

    @property
    def sh_light(self) -> Float[np.ndarray, "9 3"]:
        """Coefficients for `mien.render.mesh.shade` with world-space normals."""
        coefficients = np.zeros((9, 3), np.float32)
        coefficients[0] = self.ambient * math.sqrt(4 * math.pi)
        # The room is brighter above than below.
        coefficients[1] += 0.35 * self.ambient / 0.4886
        for lamp in self.lamps:
            basis = sh_basis(torch.from_numpy(lamp.direction)).numpy()
            coefficients += (_CLAMPED_COSINE * basis)[:, None] * lamp.color
        return coefficients

    def radiance(self, directions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return the brightness of each direction of world space, in arbitrary units: the lamps' lobes and the room."""
        total = self.ambient * (1 + 0.5 * directions[:, 1:2]) / 4
        for lamp in self.lamps:
            lobe = np.exp(lamp.spread * (exact.dot(directions, lamp.direction) - 1)) * lamp.spread / (2 * math.pi)
            total = total + lobe[:, None] * lamp.color
        return total.astype(np.float32)


def irradiance_polynomial(sh_light: Float[np.ndarray, "9 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return `mien.render.mesh.shade` as a polynomial of the normal: `constant + linear @ n + n @ square @ n`.

    The shapes are [3], [3, 3] and [3, 3, 3]. The first axis is the colour channel.
    """
    one, y, z, x, xy, yz, zz, xz, xx_yy = (sh_light * _SH_FACTORS[:, None])[..., None]
    square = np.concatenate([xx_yy, 0.5 * xy, 0.5 * xz, 0.5 * xy, -xx_yy, 0.5 * yz, 0.5 * xz, 0.5 * yz, 3 * zz], -1)
    return (one - zz)[:, 0], np.concatenate([x, y, z], -1), square.reshape(3, 3, 3)


def studio_lighting(seed: int) -> Lighting:
    """Return a key from above one side, a weak fill, and a rim from behind the other side."""
    random = np.random.default_rng([seed, 2])
    side = random.choice([-1.0, 1.0])
    warm = random.uniform(-0.04, 0.06)
    key = np.array([1 + warm, 1.0, 1 - 1.4 * warm])
    return Lighting(
        lamps=(
            Lamp(_direction(0.75 * side, 0.62, 0.85), (1.2 * key).astype(np.float32), 9.0),
            Lamp(_direction(-0.8 * side, 0.15, 0.75), np.array([0.10, 0.11, 0.125], np.float32), 4.0),
            Lamp(_direction(-0.7 * side, 0.5, -0.75), np.array([0.40, 0.43, 0.48], np.float32), 8.0),
        ),
        ambient=np.array([0.155, 0.16, 0.17], np.float32),
    )


@dataclass(frozen=True, eq=False)
class Visibility:
    """Visibility of directions from each vertex, past the whole scene at rest, in the head frame."""

    directions: Float[np.ndarray, "d 3"]
    transfer: Float[np.ndarray, "d v"]
    """Visible share times the clamped cosine."""
    unshadowed: Float[np.ndarray, "d v"]
    """The clamped cosine alone."""

    def shadow(self, lighting: Lighting, R_world_head: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "v 3"]:
        """Return the share of the light, per colour channel, that reaches each vertex in this head pose."""
        radiance = lighting.radiance(exact.rotated(self.directions, R_world_head))
        lit, full = (_weighed(radiance, cosines) for cosines in (self.transfer, self.unshadowed))
        return (lit + 1e-4) / (full + 1e-4)


def _weighed(radiance: Float[np.ndarray, "d 3"], cosines: Float[np.ndarray, "d v"]) -> Float[np.ndarray, "v 3"]:
    """Sum the light of all directions at each vertex, one direction at a time."""
    total = np.zeros((3, cosines.shape[1]), np.float32)
    part = np.empty(cosines.shape[1], np.float32)
    for row, color in zip(cosines, radiance, strict=True):
        for channel in range(3):
            total[channel] += np.multiply(row, color[channel], out=part)
    return np.ascontiguousarray(total.T)


def compute_visibility(
    points: Float[np.ndarray, "v 3"],
    normals: Float[np.ndarray, "v 3"],
    occluders: tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "f 3"]] | None,
) -> Visibility:
    """Compute shadow maps from all directions. A point is lit if its depth is the nearest one, within 2 mm.

    Without occluders nothing is in shadow.
    """
    index = np.arange(_DIRECTION_COUNT) + 0.5
    polar, azimuth = np.arccos(1 - 2 * index / _DIRECTION_COUNT), math.pi * (1 + 5**0.5) * index  # Fibonacci's spiral
    directions = np.stack([np.sin(polar) * np.cos(azimuth), np.cos(polar), np.sin(polar) * np.sin(azimuth)], -1)
    directions = directions.astype(np.float32)
    unshadowed = np.clip(exact.product(directions, normals.T), 0, None)
    if occluders is None:
        return Visibility(directions, unshadowed, unshadowed)
    visible = np.stack([_lit_share(points + 0.0015 * normals, direction, occluders) for direction in directions])
    return Visibility(directions, unshadowed * visible, unshadowed)


def _lit_share(
    points: np.ndarray, direction: np.ndarray, occluders: tuple[np.ndarray, np.ndarray]
) -> Float[np.ndarray, " v"]:
    center = torch.from_numpy(occluders[0].mean(0))
    radius = float(exact.length(occluders[0] - occluders[0].mean(0)).max()) * 1.02
    up = torch.tensor([0.0, 1.0, 0.0]) if abs(direction[1]) < 0.9 else torch.tensor([0.0, 0.0, 1.0])
    focal = 0.5 * _MAP_SIZE * _MAP_DISTANCE / radius
    K = torch.tensor([[focal, 0, _MAP_SIZE / 2], [0, focal, _MAP_SIZE / 2], [0, 0, 1]])
    viewmat = look_at(center + _MAP_DISTANCE * torch.from_numpy(direction), center, up)
    camera = Camera(K, viewmat, _MAP_SIZE, _MAP_SIZE)
    depth_map = rasterize_mesh(torch.from_numpy(occluders[0]), torch.from_numpy(occluders[1]), camera).depth.numpy()
    pixels, depth = project(camera, points)
    lit = np.zeros(len(points), np.float32)
    for dx in (-1, 0, 1):
        for dy in (-1, 0, 1):
            column = np.clip((pixels[:, 0] + dx).astype(np.int64), 0, _MAP_SIZE - 1)
            row = np.clip((pixels[:, 1] + dy).astype(np.int64), 0, _MAP_SIZE - 1)
            lit += depth < depth_map[row, column] + 0.002
    return lit / 9


def _direction(x: float, y: float, z: float) -> np.ndarray:
    vector = np.array([x, y, z], np.float32)
    return vector / exact.length(vector)
