"""Paint a subject's skin: albedo, bumps and gloss as textures, from solid noise and the anatomy."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float

from mien.camera import Camera
from mien.lab.synthetic import anatomy as places
from mien.lab.synthetic.anatomy import SIDES, Anatomy, FrontView, face_view
from mien.lab.synthetic.arithmetic import SolidNoise, smoothstep
from mien.lab.synthetic.facial_hair import beard_zone
from mien.lab.synthetic.recipe import PEOPLE, SyntheticRecipe
from mien.machine import exact
from mien.render.mesh import interpolate, rasterize_mesh


@dataclass(frozen=True, eq=False)
class SkinTextures:
    """Skin textures of one subject, in the conventions of `mien.render.mesh.sample_texture`."""

    channels: Float[np.ndarray, "s s 7"]
    """Linear albedo (3), gradient of the bumps' height along the skin in the head frame at rest (3), gloss (1)."""
    uv: Float[np.ndarray, "u 2"]
    """The model's texture coordinates, scaled so that the skin fills the texture."""


@dataclass(frozen=True, eq=False)
class _Canvas:
    """Covered texels as points on the head at rest."""

    covered: Bool[np.ndarray, "s s"]
    points: Float[np.ndarray, "n 3"]
    ears: Float[np.ndarray, " n"]
    neck: Float[np.ndarray, " n"]
    height: Float[np.ndarray, " n"]
    """Height of bumps in metres."""
    albedo: Float[np.ndarray, "n 3"]
    gloss: Float[np.ndarray, " n"]


def paint_skin(
    anatomy: Anatomy, recipe: SyntheticRecipe, seed: int, hair_color: Float[np.ndarray, " 3"]
) -> SkinTextures:
    """Paint the textures of a subject's skin."""
    random, noise = np.random.default_rng([seed, 5]), SolidNoise(seed + 5)
    uv = _fitted_uv(anatomy)
    canvas, positions = _canvas(anatomy, uv, recipe.texture_size)
    tone = np.array(PEOPLE["colors"]["skin"][random.choice(5, p=[0.3, 0.3, 0.2, 0.12, 0.08])], np.float32)
    canvas.albedo[:] = tone * np.exp(random.normal(0, 0.04))
    view = face_view(anatomy)
    _paint_zones(canvas, anatomy, noise)
    _paint_detail(canvas, anatomy, noise, random, recipe.detail.pores)
    _paint_eyes(canvas, anatomy, view)
    stubble = max(recipe.stubble, 0.12 * (random.uniform() < 0.5), 0.8 * (recipe.beard > 0))
    _paint_stubble(canvas, anatomy, noise, stubble, hair_color)
    _paint_lips(canvas, anatomy, view, noise, tone)
    _paint_brows(canvas, anatomy, view, noise, hair_color)
    if recipe.make_up > 0:
        _paint_make_up(canvas, anatomy, view, recipe.make_up)
    if recipe.hair != "none":
        # Long hair is combed away from the hairline, where skin shows.
        lowered = np.array([0, 0.022 if recipe.hair == "long" else 0.0, 0], np.float32)
        share = 0.85 * anatomy.hair_share(canvas.points - lowered)[:, None]
        canvas.albedo[:] = canvas.albedo * (1 - share) + 0.5 * hair_color * share
    gradient = _surface_gradient(canvas, positions)
    channels = np.zeros((*canvas.covered.shape, 7), np.float32)
    channels[canvas.covered] = np.concatenate([canvas.albedo, gradient, canvas.gloss[:, None]], -1)
    return SkinTextures(_spread_over_borders(channels, canvas.covered), uv)


def _fitted_uv(anatomy: Anatomy) -> Float[np.ndarray, "u 2"]:
    uv = anatomy.model.uv.numpy()
    used = uv[np.unique(anatomy.model.uv_faces.numpy()[anatomy.skin])]
    low, high = used.min(0), used.max(0)
    return ((uv - low) / (high - low) * 0.99 + 0.005).astype(np.float32)


