"""Shade each material of a synthetic person, in the head frame and in linear colour."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mien.lab.synthetic.arithmetic import along, smoothstep, unit
from mien.lab.synthetic.hair import Strands
from mien.lab.synthetic.light import Lighting, irradiance_polynomial
from mien.machine import exact
from mien.machine.exact import dot

_MIN_HIGHLIGHT = 0.2
"""Weaker lamps contribute only diffuse light."""


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
    normals: Float[np.ndarray, "n 3"],
    views: Float[np.ndarray, "n 3"],
    light: LocalLight,
    lobes: tuple[tuple[float, float], ...],
) -> Float[np.ndarray, "n 3"]:
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
    channels: Float[np.ndarray, "n 7"],
    normals: Float[np.ndarray, "n 3"],
    shadow: Float[np.ndarray, "n 3"],
    views: Float[np.ndarray, "n 3"],
    light: LocalLight,
) -> Float[np.ndarray, "n 3"]:
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
    views = unit(viewpoint - strands.points)
    along_view = dot(tangents, views)
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
    local: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    axis: Float[np.ndarray, " 3"],
    under_lid: Float[np.ndarray, " n"],
    views: Float[np.ndarray, "n 3"],
    light: LocalLight,
    iris: tuple[float, np.ndarray, bool],
) -> Float[np.ndarray, "n 3"]:
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
    bowl = unit(normals - 1.2 * share * outward)
    diffuse = albedo * light.irradiance(bowl.astype(np.float32)) * shadow
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
    rest: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    depth: Float[np.ndarray, " n"],
    views: Float[np.ndarray, "n 3"],
    light: LocalLight,
) -> Float[np.ndarray, "n 3"]:
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
    normals: Float[np.ndarray, "n 3"],
    depth: Float[np.ndarray, " n"],
    views: Float[np.ndarray, "n 3"],
    light: LocalLight,
) -> Float[np.ndarray, "n 3"]:
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
