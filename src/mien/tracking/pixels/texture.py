"""The subject's skin as a texture and the light of each sequence, from pictures with roughly tracked faces.

`PhotometricFit` is a fit with both.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mien import _native
from mien.camera import Camera
from mien.face.model import FaceModel
from mien.render.mesh import MeshFragments, rasterize_mesh
from mien.tracking.eyelids.crops import LEAST_COSINE
from mien.tracking.fitting.fit import HIDING_REGIONS, Fit, fit_of
from mien.tracking.pixels.pictures import Picture
from mien.tracking.pixels.surface import PosedSurface

_LEAST_WEIGHT = 0.05  # least total weight of a texel's sightings (each the squared cosine) for the texel to be known
_FIRST_SIGMA = 0.1  # expected colour difference (0..1) before anything is known
_SIGMA_BOUNDS = (0.01, 0.1)  # bounds of the expected colour difference afterwards
_LIGHT_ROUNDS = 3  # number of rounds of albedo and light in turn
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
class Sighting:
    """A posed surface in a picture under a light."""

    posed: PosedSurface
    picture: Picture
    light: Float[Tensor, "9 3"]
    share: float = 1.0
    """Weight of the picture in the texture."""

    def weighted(self) -> "Sighting":
        """The sighting with its share multiplied into the mask."""
        return replace(self, picture=replace(self.picture, mask=self.picture.mask * self.share))

    def arrays(self) -> "_native.SightingArrays":
        """The sighting in the form in which the native core takes it."""
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


def unknown_texture(space: TextureSpace) -> SkinTexture:
    """The appearance before any picture: no texel is known."""
    size = space.fragments.face_index.shape
    return SkinTexture(torch.zeros(*size, 3), torch.zeros(size), _FIRST_SIGMA)


def estimate_appearance(
    space: TextureSpace, sightings: Sequence[Sequence[Sighting]], start: SkinTexture, outlier: float, light_radius: int
) -> tuple[SkinTexture, list[Float[Tensor, "9 3"]]]:
    """Estimate the albedo in turn with the light of every sequence.

    The albedo is a least squares fit for each texel, which is robust from the second round on.

    Args:
        space: The texels.
        sightings: Sightings of each sequence, with the light known so far.
        start: The appearance known so far. Its sigma scales the robust weights.
        outlier: Outlier threshold in sigmas.
        light_radius: Radius in pixels over which a smooth difference counts as light and is left out of the texture.
    """
    texture, known = start, bool((start.trust > 0).any())
    lights = [own[0].light for own in sightings]
    for turn in range(_LIGHT_ROUNDS):
        texture = _bake(space, sightings, lights, texture, outlier)
        if not texture.trust.any():
            return texture, lights
        if turn == 0 and not known:
            texture = _one_color(texture)
        lights = [_fit_light(space, own, light, texture, outlier) for own, light in zip(sightings, lights, strict=True)]
    even = [
        [_without_smooth_residual(space, replace(one, light=light), texture, outlier, light_radius) for one in own]
        for own, light in zip(sightings, lights, strict=True)
    ]
    return _bake(space, even, lights, texture, outlier), lights


def _without_smooth_residual(
    space: TextureSpace, sighting: Sighting, texture: SkinTexture, outlier: float, radius: int
) -> Sighting:
    """The sighting without the part of its difference from the prediction that is smooth over `radius` pixels."""
    smooth = torch.empty_like(sighting.picture.image)
    surface = space.native(texture, outlier)
    _native.align_mesh(surface, sighting.arrays(), radius, None, None, smooth)
    return replace(sighting, picture=replace(sighting.picture, image=sighting.picture.image - smooth))


def _bake(
    space: TextureSpace,
    sightings: Sequence[Sequence[Sighting]],
    lights: Sequence[Float[Tensor, "9 3"]],
    texture: SkinTexture,
    outlier: float,
) -> SkinTexture:
    size = space.fragments.face_index.shape
    surface = space.native(texture, outlier)
    weight = torch.zeros(size)
    squares, mixed, image = (torch.zeros(*size, 3) for _ in range(3))
    sums = _native.TextureSums(weight, squares, mixed, image)
    for own, light in zip(sightings, lights, strict=True):
        for sighting in own:
            seen = replace(sighting, light=light).weighted().arrays()
            _native.bake_texture(surface, seen, space.fragments.face_index, space.fragments.barycentric, sums)
    known = weight > _LEAST_WEIGHT
    albedo = mixed / squares.clamp_min(1e-6) * known[..., None]
    variance = ((image - albedo * mixed).sum(-1) / weight.clamp_min(1e-6)).clamp_min(0)
    bounds = _SIGMA_BOUNDS
    sigma = float(variance[known].median().sqrt().clamp(*bounds)) if known.any() else texture.sigma
    trust = known * (sigma**2 / (0.5 * sigma**2 + variance)).clamp_max(1.0)
    return SkinTexture(albedo, trust, sigma)


def _one_color(texture: SkinTexture) -> SkinTexture:
    """The texture with its median colour in all known texels. At the start, all variation counts as light."""
    median = texture.albedo[texture.trust > 0].median(0).values
    return replace(texture, albedo=(texture.trust > 0)[..., None] * median, sigma=_FIRST_SIGMA)


def _fit_light(
    space: TextureSpace,
    sightings: Sequence[Sighting],
    light: Float[Tensor, "9 3"],
    texture: SkinTexture,
    outlier: float,
) -> Float[Tensor, "9 3"]:
    hessian, right = torch.zeros(3, 9, 9).double(), torch.zeros(3, 9).double()
    surface = space.native(texture, outlier)
    for sighting in sightings:
        _native.light_equations(surface, replace(sighting, light=light).arrays(), hessian, right)
    hessian = hessian + hessian.triu(1).mT
    most = hessian.diagonal(dim1=1, dim2=2).amax(1)
    stiffness = _LIGHT_STIFFNESS * most[:, None].expand(3, 9).clone() + 1e-9
    hessian = hessian + torch.diag_embed(stiffness)
    right = right + stiffness * even_light().T.double()
    return torch.linalg.solve(hessian, right).T.float().contiguous()


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


def photometric_fit_of(tensors: Mapping[str, Tensor]) -> PhotometricFit:
    """The fit made of tensors by name (`PhotometricFit.tensors`)."""
    fit = fit_of(tensors)
    count = range(len(fit.sequences))
    return PhotometricFit(
        fit, SkinTexture(tensors["albedo"], tensors["trust"], float(tensors["sigma"])),
        tuple(tensors[f"light_{index}"] for index in count),
        tuple(tensors[f"improved_{index}"].bool() for index in count),
    )  # fmt: skip
