"""The light of a scene, what shades what, and how each material of a synthetic person looks in it, in linear colour.

The light is 9 spherical-harmonic coefficients: a soft key from one side, a fill, a rim and the room. Materials are
shaded in the head frame.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int

from mien.camera import Camera, look_at
from mien.lab.synthetic.arithmetic import along, smoothstep, unit
from mien.lab.synthetic.hair import Strands
from mien.lab.synthetic.posing import project
from mien.machine import exact
from mien.machine.exact import dot
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
_MIN_HIGHLIGHT = 0.2
"""Weaker lamps contribute only diffuse light."""


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


@dataclass(frozen=True, eq=False)
class LocalLight:
    """A scene's light relative to the turned head."""

    quadratic: Float[np.ndarray, "10 3"]
    """Irradiance as a polynomial of the normal: factors of xx, yy, zz, xy, yz, xz, x, y, z, 1."""
    lamps: tuple[tuple[np.ndarray, np.ndarray], ...]
    """Direction (head frame) and colour of each lamp that is bright enough for highlights."""

    def irradiance(self, normals: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return the light that a white surface reflects."""
        x, y, z = np.ascontiguousarray(normals.T)
        out = np.empty((len(x), 3), np.float32)
        for channel, (xx, yy, zz, xy, yz, xz, fx, fy, fz, one) in enumerate(self.quadratic.T):
            total = x * (xx * x + xy * y + xz * z + fx)
            total += y * (yy * y + yz * z + fy)
            total += z * (zz * z + fz)
            total += one
            np.maximum(total, 0, out=out[:, channel])
        return out


def turn_light(lighting: Lighting, R_world_head: Float[np.ndarray, "3 3"]) -> LocalLight:
    """Return the light for one head pose."""
    constant, linear, square = (part.astype(np.float64) for part in irradiance_polynomial(lighting.sh_light))
    R = R_world_head.astype(np.float64)
    linear = exact.product(linear, R)
    square = exact.product(exact.product(R.T, square), R)
    # Since xx + yy + zz = 1, part of the constant can move into the squares. This share makes all factors small.
    share = (constant - square[:, 0, 0] - square[:, 1, 1] - square[:, 2, 2]) / 4
    rows = [square[:, axis, axis] + share for axis in range(3)]
    rows += [2 * square[:, first, second] for first, second in ((0, 1), (1, 2), (0, 2))]
    quadratic = np.stack([*rows, *linear.T, constant - share]).astype(np.float32)
    bright = [lamp for lamp in lighting.lamps if lamp.color.max() > _MIN_HIGHLIGHT]
    lamps = tuple((exact.rotated(lamp.direction, R_world_head.T).astype(np.float32), lamp.color) for lamp in bright)
    return LocalLight(quadratic, lamps)


def shade_highlights(
    normals: Float[np.ndarray, "n 3"], views: Float[np.ndarray, "n 3"], light: LocalLight,
    lobes: tuple[tuple[float, float], ...],
) -> Float[np.ndarray, "n 3"]:  # fmt: skip
    """Return the specular part of the lamps' light.

    Each lobe has a weight and a sharpness. It is normalised, so that a sharper lobe is brighter and smaller.
    """
    total = np.zeros_like(normals)
    for direction, color in light.lamps:
        half = unit(views + direction)
        fresnel = 0.028 + 0.97 * (1 - np.clip(dot(views, half), 0, 1)) ** 5
        away = dot(normals, half) - 1
        strength = sum((0.125 * weight * sharpness) * np.exp(sharpness * away) for weight, sharpness in lobes)
        strength = strength * fresnel * (along(normals, direction) > 0)
        for channel in range(3):
            total[:, channel] += strength * color[channel]
    return total


def shade_skin(
    channels: Float[np.ndarray, "n 7"], normals: Float[np.ndarray, "n 3"], shadow: Float[np.ndarray, "n 3"],
    views: Float[np.ndarray, "n 3"], light: LocalLight,
) -> Float[np.ndarray, "n 3"]:  # fmt: skip
    """Shade skin: diffuse light that bleeds red into shadows, and an oily sheen."""
    albedo, gradient, gloss = channels[:, :3], channels[:, 3:6], channels[:, 6:7]
    normals = unit(unit(normals) - gradient)
    diffuse = albedo * light.irradiance(normals) * shadow
    grazing = 1 - np.clip(dot(normals, views), 0, 1)[:, None]
    sheen = shade_highlights(normals, views, light, ((0.30, 26.0), (0.12, 120.0)))
    return diffuse + shadow * gloss * (sheen + 0.06 * grazing**4)


def shade_hair(strands: Strands, light: LocalLight, viewpoint: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "n s 3"]:
    """Shade hair as cylinders, bright where light comes across them (Kajiya and Kay 1989), with two highlights."""
    tangents, outwards = strands.tangents, strands.outwards
    n, s = strands.widths.shape
    room = light.irradiance(np.ascontiguousarray(outwards.reshape(-1, 3))).reshape(n, s, 3)
    colors = 0.75 * strands.colors * room
    along_view = dot(tangents, unit(viewpoint - strands.points))
    across_view = np.sqrt(np.maximum(1 - along_view**2, 0))
    relative = strands.colors / (strands.colors.max(-1, keepdims=True) + 1e-6)
    depth = np.clip(strands.colors.max(-1) / strands.colors.max(), 0, 1)  # hair under other hair is darker
    for direction, color in light.lamps:
        lengthwise = along(tangents, direction)
        across = np.sqrt(np.maximum(1 - lengthwise**2, 0))
        lit = np.clip(0.3 + 0.7 * along(outwards, direction), 0, 1)
        aligned = across * across_view - lengthwise * along_view
        first = np.exp(52 * (aligned - 1))
        second = np.exp(16 * (aligned - 1.05))
        colors += (0.55 * lit * across)[..., None] * strands.colors * color
        colors += (0.055 * lit * depth * first)[..., None] * color
        colors += (0.05 * lit * depth * second)[..., None] * relative * color
    return colors


def shade_eye(
    local: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], axis: Float[np.ndarray, " 3"],
    under_lid: Float[np.ndarray, " n"], views: Float[np.ndarray, "n 3"], light: LocalLight,
    iris: tuple[float, np.ndarray, bool],
) -> Float[np.ndarray, "n 3"]:  # fmt: skip
    """Shade an eye: white with veins towards the corners; iris with fibres, limbal ring and pupil; a wet cornea.

    `local` are directions from the eyeball's centre, +z along the line of sight; `normals` the same and `axis` the line
    of sight, both in the head frame. `under_lid` is the distance below the upper lid's rim, in metres, and `iris` its
    size (sine of the angle to its rim), its colour, and whether the eye is wet.
    """
    size, color, is_wet = iris
    radius = exact.length(local[:, :2])
    q = radius / size
    turn = np.arctan2(local[:, 1], local[:, 0])
    fibres = _fibres(turn, q)
    inner = smoothstep(0.95, 0.35, q)[:, None]
    iris_albedo = color * (0.75 + 0.5 * fibres)[:, None] * (1 + inner * np.array([0.7, 0.35, 0.0], np.float32))
    iris_albedo = iris_albedo * (1 - 0.75 * smoothstep(0.78, 1.0, q))[:, None]
    iris_albedo = iris_albedo * smoothstep(0.34, 0.40, q)[:, None] + 0.004
    veins = smoothstep(0.25, 0.05, np.abs(np.sin(9 * turn + 6 * np.sin(14 * radius) + 3 * local[:, 1])))
    corner = smoothstep(0.45, 0.85, np.abs(local[:, 0]))
    white = np.array([0.50, 0.46, 0.43], np.float32) * np.exp(
        np.outer(corner * (0.3 + 0.35 * veins), [-0.25, -1.0, -0.95])
    )
    share = smoothstep(1.04, 0.94, q)[:, None]
    albedo = white * (1 - share) + iris_albedo * share
    # The shadows of the lid and of the orbit: eyes are darker than a white ball.
    shadow = (0.30 + 0.70 * smoothstep(-0.0005, 0.0045, under_lid))[:, None]
    # Light through the cornea reaches the far side of the iris, so its diffuse light is like that of a bowl.
    outward = normals - along(normals, axis)[:, None] * axis
    diffuse = albedo * light.irradiance(unit(normals - 1.2 * share * outward).astype(np.float32)) * shadow
    if not is_wet:
        return diffuse
    cornea = unit(normals + 0.75 * outward * smoothstep(1.25, 0.9, q)[:, None])
    wet = shade_highlights(cornea, views, light, ((0.5, 900.0), (0.1, 60.0)))
    return diffuse + np.minimum(wet, 1.5) * (0.25 + 0.75 * shadow)


def _fibres(turn: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return radial streaks in -1..1, the same in every eye."""
    bend = turn + 0.15 * np.sin(5 * q)
    waves = np.sin(23 * bend + 2 * np.sin(7 * turn)) + 0.7 * np.sin(41 * bend + 3 * np.cos(3 * turn) + 5 * q)
    return 0.6 * waves + 0.3 * np.sin(71 * turn - 9 * q)


def shade_teeth(
    rest: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], depth: Float[np.ndarray, " n"],
    views: Float[np.ndarray, "n 3"], light: LocalLight,
) -> Float[np.ndarray, "n 3"]:  # fmt: skip
    """Shade teeth: off-white, with a gap every 8 mm along the arch.

    `depth` is the distance behind the foremost tooth in metres; deeper teeth get less light.
    """
    along = rest[:, 0] / 0.0082
    place = along - np.round(along - 0.5) - 0.5
    gap = smoothstep(0.42, 0.5, np.abs(place))
    # Normals point out of the arch and are rounded over each tooth. The coarse mesh's own normals are too rough.
    across = rest[:, 0] / 0.032 + 2.0 * np.sign(place) * place**2
    rounded = 0.3 * normals + np.stack([across, np.full_like(place, 0.1), np.ones_like(place)], -1)
    rounded = unit(rounded).astype(np.float32)
    albedo = np.array([0.70, 0.64, 0.52], np.float32) * (1 - 0.5 * gap)[:, None]
    scarce = 0.9 * np.exp(-np.clip(depth - 0.005, 0, None) / 0.010)[:, None]
    return (
        albedo * light.irradiance(rounded) * 0.8 + shade_highlights(rounded, views, light, ((0.35, 150.0),))
    ) * scarce


