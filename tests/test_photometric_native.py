"""The native alignment of a textured mesh with a picture agrees with PyTorch; so do texture and light from pictures."""

import math

import pytest
import torch
from torch import Tensor

from mien import _native
from mien.camera import Camera
from mien.render.mesh import Texture as MeshTexture
from mien.render.mesh import interpolate, rasterize_mesh, render_mesh, sample_texture, shade, vertex_normals
from mien.rotation import matrix_from_axis_angle
from mien.tracking.pixels import SkinTexture, even_light, texture_space
from mien.tracking.pixels.pictures import Picture
from mien.tracking.pixels.surface import PosedSurface
from mien.tracking.pixels.texture import Sighting, TextureSpace, estimate_appearance, unknown_texture
from photometric_case import make_textured_model, smooth_noise

SIZE, SIGMA, OUTLIER, LEAST_COSINE = 72, 0.07, 2.0, 0.25
MODEL = make_textured_model()
SPACE = texture_space(MODEL, 128)
CAMERA = Camera(
    torch.tensor([[110.0, 0, 36.5], [0, 108.0, 35.5], [0, 0, 1]]),
    torch.diag(torch.tensor([1.0, -1, -1, 1])),
    SIZE,
    SIZE,
)


def posed(
    parameters: int = 0, shift: tuple[float, float, float] = (0.004, 0.003, -0.6), yaw: float = 0.0
) -> PosedSurface:
    turn = matrix_from_axis_angle(torch.tensor([0.0, yaw, 0.0]))
    vertices = (MODEL.template @ turn.T + torch.tensor(shift)).contiguous()
    jacobian = None
    if parameters:
        generator = torch.Generator().manual_seed(2)
        jacobian = torch.randn(len(vertices), 3, parameters, generator=generator)
    return PosedSurface(vertices, vertex_normals(vertices, MODEL.faces), jacobian)


def some_light() -> Tensor:
    light = even_light()
    light[1:4] = torch.tensor([[0.5, 0.4, 0.3], [0.6, 0.6, 0.7], [-0.4, -0.3, 0.2]])
    return light


def some_texture(seed: int = 3) -> SkinTexture:
    known = (SPACE.fragments.face_index >= 0).float()
    return SkinTexture(smooth_noise(128, 128, 3.0, seed), known, SIGMA)


def sighting(seed: int = 5, parameters: int = 0) -> Sighting:
    generator = torch.Generator().manual_seed(4)
    mask = torch.rand(SIZE, SIZE, generator=generator).clamp_min(0.2)
    mask[:, :20] = 0
    return Sighting(posed(parameters), Picture(CAMERA, smooth_noise(SIZE, SIZE, 2.0, seed), mask), some_light())