def _canvas(anatomy: Anatomy, uv: np.ndarray, size: int) -> tuple[_Canvas, np.ndarray]:
    """Rasterize the skin's triangles at their places in the texture."""
    flat = np.concatenate([uv * size, np.ones((len(uv), 1), np.float32)], -1)
    flat[:, 1] = size - flat[:, 1]
    camera = Camera(torch.eye(3), torch.eye(4), size, size)
    uv_faces = anatomy.model.uv_faces[torch.from_numpy(anatomy.skin)]
    fragments = rasterize_mesh(torch.from_numpy(flat), uv_faces, camera)
    faces = anatomy.faces[anatomy.skin]
    marks = np.stack([_vertex_share(anatomy, "ears"), _vertex_share(anatomy, "neck")], -1)
    attributes = np.concatenate([anatomy.vertices, marks], -1).astype(np.float32)
    values = interpolate(fragments, torch.from_numpy(attributes[faces]), torch.from_numpy(faces)).numpy()
    covered = fragments.face_index.numpy() >= 0
    points = values[covered]
    n = len(points)
    canvas = _Canvas(
        covered=covered, points=np.ascontiguousarray(points[:, :3]), ears=points[:, 3], neck=points[:, 4],
        height=np.zeros(n, np.float32), albedo=np.zeros((n, 3), np.float32), gloss=np.ones(n, np.float32),
    )  # fmt: skip
    return canvas, values[..., :3]


def _vertex_share(anatomy: Anatomy, region: str) -> Float[np.ndarray, " v"]:
    share = np.zeros(len(anatomy.vertices), np.float32)
    share[np.unique(anatomy.faces[anatomy.region(region)])] = 1
    return share


def _near(points: np.ndarray, center: np.ndarray, radius: float) -> Float[np.ndarray, " n"]:
    """Return a Gaussian of the distance from the centre, 1 at the centre."""
    away = points - center
    return np.exp(-exact.dot(away, away) / (2 * radius * radius))


def _paint_zones(canvas: _Canvas, anatomy: Anatomy, noise: SolidNoise) -> None:
    """Paint redder cheeks, nose, ears and chin, a yellower forehead, and reddish blotches."""
    points, marks = canvas.points, anatomy.landmarks
    red = 0.75 * canvas.ears
    for index, radius, strength in (
        *((cheek, 0.021, 0.62) for cheek in places.CHEEKS),
        (places.NOSE_TIP, 0.011, 0.75),
        *((wing, 0.008, 0.7) for wing in places.NOSE_WINGS),
        (places.CHIN, 0.014, 0.4),
    ):
        red = red + strength * _near(points, marks[index], radius)
    red = red * (1 + 0.45 * noise(points, 0.009)) + 0.16 * noise.octaves(points, 0.014, 3)
    forehead = _near(points, 0.5 * (marks[places.FOREHEAD_TOP] + marks[9]), 0.028)
    canvas.albedo[:] *= np.exp(np.outer(red, [0.02, -0.26, -0.24]) + np.outer(forehead, [0.03, 0.03, -0.05]))
    canvas.albedo[:] *= np.exp(-0.10 * canvas.neck[:, None])


def _paint_detail(
    canvas: _Canvas, anatomy: Anatomy, noise: SolidNoise, random: np.random.Generator, pores: float
) -> None:
    """Paint mottling, freckles and moles, pores and fine lines as bumps, and oil on forehead and nose."""
    points, marks = canvas.points, anatomy.landmarks
    fine, tiny = pores * noise(points, 0.0022), pores * noise(points + 0.5, 0.0011)
    canvas.albedo[:] *= np.exp(0.05 * fine + 0.05 * tiny + 0.05 * noise.octaves(points, 0.03, 2))[:, None]
    middle = 0.5 * (marks[places.CHEEKS[0]] + marks[places.CHEEKS[1]])
    freckled = np.clip(_near(points, middle + [0, 0.01, 0], 0.04) * 1.3, 0, 1) * random.uniform(0.25, 1.0)
    spots = smoothstep(0.48, 0.68, noise(points + 1.7, 0.0025) + 0.3 * tiny) * freckled
    canvas.albedo[:] *= np.exp(np.outer(spots, [-0.18, -0.34, -0.4]))
    for _ in range(random.integers(5, 10)):
        spot = points[random.integers(len(points))]
        mole = smoothstep(1.0, 0.6, exact.length(points - spot) / random.uniform(0.0009, 0.0019))
        canvas.albedo[:] *= np.exp(np.outer(mole, [-0.9, -1.3, -1.5]))
        canvas.height[:] += 0.0002 * mole
    oily = _near(points, marks[places.NOSE_TIP], 0.016) + 0.7 * _near(points, marks[9], 0.03)
    cheeks = sum(_near(points, marks[index], 0.025) for index in places.CHEEKS)
    canvas.gloss[:] = (0.7 + 0.8 * oily + 0.15 * cheeks) * (1 + 0.35 * fine + 0.2 * noise(points, 0.012))
    canvas.height[:] += 0.00004 * fine + 0.00003 * tiny * (1 + cheeks)
    brow = _near(points, 0.5 * (marks[places.FOREHEAD_TOP] + marks[9]), 0.024)
    folds = pores * noise(points * np.array([0.22, 1.0, 0.22], np.float32) + 3.1, 0.0045)
    canvas.height[:] += 0.00006 * folds * brow


