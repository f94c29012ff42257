"""PointAvatar (Zheng et al., CVPR 2023): isotropic points on a surface, which deform with the face.

All points have one radius. Their number grows and the radius shrinks on a schedule; points that no picture showed are
pruned, and others are added beside survivors. Points deform by blend directions and skinning weights of a network, as
those of MonoGaussianAvatar, which was made from this method and whose network is used. A second network gives the
albedo and the signed distance to the surface; the distance's slope is the normal, from which a third network computes
light. A colour is albedo times light. Finished pictures are eroded and dilated, which closes holes between points.

Written from the paper's formulas and from what the supplements of its successors say. Differences: splats are
Gaussians whose standard deviation is half of the radius, so that they cover as much as the paper's discs, whose opacity
is 1 - (distance / radius)^2; deformed normals follow the skinning of their points alone; the weights of the losses of
the surface are a choice made here; the canonical face and the bone that stands still are those of the successor.
"""

import math
from collections.abc import Mapping

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mien.avatar.avatar import (
    UNBAKED_REMEDY,
    Extras,
    ParameterGroup,
    Posed,
    Pretraining,
    network_group,
    store_group,
)
from mien.avatar.baking import as_array
from mien.avatar.density import RefillDensity
from mien.avatar.mono_gaussian_avatar.motion import FreePoints
from mien.avatar.mono_gaussian_avatar.settings import LENGTH_UNIT
from mien.avatar.ops.activation import sigmoid
from mien.avatar.ops.skin_points import blend_transforms
from mien.avatar.point_avatar.networks import ShadingNet, SurfaceNet
from mien.avatar.point_avatar.settings import PointAvatarConfig
from mien.avatar.settings import TRAINED, Progress, RefillSettings
from mien.avatar.store import GaussianStore
from mien.errors import UserError
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.face.posing import head_poses
from mien.gaussians import Gaussians, Rendering, sh_from_rgb
from mien.runtime.baked import Attributes, BlendSkinned

_OPACITY = 0.99
"""Opacity of every point in its middle. The kernel lets none be 1."""
_UNBAKED = "the setting normals deformed of point_avatar: light on deformed normals is no function of the expression"


