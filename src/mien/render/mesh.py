"""Triangle meshes: visible fragments, interpolation, textures, simple light, pictures.

`mien.render.mesh_gradients` has gradients. Everything runs on one CPU thread and releases the GIL, so several Python
threads can each draw a frame.
"""

from dataclasses import dataclass
from itertools import product

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from mien import _native
from mien.camera import Camera


@dataclass(frozen=True, eq=False)
class MeshFragments:
    """The point of a mesh that is visible at each pixel centre of a picture."""

    face_index: Int[Tensor, "h w"]
    """Index of the visible triangle, int32; -1 if there is none."""
    barycentric: Float[Tensor, "h w 3"]
    """Perspective-correct weights of the triangle's corners; 0 if there is none."""
    depth: Float[Tensor, "h w"]
    """Camera z in metres; infinite if there is no triangle."""


@dataclass(frozen=True, eq=False)
class Texture:
    """A picture wrapped around a mesh."""

    image: Float[Tensor, "th tw c"]
    uv: Float[Tensor, "v 2"] | Float[Tensor, "f 3 2"]
    """Texture coordinates per vertex, or per corner of every triangle (`uv[uv_faces]`); 0..1, v upwards."""


@dataclass(frozen=True)
class Headlight:
    """A distant white lamp that moves with the camera, and ambient light (Lambert's law)."""

    direction: tuple[float, float, float] = (-0.3, -0.5, -1.0)
    """Direction to the lamp in camera axes. The default is up, left and behind the camera."""
    ambient: float = 0.3
    """Light that reaches every surface. The lamp adds the rest up to 1."""


GRAY = (0.75, 0.75, 0.75)
"""Default colour of a surface."""


def rasterize_mesh(
    vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"], camera: Camera, cull_backfaces: bool = False
) -> MeshFragments:
    """Find the triangle that is visible at each pixel centre, with a z-buffer.

    Triangles are cut at the near plane (0.01 m). Two that share an edge leave no gap and never hit a pixel twice. A
    triangle with a vertex that is not finite is not drawn. With `cull_backfaces`, triangles with clockwise vertices on
    screen are not drawn either. The result is not differentiable.
    """
    shape = (camera.height, camera.width)
    fragments = MeshFragments(
        torch.empty(shape, dtype=torch.int32), torch.empty(*shape, 3), torch.empty(shape, dtype=torch.float32)
    )
    _native.rasterize_mesh(
        _plain(vertices),
        faces.contiguous(),
        _plain(camera.K),
        _plain(camera.viewmat),
        cull_backfaces,
        _native.Fragments(fragments.face_index, fragments.barycentric, fragments.depth),
    )
    return fragments


def interpolate(
    fragments: MeshFragments, attributes: Float[Tensor, "v c"] | Float[Tensor, "f 3 c"], faces: Int[Tensor, "f 3"]
) -> Float[Tensor, "h w c"]:
    """Interpolate attributes of vertices, or of every triangle's corners, at each pixel; 0 if there is no triangle.

    The result is not differentiable. `mesh_loss` has the gradients of a whole picture.
    """
    corners = faces
    if attributes.ndim == 3:
        corners = torch.arange(3 * len(faces)).view(-1, 3)
        attributes = attributes.flatten(0, 1)
    if attributes.dtype != torch.float32:
        return interpolate_reference(fragments, attributes, corners)
    out = torch.empty(*fragments.face_index.shape, attributes.shape[1])
    given = (attributes.detach().contiguous(), corners.contiguous(), out)
    _native.interpolate_mesh(fragments.face_index, fragments.barycentric, *given)
    return out


