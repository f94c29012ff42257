"""Draw a posed subject as a camera sees it: picture and coverage."""

from collections.abc import Callable

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int, UInt8

from mien.camera import Camera
from mien.lab.synthetic import shading
from mien.lab.synthetic.anatomy import LIPS_OUTER, SIDES, UPPER_LIDS
from mien.lab.synthetic.arithmetic import SolidNoise, unit
from mien.lab.synthetic.posing import project
from mien.lab.synthetic.recipe import SyntheticRecipe
from mien.lab.synthetic.subject import Material, PosedSubject, Subject, opaque_vertices
from mien.machine import exact
from mien.render.mesh import MeshFragments, interpolate, rasterize_mesh, sample_texture


def draw(
    subject: Subject, posed: PosedSubject, camera_in_head: Camera, supersample: int
) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]:
    """Return linear colour, premultiplied by coverage, and coverage; `camera_in_head` views the head frame."""
    width, height = camera_in_head.width * supersample, camera_in_head.height * supersample
    camera = camera_in_head.resized(width, height)
    vertices = opaque_vertices(subject, posed)
    fragments = rasterize_mesh(torch.from_numpy(vertices), torch.from_numpy(subject.faces), camera)
    canvas = _Canvas(subject, posed, camera, fragments, vertices)
    painters = {
        Material.SKIN: _paint_skin, Material.EYE: _paint_eyes, Material.TEETH: _paint_mouth,
        Material.MOUTH: _paint_mouth, Material.HAIR: _paint_hair, Material.SHIRT: _paint_shirt,
        Material.FRAME: _paint_frame,
    }  # fmt: skip
    for material, paint in painters.items():
        rows = np.flatnonzero(canvas.material == material)
        if len(rows):
            canvas.colors[rows] = paint(canvas, rows)
    image = np.zeros((height * width, 3), np.float32)
    image[canvas.pixels] = canvas.colors
    if subject.glasses is not None:
        _add_lenses(canvas, image)
    coverage = (fragments.face_index.numpy() >= 0).astype(np.float32)
    size = (camera_in_head.width, camera_in_head.height)
    image = cv2.resize(image.reshape(height, width, 3), size, interpolation=cv2.INTER_AREA)
    return image, cv2.resize(coverage, size, interpolation=cv2.INTER_AREA)


