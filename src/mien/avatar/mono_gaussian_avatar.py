"""MonoGaussianAvatar (Chen et al., SIGGRAPH 2024): free points, with all other properties predicted by networks.

Points deform by their own blend directions and skinning weights. Networks predict these from the points' positions, and
losses keep them near those of the face model's nearest vertex. Written from the paper's supplement and from facts about
its permissively licensed code. Differences from it: the face model is any `FaceModel` (its `head` joint, which is at
rest in the head frame, is the paper's extra identity bone; a jaw may follow the expression); the canonical face has the
mean expression of the training frames and free joints at rest; each head predicts its own attribute, while the
published code mixes up columns of colours and rotations; schedules are fractions of the run, onto which the paper's
epochs 0..100 are mapped; networks are small enough for a CPU. Not implemented yet: the perceptual loss, batches, a
learned background.
"""

import math
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from mien.avatar.activation import sigmoid
from mien.avatar.avatar import Avatar, ParameterGroup, Posed, network_group, store_group
from mien.avatar.baking import as_array, bake_rig
from mien.avatar.density import RefillDensity
from mien.avatar.mono_gaussian_avatar_settings import MonoGaussianAvatarConfig
from mien.avatar.mono_networks import (
    ATTRIBUTE_WIDTHS,
    ATTRIBUTES,
    LENGTH_UNIT,
    AttributeChangeNet,
    AttributeNet,
    DeformationNet,
)
from mien.avatar.schedules import TRAINED, Progress
from mien.avatar.settings import RefillSettings
from mien.avatar.store import GaussianStore
from mien.face import FaceModel, FaceParams, head_poses
from mien.gaussians import Gaussians, sh_from_rgb
from mien.render.rendering import Rendering
from mien.rotation import matrix_from_axis_angle
from mien.runtime.baked import AttributeNetwork, Attributes, BlendSkinned

# The schedules below use the paper's epochs divided by 100.
_GROWTH = (
    (0.05, 800), (0.10, 1600), (0.15, 3200), (0.20, 6400), (0.25, 10_000),
    (0.30, 20_000), (0.40, 40_000), (0.50, 80_000), (0.60, 100_000),
)  # fmt: skip
_SHRINKAGE = (
    *((time / 100, 0.75) for time in (5, 10, 15, 20, 25, 30, 40, 50)),
    (0.60, 0.9),
    # The paper also shrinks at epoch 100. Here that would be the end of the run, with no training afterwards to adapt.
    *((time / 100, 0.75) for time in (65, 70, 75, 80, 85, 90, 95)),
)