def interpolate_reference(
    fragments: MeshFragments, attributes: Float[Tensor, "a c"], corners: Int[Tensor, "f 3"]
) -> Float[Tensor, "h w c"]:
    """`interpolate` in plain PyTorch, for any dtype. `corners` has the three rows of `attributes` of each triangle."""
    covered = fragments.face_index >= 0
    values = attributes[corners[fragments.face_index[covered].long()]]
    weights = fragments.barycentric[covered].to(attributes)
    out = attributes.new_zeros(*covered.shape, attributes.shape[-1])
    return out.masked_scatter(covered[..., None], (weights[..., None] * values).sum(-2))


def sample_texture(texture: Float[Tensor, "th tw c"], uv: Float[Tensor, "*n 2"]) -> Float[Tensor, "*n c"]:
    """Sample a float32 texture bilinearly, clamped at the borders.

    The point (0, 0) is the lower left corner of the texture's picture, and v goes up. The result is not differentiable.
    """
    flat = uv.detach().reshape(-1, 2).contiguous()
    out = torch.empty(len(flat), texture.shape[2])
    _native.sample_texture(texture.detach().contiguous(), flat, out)
    return out.view(*uv.shape[:-1], -1)


def sample_picture(picture: Float[Tensor, "h w c"], grid: Float[Tensor, "v 2"], mode: str) -> Float[Tensor, "v c"]:
    """Values of a picture at points in -1..1."""
    safe = grid.nan_to_num(2.0).clamp(-2, 2)[None, None]
    values = grid_sample(picture.permute(2, 0, 1)[None], safe, mode=mode, padding_mode="border", align_corners=False)
    return values[0, :, 0].T


def vertex_normals(vertices: Float[Tensor, "*b v 3"], faces: Int[Tensor, "f 3"]) -> Float[Tensor, "*b v 3"]:
    """Unit normals of the vertices: means of the triangles' normals weighted by area. They are differentiable.

    Normals of counter-clockwise triangles point outwards. A vertex without a triangle with an area has a zero normal.
    """
    a, b, c = (vertices[..., faces[:, i], :] for i in range(3))
    area_normals = torch.linalg.cross(b - a, c - a)
    summed = torch.zeros_like(vertices)
    for corner in range(3):
        summed = summed.index_add(-2, faces[:, corner], area_normals)
    return normalize(summed, dim=-1, eps=1e-20)


