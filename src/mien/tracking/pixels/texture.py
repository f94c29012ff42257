"""The subject's skin as a texture and the light of each sequence, from pictures with roughly tracked faces."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mien import _native
from mien.camera import Camera
from mien.face.model import FaceModel
from mien.machine.parallel import map_in_threads
from mien.render.mesh import MeshFragments, rasterize_mesh
from mien.tracking.fitting.fit import HIDING_REGIONS, Fit, fit_of
from mien.tracking.pixels.pictures import Picture
from mien.tracking.pixels.surface import PosedSurface

LIGHT_EXTENT = 0.012
"""Extent on the face, in metres, over which a smooth difference counts as light that the model does not explain."""
LEAST_COSINE = 0.25
"""Least cosine between the surface's normal and the direction to the camera at which the surface's colour is used."""
_FIRST_SIGMA = 0.1  # expected colour difference (0..1) before anything is known
_SIGMA_BOUNDS = (0.01, 0.1)  # bounds of the expected colour difference afterwards
_LIGHT_STIFFNESS = 0.02
"""Weight of the prior that pulls the light towards an even one, relative to the evidence of the pictures."""


@dataclass(frozen=True, eq=False)
class SkinTexture:
    """An albedo texture and the trust in each texel."""

    albedo: Float[Tensor, "th tw 3"]
    trust: Float[Tensor, "th tw"]
    """Trust in each texel, 0..1: 0 if unknown, below 1 if the pictures contradict each other."""
    sigma: float
    """Expected colour difference between picture and prediction."""


@dataclass(frozen=True, eq=False)
class SurfaceView:
    """A posed surface in a picture under a light."""

    posed: PosedSurface
    picture: Picture
    light: Float[Tensor, "9 3"]
    share: float = 1.0
    """Weight of the picture in the texture."""

    def arrays(self) -> "_native.SightingArrays":
        """The view in the form in which the native core takes it."""
        camera, picture = self.picture.camera, self.picture
        return _native.SightingArrays(
            self.posed.vertices, self.posed.normals, camera.K, camera.viewmat, picture.image, picture.mask, self.light
        )


@dataclass(frozen=True, eq=False)
class TextureSpace:
    """The point of the surface that each texel shows."""

    faces: Int[Tensor, "f 3"]
    corners: Float[Tensor, "f 3 2"]
    """Texture coordinates of every triangle's corners."""
    used: Bool[Tensor, " f"]
    fragments: MeshFragments

    def native(self, texture: SkinTexture, outlier: float) -> "_native.AlignSurface":
        """The surface with a texture, for the native core."""
        return _native.AlignSurface(
            self.faces, self.corners, self.used.to(torch.uint8), texture.albedo, texture.trust,
            texture.sigma, outlier, LEAST_COSINE,
        )  # fmt: skip


def texture_space(face_model: FaceModel, size: int) -> TextureSpace:
    """Rasterise the face model's texture coordinates into a texture with `size` texels along each side."""
    corners = face_model.uv[face_model.uv_faces].contiguous()
    flat = torch.stack([corners[..., 0] * size, (1 - corners[..., 1]) * size, torch.ones(corners.shape[:2])], dim=-1)
    camera = Camera(torch.eye(3), torch.eye(4), size, size)
    apart = torch.arange(3 * len(corners)).reshape(-1, 3)
    fragments = rasterize_mesh(flat.reshape(-1, 3), apart, camera)
    used = ~face_model.region_mask(*HIDING_REGIONS)
    return TextureSpace(face_model.faces.contiguous(), corners, used, fragments)


def even_light() -> Float[Tensor, "9 3"]:
    """The light that leaves an albedo unchanged."""
    light = torch.zeros(9, 3)
    light[0] = math.sqrt(4 * math.pi)
    return light


def unknown_texture(size: int) -> SkinTexture:
    """The texture before any picture: none of the size x size texels is known."""
    return SkinTexture(torch.zeros(size, size, 3), torch.zeros(size, size), _FIRST_SIGMA)


def estimate_appearance(
    space: TextureSpace, views: Sequence[Sequence[SurfaceView]], start: SkinTexture, outlier: float, light_radius: int
) -> tuple[SkinTexture, list[Float[Tensor, "9 3"]]]:
    """Estimate the albedo in turn with the light of every sequence.

    The albedo is a least squares fit for each texel, which is robust from the second round on. The views of each
    sequence have its light known so far, and `start` has the texture; its sigma scales the robust weights, which fade
    beyond `outlier` sigmas. What is smooth over `light_radius` pixels counts as light and is left out of the texture.
    """
    texture, known = start, bool((start.trust > 0).any())
    for turn in range(3):  # number of rounds of albedo and light in turn
        texture = _bake(space, views, texture, outlier)
        if not texture.trust.any():
            return texture, [own[0].light for own in views]
        if turn == 0 and not known:
            # The median colour in all known texels: at the start, all variation counts as light.
            median, seen = texture.albedo[texture.trust > 0].median(0).values, texture.trust > 0
            texture = replace(texture, albedo=seen[..., None] * median, sigma=_FIRST_SIGMA)
        views = [_relit(space.native(texture, outlier), own) for own in views]
    surface = space.native(texture, outlier)
    smoothed = partial(_without_smooth_residual, surface, radius=light_radius)
    even = [map_in_threads(smoothed, own) for own in views]
    return _bake(space, even, texture, outlier), [own[0].light for own in views]