def _paint_eyes(canvas: _Canvas, anatomy: Anatomy, view: FrontView) -> None:
    """Paint dark rims of the lids, pink corners, and shadows under the eyes."""
    points = canvas.points
    in_front = smoothstep(anatomy.landmarks[33, 2] - 0.02, anatomy.landmarks[33, 2] - 0.01, points[:, 2])
    for side in SIDES:
        upper, lower = anatomy.curve(places.UPPER_LIDS[side], 40), anatomy.curve(places.LOWER_LIDS[side], 40)
        around = view.look_up(view.polygon(np.concatenate([upper, lower[::-1]]), 0.006), points) * in_front
        below = view.look_up(view.polygon(lower - [0, 0.007, 0], 0.003), points) * in_front
        under = view.look_up(view.line(lower - [0, 0.008, 0], 0.004, 0.003), points) * in_front
        rim = view.look_up(view.line(lower, 0.0012, 0.0006), points) * in_front
        lash = view.look_up(view.line(upper, 0.0014, 0.0005), points) * in_front
        dark = np.outer(around, [-0.16, -0.26, -0.2]) + np.outer(under + below, [-0.09, -0.14, -0.08])
        canvas.albedo[:] *= np.exp(dark + np.outer(rim, [-0.10, -0.4, -0.35]) + np.outer(lash, [-1.5, -1.6, -1.6]))
        canvas.gloss[:] += 0.5 * rim


def _paint_lips(canvas: _Canvas, anatomy: Anatomy, view: FrontView, noise: SolidNoise, tone: np.ndarray) -> None:
    """Paint lips: redder and darker than the skin, moist, with fine vertical lines."""
    points = canvas.points
    corner = anatomy.landmarks[list(places.LIPS_OUTER), 2].min()
    in_front = smoothstep(corner - 0.016, corner - 0.008, points[:, 2])
    mask = view.look_up(view.polygon(anatomy.landmarks[list(places.LIPS_OUTER)], 0.0007), points) * in_front
    soft = view.look_up(view.polygon(anatomy.landmarks[list(places.LIPS_OUTER)], 0.0025), points) * in_front
    lines = noise(points * np.array([1.0, 0.16, 0.5], np.float32) + 9.0, 0.0013)
    color = tone * np.array([0.78, 0.40, 0.45], np.float32)
    painted = color * np.exp(0.12 * lines + 0.10 * noise(points, 0.004))[:, None]
    # The vermilion border is a slightly lighter line around the lips.
    canvas.albedo[:] *= 1 + 0.25 * (soft * (1 - mask))[:, None]
    share = 0.88 * mask[:, None]
    canvas.albedo[:] = canvas.albedo * (1 - share) + painted * share
    seam = view.look_up(view.line(anatomy.curve(places.LIPS_INNER[:11], 40), 0.0006, 0.0007), points) * in_front
    canvas.albedo[:] *= np.exp(-0.7 * seam * mask)[:, None]
    canvas.gloss[:] += 1.1 * mask
    canvas.height[:] += mask * 0.00008 * lines


def _paint_brows(canvas: _Canvas, anatomy: Anatomy, view: FrontView, noise: SolidNoise, hair_color: np.ndarray) -> None:
    """Paint the shadow under the brows, and hairs where no strands will be."""
    points = canvas.points
    for side in SIDES:
        upper, lower = (anatomy.landmarks[list(c[side])] for c in (places.BROWS_UPPER, places.BROWS_LOWER))
        outline = np.concatenate([upper, lower[::-1]])
        middle = outline.mean(0)
        outline = middle + (outline - middle) * np.array([1.02, 0.78, 1.0])
        in_front = smoothstep(middle[2] - 0.05, middle[2] - 0.03, points[:, 2])
        mask = view.look_up(view.polygon(outline, 0.0014), points) * in_front
        hairs = noise(exact.product(points, np.array([[0.5, 0.5, 0], [0.35, 2.0, 0], [0.0, 0, 1]], np.float32)), 0.0019)
        share = np.clip(mask * (0.62 + 0.4 * hairs), 0, 0.9)[:, None]
        canvas.albedo[:] = canvas.albedo * (1 - share) + hair_color * share
        canvas.gloss[:] *= 1 - 0.7 * mask


