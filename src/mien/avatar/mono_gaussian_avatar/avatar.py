"""MonoGaussianAvatar (Chen et al., SIGGRAPH 2024): free points, with all other properties predicted by networks.

Points deform by their own blend directions and skinning weights. Networks predict these from the points' positions, and
losses keep them near those of the face model's nearest vertex. Written from the paper's supplement and from facts about
its permissively licensed code. The canonical face has the mean expression of the training frames and an open jaw, so
that lips are apart where points are. Beside the face model's joints there is one more bone, which stands still in the
world while the head moves: it can hold hair and shoulders.

Differences from the paper and its code: the face model is any `FaceModel` (a jaw may follow the expression); each head
predicts its own attribute, while the published code mixes up columns of scales and rotations; attributes change with
the motion within the head frame, so that a turn of the head alone changes none of the head's; schedules are fractions
of the run, which spans epochs `first_epoch` to `epochs` of the paper; the optimiser's moments survive rounds.

Options beyond the paper, which are the defaults: points start on the face model (`start`), the deformation network
learns the face model's motion before the first picture (`pretraining`), and each point adds attributes of its own to
those that the network gives to its position (`own_rate`).
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mien.avatar.avatar import Avatar, Extras, ParameterGroup, Posed, Pretraining, network_group, store_group
from mien.avatar.baked_pose import Kept, can_pose_baked, pose_baked
from mien.avatar.baking import as_array, bake_rig
from mien.avatar.density import RefillDensity
from mien.avatar.mono_gaussian_avatar.constants import MONO
from mien.avatar.mono_gaussian_avatar.networks import (
    ATTRIBUTE_WIDTHS,
    ATTRIBUTES,
    AttributeChangeNet,
    AttributeNet,
    DeformationNet,
)
from mien.avatar.mono_gaussian_avatar.schedule import Schedule
from mien.avatar.mono_gaussian_avatar.settings import LENGTH_UNIT, MonoGaussianAvatarConfig
from mien.avatar.ops.activation import sigmoid
from mien.avatar.ops.skin_points import blend_transforms, skin_points, unskin
from mien.avatar.schedules import TRAINED, Progress
from mien.avatar.settings import RefillSettings
from mien.avatar.store import GaussianStore
from mien.avatar.surface_places import at_places, random_places, sample_surface
from mien.face import FaceModel, FaceParams, head_poses
from mien.gaussians import Gaussians, sh_from_rgb
from mien.render.rendering import Rendering
from mien.rotation import matrix_from_axis_angle, rigid_transform
from mien.runtime.baked import AttributeNetwork, Attributes, BlendSkinned

_POINTS_AT_ONCE = 4096
"""Number of points whose distances to all vertices are in memory at once: 74 MB for a face model of 4,535 vertices."""


class MonoGaussianAvatar(Avatar):
    """Free points. Networks predict attributes, blend directions and skinning weights."""

    config: MonoGaussianAvatarConfig

    def __init__(self, config: MonoGaussianAvatarConfig, face_model: FaceModel, face: FaceParams):
        pretraining = Pretraining(config.pretraining, self._pretrain) if config.pretraining > 0 else None
        super().__init__(
            config, face_model, face, Extras(frames_per_step=self._frames_per_step, pretraining=pretraining)
        )
        like = face_model.template
        e, k = face.expression.shape[1], len(face_model.joint_names)
        sizes = (config.attribute_width, config.attribute_layers, config.encoding_bands)
        self.attributes = AttributeNet(*sizes, config.sphere_start).to(like)
        self.deformation = DeformationNet(config.deformation_width, e, 9 * face.joints.shape[1], k + 1).to(like)
        self.change = AttributeChangeNet(config.change_width).to(like)
        expression, joints = canonical_face(face_model, face.expression.detach().mean(0))
        self.register_buffer("canonical_expression", expression)
        self.register_buffer("canonical_joints", joints)
        self.register_buffer("expression_variance", face.expression.detach().var(0, correction=0))
        self._baked, self._rest = Kept[BlendSkinned](), Kept[_AtRest]()
        if config.start == "sphere":
            # Uniform in a cube, then projected onto the sphere, as in the published code.
            cube = 2 * torch.rand(config.points, 3).to(like) - 1
            means = config.sphere_radius * torch.nn.functional.normalize(cube, dim=-1)
        else:
            means = sample_surface(self._at_rest().vertices, face_model.faces, config.points)
        trained = {"means": means}
        if config.own_rate.start > 0:
            trained["own_attributes"] = means.new_zeros(config.points, sum(ATTRIBUTE_WIDTHS))
        self.store = GaussianStore(trained)

    def pose(self, face: FaceParams, progress: Progress = TRAINED) -> Posed:
        """The Gaussians in the head frame, one batch entry per timestep.

        An avatar that is not in training mode (`eval()`) poses its baked form, unless `face` is to have gradients.
        """
        if not self.training and progress is TRAINED and can_pose_baked(self.store["means"], face):
            baked = self._baked.of((*self.parameters(), *self.buffers()), self.bake)
            return Posed(pose_baked(baked, face), {})
        means, displacement = self._deformed(face)
        # Detached, as in the published code: attributes do not pull on the points.
        change = self.change(displacement.detach() / LENGTH_UNIT)
        raw = split_attributes(self._attributes_at_rest() + change)
        radius = self._schedule().rendering_radius(progress.fraction)
        scales = self.config.scale_gain * sigmoid(raw["log_scales"]) + radius
        quats = torch.nn.functional.normalize(raw["quats"], dim=-1)
        opacities = sigmoid(raw["opacity_logits"][..., 0])
        sh = sh_from_rgb(sigmoid(raw["sh"]))[..., None, :]
        return Posed(Gaussians(means, quats, scales, opacities, sh, head_poses(face)), {})

    def _frames_per_step(self) -> int:
        """Fewer than the settings' if there are many points."""
        return max(1, min(self.config.frames_per_step, self.config.points_per_step // len(self.store)))

    def canonical_face(self) -> FaceParams:
        """The canonical expression and joints, at the subject's usual head pose."""
        expression, joints = self.get_buffer("canonical_expression"), self.get_buffer("canonical_joints")
        return replace(self.subject, expression=expression[None], joints=joints[None])

    def regularizers(self, posed: Posed, rendering: Rendering, progress: Progress) -> dict[str, Float[Tensor, ""]]:
        """Distance of skinning weights and blend directions from those of the nearest canonical vertex.

        Points are detached: these losses train the networks only. Each step uses the next `face_points` points; on
        average, that is the paper's mean over all points. The squared difference of an expression direction is
        multiplied by the mean variance of all coefficients over the training frames. The term then does not depend on
        how a face model scales its coefficients (the paper's weights are for FLAME).
        """
        n = len(self.store)
        turn = progress.step // progress.frames
        chosen = torch.arange(turn * self.config.face_points, (turn + 1) * self.config.face_points)
        means = self.store["means"].detach()
        losses = self._face_losses(means[chosen[:n].to(means.device) % n])
        weight = self._schedule().face_decay(progress.fraction)
        return {name: weight * loss for name, loss in losses.items()}

    def _face_losses(self, means: Float[Tensor, "p 3"]) -> dict[str, Float[Tensor, ""]]:
        """The same losses for some points, as they are before their weights halve."""
        model = self.face_model
        found = self.deformation.whole(means / LENGTH_UNIT)
        canonical = means + LENGTH_UNIT * found.offset.detach()
        nearest = nearest_vertices(canonical, self._at_rest().vertices)
        # The bone that stands still belongs to no vertex.
        weights = torch.nn.functional.pad(model.skinning_weights[nearest], (0, 1))
        losses = {"skinning": self.config.face_skinning_weight * _mean_square(found.weights - weights)}
        difference = found.expression - model.expression_basis[:, nearest].permute(1, 2, 0) / LENGTH_UNIT
        variance = self.get_buffer("expression_variance")
        unit = variance.mean().clamp_min(1e-8)
        if self.config.face_expression_by_variance:
            # Coefficients that never moved would otherwise have an infinite weight.
            unit = unit / ((variance / unit).clamp_min(0.01) * len(variance))
        losses["expression_directions"] = self.config.face_expression_weight * _mean_square(difference * unit.sqrt())
        if found.pose.shape[-1] > 0:
            basis = model.pose_basis
            correctives = 0 if basis is None else basis[:, nearest].permute(1, 2, 0) / LENGTH_UNIT
            losses["pose_correctives"] = self.config.face_correctives_weight * _mean_square(found.pose - correctives)
        return losses

    def _pretrain(self, face: FaceParams) -> Iterator[None]:
        """Teach the deformation network the face model's motion in training frames.

        The published network starts without any motion, and needs some hundred thousand steps to find it.
        """
        optimizer = torch.optim.Adam(self.deformation.parameters(), lr=MONO.pretraining_rate)
        canonical, faces = self._at_rest().vertices, self.face_model.faces
        for step in range(self.config.pretraining):
            optimizer.param_groups[0]["lr"] = MONO.pretraining_rate * 0.1 ** (step / self.config.pretraining)
            frames = face[torch.randint(len(face), (MONO.pretraining_frames,))].detach()
            corners, weights = random_places(canonical, faces, MONO.pretraining_points)
            means = at_places(canonical, corners, weights)
            target = at_places(self.face_model.head_vertices(frames), corners, weights)
            found, _ = self._deformed_from(means, frames)
            distance = (found - target).norm(dim=-1).mean() / LENGTH_UNIT
            optimizer.zero_grad()
            torch.autograd.backward([MONO.pretraining_weight * distance, *self._face_losses(means).values()])
            optimizer.step()
            yield

    def parameter_groups(self) -> list[ParameterGroup]:
        """One group for the points, and one per network."""
        rate, halvings = self.config.network_rate, self.config.rate_halvings
        networks = {"attributes": self.attributes, "deformation": self.deformation, "change": self.change}
        groups = [store_group(self.store, "means", self.config.means_rate)]
        if "own_attributes" in self.store.names():
            groups.append(store_group(self.store, "own_attributes", self.config.own_rate))
        groups += [network_group(name, network, rate) for name, network in networks.items()]
        return [replace(group, halvings=halvings) for group in groups]

    def gaussian_store(self) -> GaussianStore:
        """The store of points. Everything else comes from networks."""
        return self.store

    def density(self) -> RefillDensity:
        """Deletes points that no view of the last epoch has shown, then refills up to the scheduled number."""
        config, schedule = self.config, self._schedule()
        times = schedule.rounds()
        targets = tuple(min(config.max_points, schedule.points_at(time)) for time in times)

        def near_parents(
            store: GaussianStore, parents: Int[Tensor, " p"], noise: Float[Tensor, "p 3"], fraction: float
        ) -> dict[str, Tensor]:
            """Children on a sphere or in a cube around their parents."""
            around = noise.to(store["means"])
            if config.schedule == "paper":
                around = torch.nn.functional.normalize(around, dim=-1)
            return {"means": store["means"].detach()[parents] + around * schedule.sampling_length(fraction)}

        return RefillDensity(RefillSettings(times, targets, prune_opacity=0.1), refill=near_parents)

    @torch.no_grad()
    def bake(self) -> BlendSkinned:
        """Points with blend directions and skinning weights, raw attributes, and the network that changes them."""
        means = self.store["means"]
        found = self.deformation.whole(means / LENGTH_UNIT)
        expression, pose = LENGTH_UNIT * found.expression, LENGTH_UNIT * found.pose
        face = self.canonical_face()
        canonical = means + LENGTH_UNIT * found.offset
        skinning = blend_transforms(found.weights, self._transforms(face))[0]
        coefficients = self._coefficients(face, absolute=True)
        rest = unskin(canonical, skinning) - torch.cat([expression, pose], dim=-1) @ coefficients[0]
        raw = split_attributes(self._attributes_at_rest())
        layers = self.change.layers()
        rig = replace(
            bake_rig(self.face_model, self.subject),
            template=as_array(rest),
            expression_basis=as_array(expression.permute(2, 0, 1)),
            skinning_weights=as_array(found.weights[:, :-1]),
            pose_basis=as_array(pose.permute(2, 0, 1)),
        )
        # The network takes the motion from the canonical position, but the runtime gives the motion from the rest
        # position. They differ by a constant for each point. Both enter linearly, so the constant uses the same columns
        # of weights again.
        first = layers[0].weight / LENGTH_UNIT
        network = AttributeNetwork(
            input="displacement",
            base=as_array(rest - canonical),
            weights=tuple(
                as_array(part) for part in (torch.cat([first, first], dim=1), *(layer.weight for layer in layers[1:]))
            ),
            biases=tuple(as_array(layer.bias) for layer in layers),
            activation="relu",
            outputs=ATTRIBUTES,
        )
        attributes = Attributes(
            quats=as_array(raw["quats"]),
            log_scales=as_array(raw["log_scales"]),
            opacity_logits=as_array(raw["opacity_logits"][..., 0]),
            sh=as_array(raw["sh"][:, None]),
        )
        return BlendSkinned(
            rig=rig,
            attributes=attributes,
            scale_activation="sigmoid",
            scale_gain=self.config.scale_gain,
            scale_offset=self._schedule().rendering_radius(1.0),
            color_activation="sigmoid",
            network=network,
            still_weights=as_array(found.weights[:, -1]),
            still_pose=as_array(face.T_world_head[0]),
        )

    def _attributes_at_rest(self) -> Float[Tensor, "n 11"]:
        """Raw attributes that the network predicts for the points' positions, and what each point adds to them."""
        raw = self.attributes(self.store["means"].detach() / LENGTH_UNIT)
        return raw + self.store["own_attributes"] if "own_attributes" in self.store.names() else raw

    def _schedule(self) -> Schedule:
        config = self.config
        return Schedule(config.schedule, config.epochs, config.points, config.first_epoch)

    def _transforms(self, face: FaceParams) -> Float[Tensor, "b k 3 4"]:
        """The joints' transforms in the head frame, then that of the bone which stands still in the world."""
        still = _inverse(face.T_world_head) @ self.canonical_face().T_world_head
        return torch.cat([self.face_model.joint_transforms(face), still[:, None]], dim=1)[:, :, :3]

    def _at_rest(self) -> "_AtRest":
        """What depends on the canonical face alone."""

        @torch.no_grad()
        def make() -> _AtRest:
            face = self.canonical_face()
            vertices, transforms = self.face_model.head_vertices(face)[0], self._transforms(face)[0]
            return _AtRest(vertices, transforms, self._coefficients(face, absolute=True))

        own = (self.get_buffer("canonical_expression"), self.get_buffer("canonical_joints"))
        return self._rest.of((*own, *self.subject.tensors().values()), make)

    def _coefficients(self, face: FaceParams, absolute: bool = False) -> Float[Tensor, "b c"]:
        """Weights of the blend directions: less those of the canonical face, or as they are (`absolute`)."""
        own = torch.cat([face.expression, _pose_features(face)], dim=1)
        if absolute:
            return own
        return own - self._at_rest().coefficients

    def _deformed(self, face: FaceParams) -> tuple[Float[Tensor, "b n 3"], Float[Tensor, "b n 3"]]:
        """Points in the head frame, and their motion from the canonical positions, both in metres."""
        return self._deformed_from(self.store["means"], face)

    def _deformed_from(
        self, means: Float[Tensor, "n 3"], face: FaceParams
    ) -> tuple[Float[Tensor, "b n 3"], Float[Tensor, "b n 3"]]:
        offset, moved, weights = self.deformation(means / LENGTH_UNIT, self._coefficients(face))
        canonical = means + LENGTH_UNIT * offset
        at_rest = self._at_rest().transforms
        posed = skin_points(canonical, LENGTH_UNIT * moved, weights, at_rest, self._transforms(face))
        return posed, posed - canonical


class _AtRest(NamedTuple):
    """The canonical face."""

    vertices: Float[Tensor, "v 3"]
    transforms: Float[Tensor, "k 3 4"]
    coefficients: Float[Tensor, "1 c"]


def canonical_face(
    model: FaceModel, expression: Float[Tensor, " e"]
) -> tuple[Float[Tensor, " e"], Float[Tensor, "j 3"]]:
    """An expression and joints at which the jaw is open by `MONO.canonical_jaw`.

    A free jaw turns by this angle. A jaw that follows the expression gets it from the coefficient that opens it most.
    Other joints are at rest. A model without a joint `jaw` keeps its jaw.
    """
    joints = expression.new_zeros(len(model.free_joint_names), 3)
    if "jaw" in model.free_joint_names:
        joints[model.free_joint_names.index("jaw"), 0] = MONO.canonical_jaw
    elif "jaw" in model.joint_names:
        opening = model.joint_rotation_basis[:, model.joint_names.index("jaw"), 0].to(expression)
        best = opening.argmax()
        if opening[best] > 0:
            expression = expression.clone()
            expression[best] += (MONO.canonical_jaw - expression @ opening) / opening[best]
    return expression, joints


def _pose_features(face: FaceParams) -> Float[Tensor, "b p"]:
    """R - I of the free joints, row by row."""
    return (matrix_from_axis_angle(face.joints) - torch.eye(3).to(face.joints)).flatten(1)


def _inverse(pose: Float[Tensor, "b 4 4"]) -> Float[Tensor, "b 4 4"]:
    """The inverses of rigid transforms."""
    turned = pose[:, :3, :3].transpose(1, 2)
    return rigid_transform(turned, -(turned @ pose[:, :3, 3:])[..., 0])


def split_attributes(raw: Float[Tensor, "*b 11"]) -> dict[str, Tensor]:
    """The columns of the attribute networks by name."""
    return dict(zip(ATTRIBUTES, raw.split(ATTRIBUTE_WIDTHS, dim=-1), strict=True))


@torch.no_grad()
def nearest_vertices(points: Float[Tensor, "n 3"], vertices: Float[Tensor, "v 3"]) -> Int[Tensor, " n"]:
    """The index of the vertex nearest to each point.

    Points are looked at in parts: all 100,000 of the paper at once would need 1.8 GB for their distances.
    """
    # |p - v|^2 less |p|^2, which is the same for all vertices, and half of that.
    own, across = vertices.square().sum(-1) / 2, vertices.T
    return torch.cat([torch.addmm(own, part, across, alpha=-1).argmin(-1) for part in points.split(_POINTS_AT_ONCE)])


def _mean_square(values: Tensor) -> Float[Tensor, ""]:
    return values.square().mean()