def _without_smooth_residual(surface: "_native.AlignSurface", view: SurfaceView, radius: int) -> SurfaceView:
    """The view without the part of its difference from the prediction that is smooth over `radius` pixels."""
    smooth = torch.empty_like(view.picture.image)
    _native.align_mesh(surface, view.arrays(), radius, None, None, smooth)
    return replace(view, picture=replace(view.picture, image=view.picture.image - smooth))


def _bake(
    space: TextureSpace, views: Sequence[Sequence[SurfaceView]], texture: SkinTexture, outlier: float
) -> SkinTexture:
    """The albedo that explains all views under their lights."""
    size, surface = space.fragments.face_index.shape, space.native(texture, outlier)
    weight = torch.zeros(size)
    squares, mixed, image = (torch.zeros(*size, 3) for _ in range(3))
    sums = _native.TextureSums(weight, squares, mixed, image)
    for view in (view for own in views for view in own):
        picture = replace(view.picture, mask=view.picture.mask * view.share)
        seen = replace(view, picture=picture).arrays()
        _native.bake_texture(surface, seen, space.fragments.face_index, space.fragments.barycentric, sums)
    known = weight > 0.05  # least total weight of a texel's views (each the squared cosine) for the texel to be known
    albedo = mixed / squares.clamp_min(1e-6) * known[..., None]
    variance = ((image - albedo * mixed).sum(-1) / weight.clamp_min(1e-6)).clamp_min(0)
    sigma = float(variance[known].median().sqrt().clamp(*_SIGMA_BOUNDS)) if known.any() else texture.sigma
    trust = known * (sigma**2 / (0.5 * sigma**2 + variance)).clamp_max(1.0)
    return SkinTexture(albedo, trust, sigma)


def _relit(surface: "_native.AlignSurface", views: Sequence[SurfaceView]) -> list[SurfaceView]:
    """The views of a sequence with the light that explains them."""

    def equations(view: SurfaceView) -> tuple[Tensor, Tensor]:
        own = torch.zeros(3, 9, 9).double(), torch.zeros(3, 9).double()
        _native.light_equations(surface, view.arrays(), *own)
        return own

    hessian, right = (torch.stack(parts).sum(0) for parts in zip(*map_in_threads(equations, views), strict=True))
    hessian = hessian + hessian.triu(1).mT
    most = hessian.diagonal(dim1=1, dim2=2).amax(1)
    stiffness = _LIGHT_STIFFNESS * most[:, None].expand(3, 9).clone() + 1e-9
    hessian = hessian + torch.diag_embed(stiffness)
    right = right + stiffness * even_light().T.double()
    light = torch.linalg.solve(hessian, right).T.float().contiguous()
    return [replace(view, light=light) for view in views]


@dataclass(frozen=True, eq=False)
class PhotometricFit:
    """A fit to pixels with the texture and light that it found."""

    fit: Fit
    texture: SkinTexture
    lights: tuple[Float[Tensor, "9 3"], ...]
    """Light of each sequence."""
    improved: tuple[Bool[Tensor, " _"], ...]
    """Timesteps of each sequence that the fit to pixels improved. The others keep their fit to landmarks."""
    residuals: tuple[Float[Tensor, "_ _"], ...] = ()
    """`PhotometricTerm.residuals` of each sequence; NaN where not improved."""

    def tensors(self) -> dict[str, Tensor]:
        """Everything but the residuals as tensors by name, for a file."""
        tensors = self.fit.tensors() | {"albedo": self.texture.albedo, "trust": self.texture.trust}
        tensors["sigma"] = torch.tensor([self.texture.sigma], dtype=torch.float64)
        for index, (light, improved) in enumerate(zip(self.lights, self.improved, strict=True)):
            tensors |= {f"light_{index}": light, f"improved_{index}": improved.to(torch.uint8)}
        return tensors


def photometric_start(fit: Fit, texture: SkinTexture, lights: Sequence[Float[Tensor, "9 3"]]) -> PhotometricFit:
    """A fit to landmarks with the texture and lights from which it will be fitted to pixels."""
    improved = tuple(torch.zeros(len(sequence.state), dtype=torch.bool) for sequence in fit.sequences)
    return PhotometricFit(fit, texture, tuple(lights), improved)


def photometric_fit_of(tensors: Mapping[str, Tensor]) -> PhotometricFit:
    """The fit made of tensors by name (`PhotometricFit.tensors`)."""
    fit = fit_of(tensors)
    count = range(len(fit.sequences))
    return PhotometricFit(
        fit, SkinTexture(tensors["albedo"], tensors["trust"], float(tensors["sigma"])),
        tuple(tensors[f"light_{index}"] for index in count),
        tuple(tensors[f"improved_{index}"].bool() for index in count),
    )  # fmt: skip