class MonoGaussianAvatar(Avatar):
    """Free points. Networks predict attributes, blend directions and skinning weights."""

    config: MonoGaussianAvatarConfig

    def __init__(self, config: MonoGaussianAvatarConfig, face_model: FaceModel, face: FaceParams):
        super().__init__(config, face_model, face)
        like = face_model.template
        # Uniform in a cube, then projected onto the sphere, as in the published code.
        cube = 2 * torch.rand(config.points, 3).to(like) - 1
        self.store = GaussianStore({"means": config.sphere_radius * torch.nn.functional.normalize(cube, dim=-1)})
        e, k = face.expression.shape[1], len(face_model.joint_names)
        self.attributes = AttributeNet(config.attribute_width, config.attribute_layers).to(like)
        self.deformation = DeformationNet(config.deformation_width, e, 9 * face.joints.shape[1], k).to(like)
        self.change = AttributeChangeNet(config.change_width).to(like)
        self.register_buffer("canonical_expression", face.expression.detach().mean(0))
        self.register_buffer("expression_variance", face.expression.detach().var(0, correction=0))

    def pose(self, face: FaceParams, progress: Progress = TRAINED) -> Posed:
        """The Gaussians in the head frame, one batch entry per timestep."""
        points = self._points()
        means, displacement = self._deformed(points, face)
        # Detached, as in the published code: attributes do not pull on the points.
        change = self.change(displacement.detach() / LENGTH_UNIT)
        raw = split_attributes(self.attributes(self.store["means"].detach() / LENGTH_UNIT) + change)
        scales = self.config.scale_gain * sigmoid(raw["log_scales"]) + rendering_radius(progress.fraction)
        quats = torch.nn.functional.normalize(raw["quats"], dim=-1)
        opacities = sigmoid(raw["opacity_logits"][..., 0])
        sh = sh_from_rgb(sigmoid(raw["sh"]))[..., None, :]
        gaussians = Gaussians(means, quats, scales, opacities, sh, head_poses(face))
        return Posed(gaussians, {name: points[name] for name in ("canonical", "expression", "pose", "weights")})

    def canonical_face(self) -> FaceParams:
        """The mean expression of the training frames with free joints at rest, at the origin of the head frame."""
        expression = self.get_buffer("canonical_expression")[None]
        still = torch.zeros_like(self.subject.head_rotation)
        joints = torch.zeros_like(self.subject.joints)
        return replace(self.subject, expression=expression, joints=joints, head_rotation=still, head_translation=still)

    def regularizers(self, posed: Posed, rendering: Rendering, progress: Progress) -> dict[str, Float[Tensor, ""]]:
        """Distance of skinning weights and blend directions from those of the nearest canonical vertex.

        Each step uses the next `face_points` points; on average, that is the paper's mean over all points. The squared
        difference of an expression direction is multiplied by the squared mean variance of all coefficients over the
        training frames, and divided by the variance of its own coefficient. The term then does not depend on how a face
        model scales its coefficients (the paper's weights are for FLAME).
        """
        n = len(self.store)
        chosen = torch.arange(progress.step * self.config.face_points, (progress.step + 1) * self.config.face_points)
        chosen = chosen[:n].to(posed.gaussians.means.device) % n
        model = self.face_model
        nearest = nearest_vertices(posed.aux["canonical"][chosen], model.head_vertices(self.canonical_face())[0])
        losses = {"skinning": 0.1 * _mean_square(posed.aux["weights"][chosen] - model.skinning_weights[nearest])}
        targets = model.expression_basis[:, nearest].permute(1, 2, 0)
        variance = self.get_buffer("expression_variance")
        unit = variance.mean().clamp_min(1e-8)
        # Coefficients that never moved would otherwise have an infinite weight.
        relative = (variance / unit).clamp_min(0.01)
        difference = (posed.aux["expression"][chosen] - targets) / LENGTH_UNIT
        losses["expression_directions"] = 10 * _mean_square(
            10 * difference * (unit / (relative * len(relative))).sqrt()
        )
        if posed.aux["pose"].shape[-1] > 0:
            basis = model.pose_basis
            correctives = 0 if basis is None else basis[:, nearest].permute(1, 2, 0)
            losses["pose_correctives"] = 10 * _mean_square(10 * (posed.aux["pose"][chosen] - correctives) / LENGTH_UNIT)
        weight = self.config.face_weight * face_decay(progress.fraction)
        return {name: weight * loss for name, loss in losses.items()}

    def parameter_groups(self) -> list[ParameterGroup]:
        """One group for the points, and one per network."""
        rate = self.config.network_rate
        networks = {"attributes": self.attributes, "deformation": self.deformation, "change": self.change}
        groups = [network_group(name, network, rate) for name, network in networks.items()]
        return [store_group(self.store, "means", self.config.means_rate), *groups]

    def gaussian_store(self) -> GaussianStore:
        """The store of points. Everything else comes from networks."""
        return self.store

    def density(self) -> RefillDensity:
        """Deletes points that no view of the last round has shown, then refills up to the scheduled number."""
        config = self.config
        times = tuple(index / config.rounds for index in range(1, config.rounds))
        targets = tuple(min(config.max_points, points_at(time, config.points)) for time in times)
        return RefillDensity(RefillSettings(times, targets, prune_opacity=0.1), refill=_near_parents)

    @torch.no_grad()
    def bake(self) -> BlendSkinned:
        """Points with blend directions and skinning weights, raw attributes, and the network that changes them."""
        points = self._points()
        raw = split_attributes(self.attributes(self.store["means"] / LENGTH_UNIT))
        weights, biases = self.change.flattened()
        rig = replace(
            bake_rig(self.face_model, self.subject),
            template=as_array(points["rest"]),
            expression_basis=as_array(points["expression"].permute(2, 0, 1)),
            skinning_weights=as_array(points["weights"]),
            pose_basis=as_array(points["pose"].permute(2, 0, 1)),
        )
        # The network takes the motion from the canonical position, but the runtime gives the motion from the rest
        # position. They differ by a constant for each point. Both enter linearly, so the constant uses the same columns
        # of weights again.
        first = weights[0] / LENGTH_UNIT
        network = AttributeNetwork(
            input="displacement",
            base=as_array(points["rest"] - points["canonical"]),
            basis=np.zeros((0, len(self.store), 0), np.float32),
            weights=tuple(as_array(weight) for weight in (torch.cat([first, first], dim=1), *weights[1:])),
            biases=tuple(as_array(bias) for bias in biases),
            activation="relu",
            outputs=ATTRIBUTES,
        )
        return BlendSkinned(
            rig=rig,
            attributes=Attributes(
                as_array(raw["quats"]),
                as_array(raw["log_scales"]),
                as_array(raw["opacity_logits"][..., 0]),
                as_array(raw["sh"][:, None]),
            ),
            scale_activation="sigmoid",
            scale_gain=self.config.scale_gain,
            scale_offset=rendering_radius(1.0),
            colour_activation="sigmoid",
            network=network,
        )

    def _points(self) -> dict[str, Tensor]:
        """Canonical and rest positions (metres), directions (metres per unit) and skinning weights of the points."""
        means = self.store["means"]
        offset, expression, pose, weights = self.deformation(means / LENGTH_UNIT)
        expression, pose = LENGTH_UNIT * expression, LENGTH_UNIT * pose
        canonical, face = means + LENGTH_UNIT * offset, self.canonical_face()
        skinning = blend_transforms(weights, self.face_model.joint_transforms(face))[0]
        shaped = unskin(canonical, skinning)
        rest = shaped - blend_directions(expression, pose, face)[0]
        return {"canonical": canonical, "rest": rest, "expression": expression, "pose": pose, "weights": weights}

    def _deformed(
        self, points: dict[str, Tensor], face: FaceParams
    ) -> tuple[Float[Tensor, "b n 3"], Float[Tensor, "b n 3"]]:
        """Points in the head frame, and their motion from the canonical positions, both in metres."""
        shaped = points["rest"] + blend_directions(points["expression"], points["pose"], face)
        skinning = blend_transforms(points["weights"], self.face_model.joint_transforms(face))
        means = (skinning[..., :3] @ shaped[..., None])[..., 0] + skinning[..., 3]
        return means, means - points["canonical"]