class PointAvatar(FreePoints):
    """Isotropic points with one radius. Networks predict colours, blend directions and skinning weights."""

    config: PointAvatarConfig

    def __init__(self, config: PointAvatarConfig, face_model: FaceModel, face: FaceParams):
        extras = Extras(
            frames_per_step=lambda _: config.frames_per_step,
            pretraining=Pretraining(config.pretraining, self.pretrain) if config.pretraining > 0 else None,
            unbaked=_UNBAKED if config.normals == "deformed" else None,
            closing=config.closing,
        )
        super().__init__(config, face_model, face, extras)
        like = face_model.template
        self.surface_net = SurfaceNet(config.surface_width, config.surface_layers, config.encoding_bands).to(like)
        self.deformation = self.new_deformation(face, "code")
        self.shading = ShadingNet(config.shading_width).to(like)
        self.store = GaussianStore({"means": self.first_means(face)})

    def pose(self, face: FaceParams, progress: Progress = TRAINED) -> Posed:
        """The points in the head frame, one batch entry per timestep, as Gaussians."""
        means, _ = self.deformed(self.store["means"], face)
        colors = self._colors(face)
        sh = sh_from_rgb(colors)[..., None, :]
        like, n = means.detach(), len(self.store)
        scales = like.new_full((n, 3), self.radius(progress.fraction) / 2)
        quats = like.new_zeros(n, 4)
        quats[:, 0] = 1
        opacities = like.new_full((n,), _OPACITY)
        return Posed(Gaussians(means, quats, scales, opacities, sh, head_poses(face)), {})

    def radius(self, fraction: float) -> float:
        """The radius of all points at a time, in metres. It shrinks whenever their number doubles."""
        doublings = math.log2(self.points_at(fraction) / 100)
        return self.config.first_radius * self.config.radius_factor**doublings

    def regularizers(self, posed: Posed, rendering: Rendering, progress: Progress) -> dict[str, Float[Tensor, ""]]:
        """Losses that keep the networks near the face model, and points on the surface. Points are detached.

        Each step uses the next `face_points` points.
        """
        config, means = self.config, self.chosen_means(progress)
        surface = self.surface_net(means / LENGTH_UNIT)
        return {
            **self.face_losses(means),
            "distance": config.distance_weight * surface.distance.square().mean(),
            "slope": config.slope_weight * (surface.slope.norm(dim=-1) - 1).square().mean(),
        }

    def parameter_groups(self) -> list[ParameterGroup]:
        """One group for the points, and one per network."""
        networks = {"surface": self.surface_net, "deformation": self.deformation, "shading": self.shading}
        groups = [network_group(name, network, self.config.network_rate) for name, network in networks.items()]
        return [store_group(self.store, "means", self.config.means_rate), *groups]

    def density(self) -> RefillDensity:
        """Deletes points that no picture of the last epoch showed, then refills up to the scheduled number."""
        epochs = self.config.epochs
        times = tuple(epoch / epochs for epoch in range(1, epochs))
        targets = tuple(self.points_at(time) for time in times)

        def near_parents(
            store: GaussianStore, parents: Int[Tensor, " p"], noise: Float[Tensor, "p 3"], fraction: float
        ) -> Mapping[str, Tensor]:
            """Children in a cube around their parents, whose side is the radius."""
            return {"means": store["means"].detach()[parents] + noise.to(store["means"]) * self.radius(fraction)}

        return RefillDensity(RefillSettings(times, targets, prune_opacity=0.5), near_parents, observed=was_drawn)

    @torch.no_grad()
    def bake(self) -> BlendSkinned:
        """Points with blend directions, skinning weights and constant colours."""
        if self.extras.unbaked is not None:
            raise UserError(f"{self.extras.unbaked}; {UNBAKED_REMEDY}")
        n, own = len(self.store), self.store["means"]
        motion = self.baked_motion()
        attributes = Attributes(
            quats=as_array(own.new_tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1)),
            log_scales=as_array(own.new_full((n, 3), math.log(self.radius(1.0) / 2))),
            opacity_logits=as_array(own.new_full((n,), math.log(_OPACITY / (1 - _OPACITY)))),
            sh=as_array(sh_from_rgb(self._colors(self.subject))[:, None]),
        )
        return BlendSkinned(motion.rig, attributes, still_weights=motion.still_weights, still_pose=motion.still_pose)

    def points_at(self, fraction: float) -> int:
        """The number of points that an epoch begins with."""
        config = self.config
        # Times of rounds are epoch / epochs, which multiplied by epochs may be a little less than the epoch.
        epoch = min(int(fraction * config.epochs + 1e-6), config.epochs - 1)
        return min(max(config.max_points, config.points), config.points * 2 ** min(epoch // config.growth_epochs, 40))

    def _colors(self, face: FaceParams) -> Float[Tensor, "*b n 3"]:
        """Albedo times light, 0..1 unless light is brighter: for each timestep, or for all of them alike."""
        points = self.store["means"].detach() / LENGTH_UNIT
        surface = self.surface_net(points)
        normals = torch.nn.functional.normalize(surface.slope, dim=-1)
        if self.config.normals == "deformed":
            normals = self.deformed_normals(points, normals, face)
        return sigmoid(surface.albedo) * self.shading(normals)

    def deformed_normals(
        self, points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"], face: FaceParams
    ) -> Float[Tensor, "b n 3"]:
        """Normals of the skinned points in the world, of length 1."""
        weights = self.deformation.whole(points).weights
        into, to = self.at_rest().transforms[None], self.transforms(face)
        at_rest = blend_transforms(weights, into)[0, :, :, :3]
        skinned = blend_transforms(weights, to)[..., :3]
        # A normal turns by the inverse of the transpose, which is the matrix of cofactors, but for its length.
        rested = (at_rest.transpose(-1, -2) @ normals[..., None])[..., 0]
        a, b, c = skinned.unbind(-2)
        cofactors = torch.stack([torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], dim=-2)
        turned = (cofactors @ rested[..., None])[..., 0] @ head_poses(face)[:, :3, :3].transpose(1, 2)
        return torch.nn.functional.normalize(turned, dim=-1)


def was_drawn(gaussians: Gaussians, rendering: Rendering) -> Float[Tensor, " n"]:
    """1 for points that take part in a pixel of the picture, and 0 for the others, which others hide."""
    gradient = rendering.means2d_offset.grad
    if gradient is None:
        return (rendering.radii > 0).to(gaussians.means)
    return (gradient != 0).any(-1).to(gaussians.means)