def shade_mouth(
    normals: Float[np.ndarray, "n 3"], depth: Float[np.ndarray, " n"], views: Float[np.ndarray, "n 3"],
    light: LocalLight,
) -> Float[np.ndarray, "n 3"]:  # fmt: skip
    """Shade the mouth as wet dark flesh: gums, tongue, the inside of the cheeks."""
    scarce = np.exp(-np.clip(depth - 0.006, 0, None) / 0.012)[:, None]
    albedo = np.array([0.34, 0.085, 0.075], np.float32)
    # All light comes from the opening: use the room's light for a surface that faces it, not for the surface's own
    # normal.
    opening = light.irradiance(np.array([[0.0, 0.1, 0.995]], np.float32))
    return (
        albedo * opening * 0.8 + 0.5 * scarce * shade_highlights(normals, views, light, ((0.2, 40.0),))
    ) * scarce + 0.002


def shade_frame(
    normals: Float[np.ndarray, "n 3"], views: Float[np.ndarray, "n 3"], light: LocalLight
) -> Float[np.ndarray, "n 3"]:
    """Shade the frame as dark polished plastic."""
    albedo = np.array([0.016, 0.011, 0.009], np.float32)
    return albedo * light.irradiance(normals) + shade_highlights(normals, views, light, ((0.9, 90.0),))


def shade_lens(
    normals: Float[np.ndarray, "n 3"], views: Float[np.ndarray, "n 3"], light: LocalLight
) -> Float[np.ndarray, "n 3"]:
    """Return the light that a coated lens adds to what is behind it."""
    grazing = 1 - np.abs(dot(normals, views))[:, None]
    room = np.array([0.010, 0.013, 0.014], np.float32) * (1 + 8 * grazing**3)
    return room + shade_highlights(normals, views, light, ((0.2, 60.0),))