_LIPSTICK = np.array([0.30, 0.018, 0.03], np.float32)
_EYE_SHADOW = np.array([0.05, 0.03, 0.045], np.float32)
_BROW_PENCIL = np.array([0.02, 0.013, 0.01], np.float32)


def _paint_make_up(canvas: _Canvas, anatomy: Anatomy, view: FrontView, strength: float) -> None:
    """Paint red lips, dark lids with a line along the lashes, and filled brows."""
    marks, points = anatomy.landmarks, canvas.points
    in_front = smoothstep(marks[places.EAR, 2], marks[places.EAR, 2] + 0.02, points[:, 2])

    def paint(mask: np.ndarray, color: np.ndarray, share: float) -> None:
        amount = (strength * share * mask * in_front)[:, None]
        canvas.albedo[:] = canvas.albedo * (1 - amount) + color * amount

    paint(view.look_up(view.polygon(marks[list(places.LIPS_OUTER)], 0.0009), points), _LIPSTICK, 0.85)
    for side in SIDES:
        lid = marks[list(places.UPPER_LIDS[side])]
        brow = marks[list(places.BROWS_LOWER[side])]
        crease = lid + 0.55 * (brow.mean(0) - lid.mean(0))
        paint(view.look_up(view.polygon(np.concatenate([lid, crease[::-1]]), 0.003), points), _EYE_SHADOW, 0.6)
        for lids in (places.UPPER_LIDS[side], places.LOWER_LIDS[side]):
            paint(view.look_up(view.line(anatomy.curve(lids, 40), 0.0009, 0.0009), points), _EYE_SHADOW, 0.8)
        outline = np.concatenate([marks[list(places.BROWS_UPPER[side])], brow[::-1]])
        paint(view.look_up(view.polygon(outline, 0.001), points), _BROW_PENCIL, 0.9)


def _paint_stubble(
    canvas: _Canvas, anatomy: Anatomy, noise: SolidNoise, strength: float, hair_color: np.ndarray
) -> None:
    """Paint dots of cut hair over upper lip, chin and jaw."""
    if strength <= 0:
        return
    points = canvas.points
    zone = beard_zone(anatomy, points)
    dots = smoothstep(0.1, 0.5, noise(points + 4.2, 0.0008)) * (0.7 + 0.3 * noise(points, 0.006))
    share = (strength * zone * (0.28 + 0.6 * dots))[:, None]
    canvas.albedo[:] = canvas.albedo * (1 - share) + (0.6 * hair_color + 0.02) * share
    canvas.gloss[:] *= 1 - 0.4 * strength * zone
    canvas.height[:] += 0.00006 * strength * zone * dots


def _surface_gradient(canvas: _Canvas, positions: Float[np.ndarray, "s s 3"]) -> Float[np.ndarray, "n 3"]:
    """Return the gradient of the height along the surface as a tangent vector in space; 0 at the borders of charts."""
    height = np.zeros(canvas.covered.shape, np.float32)
    height[canvas.covered] = canvas.height

    def central(image: np.ndarray, axis: int) -> np.ndarray:
        return 0.5 * (np.roll(image, -1, axis) - np.roll(image, 1, axis))

    inner = cv2.erode(canvas.covered.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)[canvas.covered]
    along = [central(positions, axis)[canvas.covered] for axis in (1, 0)]
    rise = [central(height, axis)[canvas.covered] for axis in (1, 0)]
    a, b, c = (exact.dot(*pair) for pair in ((along[0], along[0]), (along[0], along[1]), (along[1], along[1])))
    determinant = np.maximum(a * c - b * b, 1e-16)
    u, v = (c * rise[0] - b * rise[1]) / determinant, (a * rise[1] - b * rise[0]) / determinant
    gradient = u[:, None] * along[0] + v[:, None] * along[1]
    steep = exact.length(gradient)[:, None]
    return (gradient * np.minimum(1, 0.7 / np.maximum(steep, 1e-6)) * inner[:, None]).astype(np.float32)


def _spread_over_borders(channels: Float[np.ndarray, "s s c"], covered: Bool[np.ndarray, "s s"]) -> np.ndarray:
    """Extend the borders of charts outwards, so that interpolation between texels does not bleed."""
    known = covered.astype(np.float32)
    for _ in range(4):
        weight = cv2.blur(known, (3, 3))
        grown = np.stack([cv2.blur(channels[..., i] * known, (3, 3)) for i in range(channels.shape[-1])], -1)
        new = (known == 0) & (weight > 0)
        channels[new] = grown[new] / weight[new][:, None]
        known[new] = 1
    return channels
