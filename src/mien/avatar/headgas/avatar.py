"""HeadGaS (Dhamo et al., ECCV 2024): Gaussians at rest in the head frame; expressions change colour and opacity.

No code was published, so this is written from the paper, its supplement and its equations. Each Gaussian blends a basis
of latent features by the expression. One small network turns the result into colour and opacity, so that lips fade
where teeth appear. The paper leaves some choices open, which were made here: joints that no expression drives are
appended to the expression vector, because nothing else would move the gaze; the learning rates; the bands and the
length unit of the encoding; and the opacity to prune by. The paper's ablations are in `variants.py`.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from mien.adam import FactoredGradient, FactoredMoments, Moments
from mien.avatar.avatar import (
    UNBAKED_REMEDY,
    Avatar,
    Extras,
    ParameterGroup,
    Posed,
    factored_group,
    network_group,
    store_group,
)
from mien.avatar.baking import Kept, as_array, as_log_scales, can_pose_baked, pose_baked
from mien.avatar.density import GradientDensity
from mien.avatar.headgas.settings import HeadGasConfig
from mien.avatar.headgas.variants import (
    ABLATIONS,
    Changes,
    colors_of,
    encoded,
    feature_tensors,
    moved_by,
    new_network,
)
from mien.avatar.ops.activation import sigmoid
from mien.avatar.ops.expression_changes import ExpressionActivations, expression_inputs, principal_directions
from mien.avatar.ops.feature_network import Layers, feature_network
from mien.avatar.ops.points import at_places, positional_encoding, random_places
from mien.avatar.settings import TRAINED, Progress, Rate, active_degree
from mien.avatar.store import GaussianStore
from mien.errors import UserError
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.face.posing import head_poses
from mien.gaussians import Gaussians, Rendering
from mien.machine.devices import upload
from mien.runtime.baked import AttributeNetwork, Attributes, FeatureChanges, FeatureDirections, MeshBound, Static
from mien.runtime.still import standing_still

_OPACITY_RATE = Rate(0.05)  # of opacities that Gaussians have themselves. Of 3D Gaussian Splatting

_CHUNK = 512


class HeadGas(Avatar):
    """Static Gaussians in the head frame, with colour and opacity from blended features."""

    config: HeadGasConfig
    rest: Tensor
    directions: Tensor
    judged: FaceParams
    """Faces at which opacities to prune by are computed."""

    def __init__(self, config: HeadGasConfig, face_model: FaceModel, face: FaceParams):
        n, ablation = config.points, ABLATIONS.get(config.variant)
        unbaked = ablation and ablation.unbaked and f"the variant {config.variant} of headgas: {ablation.unbaked}"
        super().__init__(config, face_model, face, Extras(unbaked=unbaked))
        vertices, faces = face_model.head_vertices(self.subject)[0], face_model.faces
        triangles, weights = random_places(vertices, faces, n)
        means = at_places(vertices, faces[triangles], weights)
        # The average of `no_mlp` is one of expression weights, which directions are not.
        rest, directions = input_directions(face, self.subject, 0 if config.variant == "no_mlp" else config.directions)
        self.rest, self.directions = (nn.Buffer(tensor) for tensor in (rest, directions))
        spread = spread_out((expression_inputs(face) - rest) @ directions, config.judged_expressions)
        # Not in files: only training needs them, and finds them anew.
        self.judged = face[spread].detach()
        self.activations = None
        if config.activations == "regions" and ablation is None and config.directions > 0 and config.sh_degree == 0:
            self.activations = ExpressionActivations(face_model, face, self.subject, config.directions)
        shapes = {
            "means": means,
            "quats": means.new_tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
            "log_scales": neighbor_distances(means).clamp_min(1e-6).log()[:, None].repeat(1, 3),
        }
        k = directions.shape[1] if self.activations is None else config.directions
        if ablation is None:
            features = feature_tensors(means, k, config.features)
            sizes = [config.features + encoded(config), config.hidden, colors_of(config) + 1]
            network = new_network(sizes)
        else:
            features, network = ablation.tensors(means, k, config), ablation.network(k, config)
        fixed = None if self.activations is None else {"face_index": triangles}
        self.store, self.network = GaussianStore(shapes | features, fixed), network.to(means)
        self._shares: dict[tuple[int, torch.device, torch.dtype], Tensor] = {}
        self.bases_gradient, self._baked, self._ablation = FactoredGradient(), Kept[Static | MeshBound](), ablation

    def pose(self, face: FaceParams, progress: Progress = TRAINED) -> Posed:
        """The Gaussians in the head frame, one batch entry per timestep. Colours and opacities differ between them.

        An avatar that is not in training mode (`eval()`) poses its baked form, if there is one, unless `face` is to
        have gradients.
        """
        store = self.store
        if (
            not self.training
            and progress is TRAINED
            and self.extras.unbaked is None
            and can_pose_baked(store["means"], face)
        ):
            baked = self._baked.of((*self.parameters(), *self.buffers()), self.bake)
            return Posed(pose_baked(baked, face), {})
        changes = list(self._changes(self._inputs(face), progress))
        sh = _stacked([one.colors for one in changes]).unflatten(-1, (-1, 3))
        opacities = sigmoid(_stacked([one.opacity_logits for one in changes]))
        scales = store["log_scales"].exp()
        gaussians = Gaussians(store["means"], store["quats"], scales, opacities, sh, head_poses(face))
        moved = [one.moved for one in changes if one.moved is not None]
        return moved_by(gaussians, _stacked(moved)) if moved else Posed(gaussians, {})

    def regularizers(self, posed: Posed, rendering: Rendering, progress: Progress) -> dict[str, Float[Tensor, ""]]:
        """None, but for the size of the shifts in ablations that move Gaussians (supplement, eq. 4)."""
        if "shifts" not in posed.aux:
            return {}
        return {"shift": self.config.shift_weight * posed.aux["shifts"].abs().mean()}

    def parameter_groups(self) -> list[ParameterGroup]:
        """One group per tensor, and one for the network."""
        config = self.config
        rates = {
            "means": config.means_rate,
            "log_scales": config.log_scales_rate,
            "quats": config.quats_rate,
            "neutral_features": config.features_rate,
            "sh": config.features_rate,
            "opacity_logits": _OPACITY_RATE,
        }
        groups = [
            store_group(self.store, name, rates[name], times_extent=name == "means" and config.means_times_extent)
            for name in self.store.names()
            if name in rates
        ]
        if "bases" in self.store.names():
            kind = FactoredMoments if config.factored_bases else Moments
            groups.append(factored_group(self.store, "bases", config.features_rate, self.bases_gradient, kind))
        network = network_group("network", self.network, config.network_rate)
        return [*groups, replace(network, epsilon=config.network_epsilon)]

    def density(self) -> GradientDensity:
        """Gradient-based control. Children copy features. `judged_opacities` says which opacity counts."""
        self.judged = self.judged.to(self.rest)
        return GradientDensity(self.config.density, opacity_logits=None, judged_opacities=self.judged_opacities)

    @torch.no_grad()
    def judged_opacities(self, store: GaussianStore, seen: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
        """The highest opacity of each Gaussian at the judged expressions and in the steps since the last round.

        The judged expressions are spread over those of training, so that Gaussians which rare expressions need, such as
        teeth, are not pruned while these are not drawn.
        """
        highest = seen
        for changes in self._changes(self._inputs(self.judged.to(self.rest))):
            highest = torch.maximum(highest, sigmoid(changes.opacity_logits))
        return highest

    def bake(self) -> Static | MeshBound:
        """Points, with the bases of the features and the network; with regions, bound to triangles that stand."""
        if self.extras.unbaked is not None:
            raise UserError(f"{self.extras.unbaked}; {UNBAKED_REMEDY}")
        store = self.store.arrays()
        n = len(self.store)
        weights, biases = ([getattr(layer, part) for layer in self.network[::2]] for part in ("weight", "bias"))
        shares = self.output_shares(TRAINED).to(weights[-1])
        if len(self.network) % 2 == 0:
            # A record has no activation after its last layer, so the shares are a layer after the network's own.
            weights, biases = [*weights, torch.eye(len(shares)).to(shares)], [*biases, torch.zeros_like(shares)]
        weights[-1], biases[-1] = weights[-1] * shares[:, None], biases[-1] * shares
        layers = tuple(map(as_array, weights)), tuple(map(as_array, biases))
        none, no_sh = np.zeros(n, np.float32), np.zeros((n, colors_of(self.config) // 3, 3), np.float32)
        attributes = Attributes(store["quats"], as_log_scales(store["log_scales"]), none, no_sh)
        names, free = self.face_model.expression_names, self.face_model.free_joint_names
        if self.activations is not None:
            features = FeatureChanges(store["neutral_features"], store["bases"], as_array(self.encoding()), *layers)
            changes = replace(self.activations.record(), features=features)
            return standing_still(store["means"], attributes, names, free, changes, store["face_index"])
        neutral, along = self._baked_features()
        network = AttributeNetwork(
            input="features",
            base=np.concatenate([as_array(neutral), as_array(self.encoding())], axis=1),
            weights=layers[0],
            biases=layers[1],
            activation="leaky_relu",
            outputs=("sh", "opacity_logits"),
            along=along,
        )
        return Static(store["means"], attributes, names, free, network=network)

    def _baked_features(self) -> tuple[Float[Tensor, "n w"], FeatureDirections]:
        rest, directions = as_array(self.rest), as_array(self.directions)
        if "bases" in self.store.names():
            return self.store["neutral_features"], FeatureDirections(rest, directions, as_array(self.store["bases"]))
        # Without features, the columns are the inputs along the directions, the same for all Gaussians.
        n, k = len(self.store), directions.shape[1]
        same = np.broadcast_to(np.eye(k, dtype=np.float32), (n, k, k))
        return self.rest.new_zeros(n, k), FeatureDirections(rest, directions, same.copy())

    def _inputs(self, face: FaceParams) -> Float[Tensor, "b k"] | Iterator[Float[Tensor, "f k"]]:
        """The inputs along the directions at each timestep: the same of all Gaussians, or those of each triangle."""
        if self.activations is None:
            return (expression_inputs(face) - self.rest) @ self.directions
        return map(self.activations, (face[timestep] for timestep in range(len(face))))

    def _changes(self, inputs: Iterable[Float[Tensor, "*f k"]], progress: Progress = TRAINED) -> Iterator[Changes]:
        """Colours and opacities at each of some timesteps, with the inputs of `_inputs`."""
        if self._ablation is not None:
            assert isinstance(inputs, Tensor)
            yield from self._ablation.changes(self, inputs, progress)
            return
        first, _, last = self.network
        assert isinstance(first, nn.Linear)
        assert isinstance(last, nn.Linear)
        shares = self._shares_on(last.weight, progress)
        layers = Layers(first.weight, first.bias, last.weight * shares[:, None], last.bias * shares)
        encoding = self.encoding()
        for e in inputs:
            yield Changes(*self.outputs(e, encoding, layers))

    def outputs(
        self, inputs: Float[Tensor, "*f k"], encoding: Float[Tensor, "n c"], layers: Layers
    ) -> tuple[Float[Tensor, "n p"], Float[Tensor, " n"]]:
        """The outputs of a network at one timestep: all but the last, and the last."""
        bases, neutral = self.store["bases"], self.store["neutral_features"]
        rows = None if self.activations is None else self.store["face_index"]
        return feature_network(bases, inputs, rows, neutral, encoding, layers, self.bases_gradient)

    def output_shares(self, progress: Progress) -> Float[Tensor, " o"]:
        """Factors of colours and opacity. Of higher degrees of colours, a share, and 0 before they begin."""
        config = self.config
        shares = torch.ones(colors_of(config) // 3, 3)
        shares[1:] = config.sh_higher_share
        shares[(active_degree(config.sh_degree, config.sh_warmup, progress) + 1) ** 2 :] = 0
        return torch.cat([shares.flatten(), torch.ones(1)])

    def _shares_on(self, like: Tensor, progress: Progress) -> Float[Tensor, " o"]:
        """`output_shares` on the device of `like`, which are copied there once for each degree of colours."""
        config = self.config
        key = active_degree(config.sh_degree, config.sh_warmup, progress), like.device, like.dtype
        if key not in self._shares:
            self._shares[key] = upload(self.output_shares(progress), like)
        return self._shares[key]

    def encoding(self) -> Float[Tensor, "n c"]:
        """The positional encoding of the centres."""
        # Detached by default, so that centres move only by their effect on the picture.
        means = self.store["means"]
        points = (means if self.config.encoding_gradient else means.detach()) / self.config.encoding_length
        return positional_encoding(points, self.config.encoding_bands)


def input_directions(
    face: FaceParams, neutral: FaceParams, count: int
) -> tuple[Float[Tensor, " i"], Float[Tensor, "i k"]]:
    """The inputs where all weights are 0, and the directions along which the bases of features are weighted.

    The inputs are the expression coefficients, followed by the axis-angle vectors of the free joints, in radians. With
    a `count` of 0, they themselves are the weights, as in the paper. Otherwise weights are 0 for the person at rest,
    and at most `count` directions are those of the largest spread over the timesteps of `face`, scaled to a deviation
    of about 1. So one second moment serves the bases of all of them.
    """
    rest, inputs = expression_inputs(neutral)[0].detach(), expression_inputs(face)
    if count == 0:
        return torch.zeros_like(rest), torch.eye(len(rest)).to(rest)
    return rest.clone(), principal_directions(inputs - rest, min(count, len(rest)))


def _stacked(parts: Sequence[Tensor]) -> Tensor:
    # Training poses one timestep at a time, and needs no copy.
    return parts[0][None] if len(parts) == 1 else torch.stack(tuple(parts))


def spread_out(points: Float[Tensor, "t k"], count: int) -> list[int]:
    """Indices of at most `count` points: each is the farthest from those before it, the first from the mean."""
    chosen: list[int] = []
    distances = (points - points.mean(0)).norm(dim=-1)
    while len(chosen) < min(count, len(points)):
        chosen.append(int(distances.argmax()))
        from_it = (points - points[chosen[-1]]).norm(dim=-1)
        distances = from_it if len(chosen) == 1 else torch.minimum(distances, from_it)
    return chosen


def neighbor_distances(points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """Mean distance to the three nearest other points, the initial scale in 3D Gaussian Splatting."""
    nearest = [
        torch.cdist(part, points, compute_mode="donot_use_mm_for_euclid_dist").topk(4, largest=False).values[:, 1:]
        for part in points.split(_CHUNK)
    ]
    return torch.cat(nearest).mean(-1)