def reference(seen: Sighting, skin: SkinTexture) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return cost, half gradient, half Hessian and residuals by PyTorch in float64, without a high-pass filter."""
    vertices, normals = seen.posed.vertices, seen.posed.normals
    fragments = rasterize_mesh(vertices, MODEL.faces, CAMERA)
    points = interpolate(fragments, vertices, MODEL.faces)
    directions = torch.nn.functional.normalize(interpolate(fragments, normals, MODEL.faces), dim=-1)
    towards = torch.nn.functional.normalize(CAMERA.position - points, dim=-1)
    uv = interpolate(fragments, SPACE.corners, MODEL.faces)
    trust = sample_texture(skin.trust[..., None], uv)
    albedo = sample_texture(skin.albedo * skin.trust[..., None], uv) / trust.clamp_min(1e-9)
    prediction = albedo * shade(directions, seen.light)
    weight = seen.picture.mask * trust[..., 0]
    counts = (fragments.face_index >= 0) & ((directions * towards).sum(-1) >= LEAST_COSINE) & (weight > 0)
    counts &= torch.cat([SPACE.used, torch.tensor([False])])[fragments.face_index.long()]
    counts[[0, -1]], counts[:, [0, -1]] = False, False
    residual = (seen.picture.image - prediction).double()
    square = (residual**2).sum(-1) / SIGMA**2
    fade = OUTLIER**2 / (OUTLIER**2 + square)
    total = weight[counts].double().sum()
    cost = (weight * square * fade)[counts].sum() / total
    image = seen.picture.image.double()
    by_x, by_y = torch.zeros_like(image), torch.zeros_like(image)
    by_x[:, 1:-1], by_y[1:-1] = (image[:, 2:] - image[:, :-2]) / 2, (image[2:] - image[:-2]) / 2

    assert seen.posed.jacobian is not None
    apart = 1e-4 * seen.posed.jacobian.permute(2, 0, 1).double()
    exact, ahead = CAMERA.to(apart), vertices.double()
    columns = [(exact.project(ahead + d)[0] - exact.project(ahead - d)[0]).float() / 2e-4 for d in apart]
    moved = torch.stack([interpolate(fragments, column.contiguous(), MODEL.faces) for column in columns], -1).double()
    by_parameter = by_x[..., None] * moved[..., None, 0, :] + by_y[..., None] * moved[..., None, 1, :]
    scale = (weight * fade**2 / SIGMA**2)[counts] / total
    by_parameter, left = by_parameter[counts], residual[counts]
    hessian = torch.einsum("n,nci,ncj->ij", scale, by_parameter, by_parameter)
    gradient = torch.einsum("n,nci,nc->i", scale, by_parameter, left)
    return cost, gradient, hessian, torch.where(counts[..., None], residual, torch.nan)


def test_cost_gradient_and_hessian_are_those_of_the_pixels():
    skin, seen = some_texture(), sighting(parameters=5)
    gradient, hessian, residual = torch.empty(5), torch.empty(5, 5), torch.empty(SIZE, SIZE, 3)
    surface = _native.AlignSurface(
        SPACE.faces, SPACE.corners, SPACE.used.to(torch.uint8), skin.albedo, skin.trust, SIGMA, OUTLIER, LEAST_COSINE
    )
    assert seen.posed.jacobian is not None
    derivatives = _native.AlignDerivatives(seen.posed.jacobian, hessian, gradient)
    cost, weight = _native.align_mesh(surface, seen.arrays(), 0, derivatives, residual, None)
    expected_cost, expected_gradient, expected_hessian, expected_residual = reference(seen, skin)
    assert weight > 100
    torch.testing.assert_close(residual.double(), expected_residual, atol=2e-5, rtol=0, equal_nan=True)
    assert cost == pytest.approx(float(expected_cost), rel=1e-4)
    torch.testing.assert_close(
        gradient.double(), expected_gradient, rtol=1e-3, atol=1e-4 * float(expected_gradient.abs().max())
    )
    torch.testing.assert_close(
        hessian.double(), expected_hessian, rtol=1e-3, atol=1e-4 * float(expected_hessian.abs().max())
    )


def test_one_step_undoes_a_small_shift():
    skin = some_texture()
    true = posed(shift=(0.004, 0.003, -0.6))
    texture = MeshTexture(skin.albedo, SPACE.corners)
    image, alpha = render_mesh(true.vertices, MODEL.faces, CAMERA, texture, light=some_light(), supersample=3)
    start = posed(3, shift=(0.0045, 0.0024, -0.6))
    start = PosedSurface(start.vertices, start.normals, torch.eye(3).expand(len(start.vertices), 3, 3).contiguous())
    seen = Sighting(start, Picture(CAMERA, image.contiguous(), (alpha > 0.99).float()), some_light())
    gradient, hessian = torch.empty(3), torch.empty(3, 3)
    assert start.jacobian is not None
    derivatives = _native.AlignDerivatives(start.jacobian, hessian, gradient)
    _native.align_mesh(SPACE.native(skin, OUTLIER), seen.arrays(), 0, derivatives, None, None)
    step = -torch.linalg.solve(hessian[:2, :2], gradient[:2])
    assert (step - torch.tensor([-0.0005, 0.0006])).abs().max() < 0.0001


def test_high_pass_leaves_out_a_smooth_light_but_not_texture():
    skin, radius = some_texture(), 6
    still = posed()
    texture = MeshTexture(skin.albedo, SPACE.corners)
    image, alpha = render_mesh(still.vertices, MODEL.faces, CAMERA, texture, supersample=3)
    ramp = torch.linspace(0.0, 0.3, SIZE)[None, :, None]
    surface = SPACE.native(skin, 5.0)
    mask = (alpha > 0.99).float()

    def costs(picture: Tensor) -> list[float]:
        seen = Sighting(still, Picture(CAMERA, picture.contiguous(), mask), even_light())
        radii = (0, radius)
        return [_native.align_mesh(surface, seen.arrays(), r, None, None, None)[0] for r in radii]

    plain, high_passed = costs(image + ramp)
    assert high_passed < 0.05 * plain
    rolled, rolled_high_passed = costs(image.roll(3, dims=1))
    assert rolled_high_passed > 0.3 * rolled


def _pictures_under_light(light: Tensor, skin: SkinTexture) -> list[Sighting]:
    texture = MeshTexture(skin.albedo, SPACE.corners)
    out = []
    for yaw in (0.0, 0.7, -0.7, 0.35, -0.35):
        surface = posed(shift=(0.0, 0.0, -0.5), yaw=yaw)
        image, alpha = render_mesh(surface.vertices, MODEL.faces, CAMERA, texture, light=light, supersample=3)
        out.append(Sighting(surface, Picture(CAMERA, image.contiguous(), (alpha > 0.99).float()), even_light()))
    return out


def test_albedo_times_light_gives_the_pictures_back():
    skin = some_texture()
    sightings = _pictures_under_light(some_light(), skin)
    found, (light,) = estimate_appearance(SPACE, [sightings], unknown_texture(SPACE), 3.0, 0)
    surface = SPACE.native(found, 5.0)
    for seen in sightings:
        residual = torch.empty(SIZE, SIZE, 3)
        seen = Sighting(seen.posed, seen.picture, light)
        _native.align_mesh(surface, seen.arrays(), 0, None, residual, None)
        known = residual[~residual.isnan().any(-1)]
        assert len(known) > 300
        assert known.abs().median() < 0.01


def test_light_is_found_where_the_albedo_is_known():
    skin = some_texture()
    hessian, right = torch.zeros(3, 9, 9, dtype=torch.float64), torch.zeros(3, 9, dtype=torch.float64)
    for seen in _pictures_under_light(some_light(), skin):
        _native.light_equations(SPACE.native(skin, 1e4), seen.arrays(), hessian, right)
    hessian = hessian + hessian.triu(1).mT
    found = torch.linalg.solve(hessian, right).T
    normals = torch.nn.functional.normalize(torch.randn(50, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    normals = normals[normals[:, 2] > 0.4]
    torch.testing.assert_close(shade(normals, found.float()), shade(normals, some_light()), atol=0.03, rtol=0)


def test_texels_that_no_picture_shows_are_not_trusted():
    skin = some_texture()
    found, _ = estimate_appearance(SPACE, [_pictures_under_light(even_light(), skin)], unknown_texture(SPACE), 3.0, 0)
    behind = SPACE.fragments.face_index[:, 64:] >= 0
    assert float(found.trust[:, 64:][behind].mean()) < 0.2
    middle = found.trust[48:80, 24:40]
    assert float(middle.min()) > 0.5
    assert (found.albedo - skin.albedo)[48:80, 24:40].abs().median() < 0.05


def test_bad_arrays_are_refused():
    skin = some_texture()
    too_few = torch.zeros(3, 3)
    surface = SPACE.native(skin, OUTLIER)
    seen = sighting().arrays()
    with pytest.raises(IndexError):
        _native.align_mesh(surface, seen._replace(vertices=too_few, normals=too_few), 0, None, None, None)
    with pytest.raises(ValueError, match="mask"):
        _native.align_mesh(surface, seen._replace(mask=torch.zeros(5, 5)), 0, None, None, None)
    with pytest.raises(TypeError, match="AlignDerivatives.hessian"):
        _native.align_mesh(surface, seen, 0, (posed(2).jacobian, None, torch.empty(2)), None, None)  # pyright: ignore[reportArgumentType]


def test_even_light_leaves_albedo_as_it_is():
    assert isinstance(SPACE, TextureSpace)
    normal = torch.nn.functional.normalize(torch.randn(7, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    torch.testing.assert_close(shade(normal, even_light()), torch.ones(7, 3))
    assert even_light()[0, 0] == pytest.approx(math.sqrt(4 * math.pi))