class _Canvas:
    """The samples of a picture that hit something."""

    def __init__(
        self, subject: Subject, posed: PosedSubject, camera: Camera, fragments: MeshFragments, vertices: np.ndarray
    ) -> None:
        self.subject, self.posed, self.camera, self.vertices = subject, posed, camera, vertices
        self.fragments = fragments
        face_index = fragments.face_index.numpy().reshape(-1)
        self.pixels = np.flatnonzero(face_index >= 0)
        self.face_index = face_index[self.pixels]
        self.material = subject.materials.astype(np.int8)[self.face_index]
        self.colors = np.zeros((len(self.pixels), 3), np.float32)
        self.light = shading.turn_light(subject.lighting, posed.R_world_head)

    def interpolate(self, rows: Int[np.ndarray, " n"], attributes: np.ndarray, faces: np.ndarray) -> np.ndarray:
        """Interpolate attributes of vertices at some samples."""
        tensor = torch.from_numpy(np.ascontiguousarray(attributes, np.float32))
        part = _selected(self.fragments, torch.from_numpy(self.pixels[rows]))
        return interpolate(part, tensor, torch.from_numpy(faces))[0].numpy()

    def views(self, pixels: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
        """Return unit directions from the surface towards the camera."""
        K, R = self.camera.K.numpy(), self.camera.viewmat[:3, :3].numpy()
        small = pixels.astype(np.int32)
        row = small // np.int32(self.camera.width)
        x = ((small - row * np.int32(self.camera.width)).astype(np.float32) + (0.5 - K[0, 2])) / -K[0, 0]
        y = (row.astype(np.float32) + (0.5 - K[1, 2])) / -K[1, 1]
        return unit(np.stack([x * R[0, i] + y * R[1, i] - R[2, i] for i in range(3)], -1))


def _selected(fragments: MeshFragments, pixels: Int[torch.Tensor, " n"]) -> MeshFragments:
    """Return some samples as a picture one pixel high."""
    return MeshFragments(
        fragments.face_index.reshape(-1).index_select(0, pixels)[None],
        fragments.barycentric.reshape(-1, 3).index_select(0, pixels)[None],
        fragments.depth.reshape(-1).index_select(0, pixels)[None],
    )


def _model_faces(canvas: _Canvas) -> np.ndarray:
    return canvas.subject.faces[: len(canvas.subject.model_faces)]


def _paint_skin(canvas: _Canvas, rows: np.ndarray) -> np.ndarray:
    subject, posed = canvas.subject, canvas.posed
    shadow = subject.visibility.shadow(subject.lighting, posed.R_world_head) ** np.array([0.8, 1.0, 1.05], np.float32)
    attributes = np.concatenate([posed.normals, shadow], -1)
    uv_faces = subject.model.uv_faces.numpy()[subject.model_faces]

    def paint(block: np.ndarray) -> np.ndarray:
        values = canvas.interpolate(block, attributes, _model_faces(canvas))
        uv = canvas.interpolate(block, subject.textures.uv, uv_faces)
        channels = sample_texture(torch.from_numpy(subject.textures.channels), torch.from_numpy(uv)[None])[0].numpy()
        views = canvas.views(canvas.pixels[block])
        return shading.shade_skin(channels, values[:, :3], values[:, 3:], views, canvas.light)

    return _in_blocks(rows, paint)


def _in_blocks(rows: np.ndarray, paint: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Paint in blocks so small that all intermediate arrays fit into a core's cache."""
    return np.concatenate([paint(rows[start : start + 32768]) for start in range(0, len(rows), 32768)])


def _paint_eyes(canvas: _Canvas, rows: np.ndarray) -> np.ndarray:
    subject, posed = canvas.subject, canvas.posed
    local = np.zeros_like(posed.head)
    for eye in subject.eyes:
        local[eye.vertices] = eye.local
    values = canvas.interpolate(rows, np.concatenate([local, posed.head], -1), _model_faces(canvas))
    colors = np.zeros((len(rows), 3), np.float32)
    for side, eye, center in zip(SIDES, subject.eyes, posed.eye_centers, strict=True):
        mine = np.flatnonzero((values[:, 3] > 0) == (side == "left"))
        if not len(mine):
            continue
        points = values[mine, 3:]
        lid = posed.landmarks[list(UPPER_LIDS[side])]
        lid = lid[np.argsort(lid[:, 0])]
        under = np.interp(points[:, 0], lid[:, 0], lid[:, 1]).astype(np.float32) - points[:, 1]
        axis = unit(posed.head[eye.front].mean(0) - center) if len(eye.front) else np.array([0, 0, 1], np.float32)
        colors[mine] = shading.shade_eye(
            unit(values[mine, :3]), unit(points - center), axis, under,
            canvas.views(canvas.pixels[rows[mine]]), canvas.light,
            (eye.iris_size, subject.iris_color, subject.wet_eyes),
        )  # fmt: skip
    return colors


def _paint_mouth(canvas: _Canvas, rows: np.ndarray) -> np.ndarray:
    subject, posed = canvas.subject, canvas.posed
    attributes = np.concatenate([posed.normals, posed.head, subject.anatomy.vertices], -1)
    values = canvas.interpolate(rows, attributes, _model_faces(canvas))
    normals, points, rest = unit(values[:, :3]), values[:, 3:6], values[:, 6:]
    lips = posed.landmarks[list(LIPS_OUTER)]
    depth = exact.Parabola(lips[:, 0], lips[:, 2])(points[:, 0]).astype(np.float32) - points[:, 2]
    views = canvas.views(canvas.pixels[rows])
    normals = np.where(exact.dot(normals, views)[:, None] < 0, -normals, normals)
    if canvas.material[rows[0]] == Material.TEETH:
        teeth = posed.head[np.unique(subject.anatomy.faces[subject.anatomy.region("teeth")]), 2]
        return shading.shade_teeth(rest, normals, teeth.max() - points[:, 2], views, canvas.light)
    return shading.shade_mouth(normals, depth, views, canvas.light)


def _paint_hair(canvas: _Canvas, rows: np.ndarray) -> np.ndarray:
    """Shade hair at the strands' points. Both edges of a ribbon have the colour of its point."""
    subject, posed = canvas.subject, canvas.posed
    colors = np.zeros_like(canvas.vertices)
    start = len(posed.head)
    for strands in posed.strands:
        shaded = shading.shade_hair(strands, canvas.light, posed.viewpoint).reshape(-1, 3)
        colors[start : start + 2 * len(shaded)] = np.repeat(shaded, 2, axis=0)
        start += 2 * len(shaded)
    return canvas.interpolate(rows, colors, subject.faces)


def _paint_shirt(canvas: _Canvas, rows: np.ndarray) -> np.ndarray:
    subject = canvas.subject
    assert subject.shirt is not None
    R = canvas.posed.T_head_shoulders[:3, :3]
    attributes = np.zeros((len(canvas.vertices), 6), np.float32)
    attributes[-len(subject.shirt.vertices) :, :3] = exact.rotated(subject.shirt.normals, R)
    attributes[-len(subject.shirt.vertices) :, 3:] = subject.shirt.vertices
    values = canvas.interpolate(rows, attributes, subject.faces)
    noise = SolidNoise(5)

    def paint(block: np.ndarray) -> np.ndarray:
        part = values[block]
        under_chin = np.clip(0.55 + 6 * np.abs(part[:, 3]), 0, 1)
        weave = (1 + 0.16 * noise(part[:, 3:], 0.0016)) * under_chin
        return subject.shirt_color * weave[:, None] * canvas.light.irradiance(unit(part[:, :3]))

    return _in_blocks(np.arange(len(rows)), paint)


def _paint_frame(canvas: _Canvas, rows: np.ndarray) -> np.ndarray:
    subject = canvas.subject
    assert subject.glasses is not None
    frame = subject.glasses.frame
    normals = np.zeros_like(canvas.vertices)
    end = len(normals) - (len(subject.shirt.vertices) if subject.shirt else 0)
    normals[end - len(frame.vertices) : end] = frame.normals
    normals = unit(canvas.interpolate(rows, normals, subject.faces))
    return shading.shade_frame(normals, canvas.views(canvas.pixels[rows]), canvas.light)


def _add_lenses(canvas: _Canvas, image: Float[np.ndarray, "p 3"]) -> None:
    """Draw lenses over what is behind them, only for samples that already hit the person."""
    glasses = canvas.subject.glasses
    assert glasses is not None
    lenses, camera = glasses.lenses, canvas.camera
    projected = project(camera, lenses.vertices)[0]
    size = (camera.width, camera.height)
    left, top = (int(v) for v in np.clip(np.floor(projected.min(0)), 0, size))
    right, bottom = (int(v) for v in np.clip(np.ceil(projected.max(0)), 0, size))
    if left >= right or top >= bottom:
        return
    faces = torch.from_numpy(lenses.faces)
    window = camera.cropped(float(left), float(top), right - left, bottom - top)
    fragments = rasterize_mesh(torch.from_numpy(lenses.vertices), faces, window)
    behind, seen = (t[top:bottom, left:right] for t in (canvas.fragments.depth, canvas.fragments.face_index))
    index = ((fragments.depth < behind) & (seen >= 0)).flatten().nonzero()[:, 0]
    if not len(index):
        return
    normals = unit(interpolate(_selected(fragments, index), torch.from_numpy(lenses.normals), faces)[0].numpy())
    row, column = np.divmod(index.numpy(), right - left)
    pixels = (row + top) * camera.width + column + left
    image[pixels] = 0.93 * image[pixels] + shading.shade_lens(normals, canvas.views(pixels), canvas.light)


def develop(
    linear: Float[np.ndarray, "h w 3"], coverage: Float[np.ndarray, "h w"], background: Float[np.ndarray, "h w 3"]
) -> Float[np.ndarray, "h w 3"]:
    """Composite over a linear background, compress highlights softly and encode as sRGB 0..1."""
    full = linear + (1 - coverage)[..., None] * background
    # Linear up to 0.6, then compressed so that 1.6 is still below white.
    bright = np.maximum(full - 0.6, 0)
    full = np.minimum(full, 0.6) + 0.4 * (1 - np.exp(-bright / 0.4))
    return _SRGB_TABLE[np.clip(full * (_TABLE_SIZE - 1), 0, _TABLE_SIZE - 1).astype(np.int32)]


_TABLE_SIZE = 1 << 16
_LINEAR = (np.arange(_TABLE_SIZE) + 0.5) / _TABLE_SIZE
_SRGB_TABLE = np.where(_LINEAR <= 0.0031308, 12.92 * _LINEAR, 1.055 * _LINEAR ** (1 / 2.4) - 0.055).astype(np.float32)


def paint_wall(recipe: SyntheticRecipe, seed: int) -> Float[np.ndarray, "h w 3"]:
    """Return a plain wall in linear colour, brighter on one side."""
    random = np.random.default_rng([seed, 7])
    y, x = np.mgrid[0 : recipe.height, 0 : recipe.width].astype(np.float32)
    x, y = x / recipe.width - 0.5, y / recipe.height - 0.5
    base = np.array([0.29, 0.34, 0.40], np.float32) * np.exp(random.normal(0, 0.12, 3)).astype(np.float32)
    side = random.choice([-1.0, 1.0])
    level = 1 + 0.35 * side * x - 0.25 * y - 0.5 * (x * x + y * y)
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size, np.float32)], -1)
    plaster = SolidNoise(seed + 9).octaves(points, 0.03, 3).reshape(x.shape)
    return (base * (level * (1 + 0.012 * plaster))[..., None]).astype(np.float32)


def to_uint8(
    image: Float[np.ndarray, "h w 3"], noise: float, random: np.random.Generator
) -> UInt8[np.ndarray, "h w 3"]:
    """Add the camera's noise and round to 8 bit."""
    if noise > 0:
        image = image + noise * random.standard_normal(image.shape, dtype=np.float32)
    return np.clip(np.rint(image * 255), 0, 255).astype(np.uint8)
