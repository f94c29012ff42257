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

from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mien.avatar.avatar import Extras, ParameterGroup, Posed, Pretraining, network_group, store_group
from mien.avatar.baking import Kept, as_array, can_pose_baked, pose_baked
from mien.avatar.density import RefillDensity
from mien.avatar.mono_gaussian_avatar.motion import FreePoints
from mien.avatar.mono_gaussian_avatar.networks import (
    ATTRIBUTE_WIDTHS,
    ATTRIBUTES,
    AttributeChangeNet,
    AttributeNet,
)
from mien.avatar.mono_gaussian_avatar.schedule import Schedule
from mien.avatar.mono_gaussian_avatar.settings import LENGTH_UNIT, MonoGaussianAvatarConfig
from mien.avatar.ops.activation import sigmoid
from mien.avatar.settings import TRAINED, Progress, RefillSettings
from mien.avatar.store import GaussianStore
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.face.posing import head_poses
from mien.gaussians import Gaussians, Rendering, sh_from_rgb
from mien.kernels import on_gpu
from mien.runtime.baked import AttributeNetwork, Attributes, BlendSkinned
from mien.runtime.checks import MAX_LOG_SCALE


class MonoGaussianAvatar(FreePoints):
    """Free points. Networks predict attributes, blend directions and skinning weights."""

    config: MonoGaussianAvatarConfig

    def __init__(self, config: MonoGaussianAvatarConfig, face_model: FaceModel, face: FaceParams):
        pretraining = Pretraining(config.pretraining, self.pretrain) if config.pretraining > 0 else None
        extras = Extras(frames_per_step=self._frames_per_step, pretraining=pretraining, graph_key=self._graph_key)
        super().__init__(config, face_model, face, extras)
        like = face_model.template
        sizes = (config.attribute_width, config.attribute_layers, config.encoding_bands)
        every = config.weight_norm == "paper"
        self.attributes = AttributeNet(*sizes, config.sphere_start, every).to(like)
        self.deformation = self.new_deformation(face, config.weight_norm)
        self.change = AttributeChangeNet(config.change_width, every).to(like)
        means = self.first_means(face)
        self._baked = Kept[BlendSkinned]()
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
        means, displacement = self.deformed(self.store["means"], face)
        # Detached, as in the published code: attributes do not pull on the points.
        change = self.change(displacement.detach() / LENGTH_UNIT)
        radius = self._schedule().rendering_radius(progress.fraction)
        if on_gpu(means):
            from mien.avatar.mono_gaussian_avatar.motion_gpu import activated

            own = self.store["own_attributes"] if "own_attributes" in self.store.names() else None
            found = activated(self._predicted_at_rest(), own, change, self.config.scale_gain, radius)
            scales, quats, opacities, sh = found
            return Posed(Gaussians(means, quats, scales, opacities, sh, head_poses(face)), {})
        raw = split_attributes(self._attributes_at_rest() + change)
        scales = self.config.scale_gain * sigmoid(raw["log_scales"]) + radius
        quats = torch.nn.functional.normalize(raw["quats"], dim=-1)
        opacities = sigmoid(raw["opacity_logits"][..., 0])
        sh = sh_from_rgb(sigmoid(raw["sh"]))[..., None, :]
        return Posed(Gaussians(means, quats, scales, opacities, sh, head_poses(face)), {})

    def _graph_key(self, progress: Progress) -> float:
        """The radius of all points, which changes with the epoch."""
        return self._schedule().rendering_radius(progress.fraction)

    def _frames_per_step(self, _: float) -> int:
        """Fewer than the settings' if there are many points."""
        return max(1, min(self.config.frames_per_step, self.config.points_per_step // len(self.store)))

    def regularizers(self, posed: Posed, rendering: Rendering, progress: Progress) -> dict[str, Float[Tensor, ""]]:
        """`face_losses` of the next points, whose weight falls. They train the networks only."""
        return self.face_losses(self.chosen_means(progress), self._schedule().face_decay(progress.fraction))

    def parameter_groups(self) -> list[ParameterGroup]:
        """One group for the points, and one per network."""
        rate, halvings = self.config.network_rate, self.config.rate_halvings
        networks = {"attributes": self.attributes, "deformation": self.deformation, "change": self.change}
        groups = [store_group(self.store, "means", self.config.means_rate)]
        if "own_attributes" in self.store.names():
            groups.append(store_group(self.store, "own_attributes", self.config.own_rate))
        groups += [network_group(name, network, rate) for name, network in networks.items()]
        return [replace(group, halvings=halvings, epsilon=self.config.adam_epsilon) for group in groups]

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
        motion = self.baked_motion()
        raw = split_attributes(self._attributes_at_rest())
        layers = self.change.layers()
        # The network takes the motion from the canonical position, but the runtime gives the motion from the rest
        # position. They differ by a constant for each point. Both enter linearly, so the constant uses the same columns
        # of weights again.
        first = layers[0].weight / LENGTH_UNIT
        network = AttributeNetwork(
            input="displacement",
            base=as_array(motion.to_rest),
            weights=tuple(map(as_array, (torch.cat([first, first], dim=1), *(layer.weight for layer in layers[1:])))),
            biases=tuple(as_array(layer.bias) for layer in layers),
            activation="relu",
            outputs=ATTRIBUTES,
        )
        attributes = Attributes(
            quats=as_array(raw["quats"]),
            # Sigmoids of larger numbers are the same in float32, and no file may hold them.
            log_scales=as_array(raw["log_scales"].clamp(-MAX_LOG_SCALE, MAX_LOG_SCALE)),
            opacity_logits=as_array(raw["opacity_logits"][..., 0]),
            sh=as_array(raw["sh"][:, None]),
        )
        return BlendSkinned(
            rig=motion.rig,
            attributes=attributes,
            scale_activation="sigmoid",
            scale_gain=self.config.scale_gain,
            scale_offset=self._schedule().rendering_radius(1.0),
            color_activation="sigmoid",
            network=network,
            still_weights=motion.still_weights,
            still_pose=motion.still_pose,
        )

    def _attributes_at_rest(self) -> Float[Tensor, "n 11"]:
        """Raw attributes that the network predicts for the points' positions, and what each point adds to them."""
        raw = self._predicted_at_rest()
        return raw + self.store["own_attributes"] if "own_attributes" in self.store.names() else raw

    def _predicted_at_rest(self) -> Float[Tensor, "n 11"]:
        return self.attributes(self.store["means"].detach() / LENGTH_UNIT)

    def _schedule(self) -> Schedule:
        config = self.config
        return Schedule(config.schedule, config.epochs, config.points, config.first_epoch, config.late_epoch)


def split_attributes(raw: Float[Tensor, "*b 11"]) -> dict[str, Tensor]:
    """The columns of the attribute networks by name."""
    return dict(zip(ATTRIBUTES, raw.split(ATTRIBUTE_WIDTHS, dim=-1), strict=True))