def blend_directions(
    expression: Float[Tensor, "n 3 e"], pose: Float[Tensor, "n 3 p"], face: FaceParams
) -> Float[Tensor, "b n 3"]:
    """E psi + P (R - I): the displacements from expression and free joints, before skinning."""
    turned = matrix_from_axis_angle(face.joints) - torch.eye(3).to(face.joints)
    added = expression.flatten(0, 1) @ face.expression.T + pose.flatten(0, 1) @ turned.flatten(1).T
    return added.T.unflatten(-1, (-1, 3))


def blend_transforms(weights: Float[Tensor, "n k"], transforms: Float[Tensor, "b k 4 4"]) -> Float[Tensor, "b n 3 4"]:
    """Each point's transform: the mean of the joints' transforms, weighted by its skinning weights."""
    return (weights @ transforms[:, :, :3].flatten(2)).unflatten(-1, (3, 4))


def unskin(points: Float[Tensor, "n 3"], transforms: Float[Tensor, "n 3 4"]) -> Float[Tensor, "n 3"]:
    """Positions of the points before affine transforms moved them (inverse skinning)."""
    a, b, c = transforms[..., :3].unbind(-2)
    # Cramer's rule is several times as fast as a general inverse of many small matrices.
    columns = torch.stack([torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], dim=-1)
    determinant = (a * columns[..., 0]).sum(-1, keepdim=True)
    return (columns @ (points - transforms[..., 3])[..., None])[..., 0] / determinant


def split_attributes(raw: Float[Tensor, "*b 11"]) -> dict[str, Tensor]:
    """The columns of the attribute networks by name."""
    return dict(zip(ATTRIBUTES, raw.split(ATTRIBUTE_WIDTHS, dim=-1), strict=True))


@torch.no_grad()
def nearest_vertices(points: Float[Tensor, "n 3"], vertices: Float[Tensor, "v 3"]) -> Int[Tensor, " n"]:
    """The index of the vertex nearest to each point."""
    return torch.cdist(points, vertices).argmin(-1)


def rendering_radius(fraction: float) -> float:
    """Length added to all scales at a fraction of the run, in metres. It is also the spread of new points."""
    radius = 0.15 * 0.75 ** math.log2(400 / 100) * LENGTH_UNIT
    return radius * math.prod(factor for time, factor in _SHRINKAGE if fraction >= time)


def points_at(fraction: float, first: int) -> int:
    """The paper's number of points at a fraction of the run."""
    return max([first, *(count for time, count in _GROWTH if fraction >= time)])


def face_decay(fraction: float) -> float:
    """Factor on the weight of the face model's terms at a fraction of the run."""
    return 0.5 ** sum(fraction >= time for time in (0.2, 0.3, 0.5, 0.7))


def _near_parents(
    store: GaussianStore, parents: Int[Tensor, " p"], noise: Float[Tensor, "p 3"], fraction: float
) -> dict[str, Tensor]:
    """Children in a cube around their parents. The side of the cube is the rendering radius."""
    return {"means": store["means"].detach()[parents] + noise.to(store["means"]) * rendering_radius(fraction)}


def _mean_square(values: Tensor) -> Float[Tensor, ""]:
    return values.square().mean()