def sh_basis(directions: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 9"]:
    """The real spherical harmonics of degrees 0 to 2 at unit directions, orthonormal over the sphere.

    The order is 1, y, z, x, xy, yz, 3z^2 - 1, xz, x^2 - y^2, all with positive factors.
    """
    x, y, z = directions.unbind(-1)
    return torch.stack(
        [
            torch.full_like(x, 0.28209479177387814),
            0.4886025119029199 * y,
            0.4886025119029199 * z,
            0.4886025119029199 * x,
            1.0925484305920792 * x * y,
            1.0925484305920792 * y * z,
            0.31539156525252005 * (3 * z * z - 1),
            1.0925484305920792 * x * z,
            0.5462742152960396 * (x * x - y * y),
        ],
        dim=-1,
    )


def shade(normals: Float[Tensor, "*b 3"], sh_light: Float[Tensor, "9 c"]) -> Float[Tensor, "*b c"]:
    """Light that reaches surfaces with these unit normals. Colour is albedo times this light.

    It is linear, differentiable and not clamped. A first coefficient of sqrt(4 pi) alone gives 1 everywhere.
    """
    return sh_basis(normals) @ sh_light


def render_mesh(
    vertices: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
    camera: Camera,
    colors: Float[Tensor, "v 3"] | Float[Tensor, "f 3 3"] | Texture | None = None,
    *,
    light: Headlight | Float[Tensor, "9 3"] | None = None,
    normals: Float[Tensor, "v 3"] | None = None,
    background: tuple[float, float, float] | Float[Tensor, "h w 3"] = (1.0, 1.0, 1.0),
    supersample: int = 1,
) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w"]]:
    """Draw a picture of a mesh and its coverage (alpha, 0..1).

    Args:
        vertices: Vertices in world space, in metres.
        faces: Triangles, counter-clockwise seen from outside. Both sides are drawn.
        camera: The camera.
        colors: Albedo of vertices or of triangles' corners, or a texture. None is grey.
        light: A lamp at the camera, or spherical harmonics coefficients over world-space normals (`shade`). None leaves
            `colors` unlit, and lights a mesh without colours by the default lamp.
        normals: Unit vertex normals, instead of `vertex_normals`.
        background: One colour, or a picture of the camera's size.
        supersample: Number of samples along each side of a pixel. The pixel is their mean.
    """
    fine = camera.resized(camera.width * supersample, camera.height * supersample)
    fragments = rasterize_mesh(vertices, faces, fine)
    if colors is None and light is None:
        light = Headlight()
    pixels = (fragments.face_index >= 0).flatten().nonzero()[:, 0]
    covered = _at_pixels(fragments, pixels)
    surface = _albedo(covered, faces, colors)
    if light is not None:
        surface = surface * _light(covered, vertices, faces, camera, light, normals)
    image = surface.new_zeros(fine.height * fine.width, 3).index_copy_(0, pixels, surface[0])
    image = _shrink(image.view(fine.height, fine.width, 3), supersample)
    alpha = _shrink((fragments.face_index >= 0)[..., None].to(image), supersample)
    behind = background if isinstance(background, Tensor) else image.new_tensor(background)
    return torch.addcmul(image, 1 - alpha, behind), alpha[..., 0]


def _at_pixels(fragments: MeshFragments, pixels: Int[Tensor, " p"]) -> MeshFragments:
    """Some fragments as a picture one pixel high, which saves time because a head leaves most of a picture empty."""
    return MeshFragments(
        fragments.face_index.flatten().index_select(0, pixels)[None],
        fragments.barycentric.flatten(0, 1).index_select(0, pixels)[None],
        fragments.depth.flatten().index_select(0, pixels)[None],
    )


def _albedo(
    fragments: MeshFragments, faces: Int[Tensor, "f 3"], colors: Tensor | Texture | None
) -> Float[Tensor, "h w 3"]:
    if colors is None:
        return torch.tensor(GRAY).expand(*fragments.depth.shape, 3)
    if isinstance(colors, Texture):
        return sample_texture(colors.image, interpolate(fragments, colors.uv, faces))
    return interpolate(fragments, colors, faces)


def _light(
    fragments: MeshFragments,
    vertices: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
    camera: Camera,
    light: Headlight | Tensor,
    normals: Tensor | None,
) -> Float[Tensor, "h w c"]:
    vertex_directions = vertex_normals(vertices, faces) if normals is None else normals
    directions = normalize(interpolate(fragments, vertex_directions, faces), dim=-1)
    if isinstance(light, Tensor):
        return shade(directions, light)
    towards_lamp = normalize(camera.viewmat[:3, :3].T @ camera.viewmat.new_tensor(light.direction), dim=0)
    lambert = (directions @ towards_lamp.to(directions)).clamp_min(0)
    return (light.ambient + (1 - light.ambient) * lambert)[..., None]


def _shrink(image: Float[Tensor, "h w c"], factor: int) -> Tensor:
    if factor == 1:
        return image
    height, width = image.shape[0] // factor, image.shape[1] // factor
    blocks = image[: height * factor, : width * factor].reshape(height, factor, width, factor, -1)
    # The sum of `avg_pool2d`, in its order, in a third of its time.
    total = blocks[:, 0, :, 0].clone()
    for row, column in list(product(range(factor), repeat=2))[1:]:
        total += blocks[:, row, :, column]
    # Channels come first in memory: sums over pictures add in this order.
    return (total / factor**2).permute(2, 0, 1).contiguous().permute(1, 2, 0)


def _plain(tensor: Tensor) -> Tensor:
    """The tensor for the native core. It is detached here, because the binding would detach it silently."""
    return tensor.detach().to(torch.float32).contiguous()
