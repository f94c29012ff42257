"""HeadGaS (Dhamo et al., ECCV 2024): Gaussians at rest in the head frame; expressions change colour and opacity.

No code was published, so this is written from the paper, its supplement and its equations. Each Gaussian blends a basis
of latent features by the expression. One small network turns the result into colour and opacity, so that lips fade
where teeth appear. The paper leaves some choices open, which were made here: joints that no expression drives are
appended to the expression vector, because nothing else would move the gaze; the learning rates; the bands and the
length unit of the encoding; and the opacity to prune by. The perceptual loss is not implemented yet.
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from mien.adam import FactoredGradient
from mien.avatar.activation import sigmoid
from mien.avatar.avatar import Avatar, ParameterGroup, Posed, factored_group, network_group, store_group
from mien.avatar.baking import as_array
from mien.avatar.density import GradientDensity
from mien.avatar.encoding import positional_encoding
from mien.avatar.expression_changes import expression_inputs, principal_directions
from mien.avatar.feature_network import Layers, feature_network
from mien.avatar.headgas_settings import HeadGasConfig
from mien.avatar.schedules import TRAINED, Progress, active_degree
from mien.avatar.store import GaussianStore
from mien.face import FaceModel, FaceParams, head_poses
from mien.gaussians import Gaussians
from mien.render.rendering import Rendering
from mien.runtime.baked import AttributeNetwork, Attributes, Static

_CHUNK = 512
_OLD_BASES = "feature_bases"


class HeadGas(Avatar):
    """Static Gaussians in the head frame, with colour and opacity from blended features."""

    config: HeadGasConfig
    rest: Tensor
    directions: Tensor
    judged: Tensor

    def __init__(self, config: HeadGasConfig, face_model: FaceModel, face: FaceParams):
        super().__init__(config, face_model, face)
        n, width = config.points, config.features
        means = sample_surface(face_model.head_vertices(self.subject)[0], face_model.faces, n)
        rest, directions = input_directions(face, self.subject, config.directions)
        self.rest, self.directions = (nn.Buffer(tensor) for tensor in (rest, directions))
        trained = {
            "means": means,
            "quats": means.new_tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
            "log_scales": neighbour_distances(means).clamp_min(1e-6).log()[:, None].repeat(1, 3),
            # The bases start at zero, as in the paper.
            "bases": means.new_zeros(n, directions.shape[1], width),
            "neutral_features": means.new_zeros(n, width),
        }
        spread = spread_out((expression_inputs(face) - rest) @ directions, config.judged_expressions)
        # Not in files: only training needs it, and makes it anew.
        self.judged = nn.Buffer(spread.detach().clone(), persistent=False)
        self.store = GaussianStore(trained)
        self._bases_gradient = FactoredGradient()
        self.network = nn.Sequential(
            nn.Linear(width + 3 + 6 * config.encoding_bands, config.hidden),
            nn.LeakyReLU(0.01),
            nn.Linear(config.hidden, 3 * self._coefficients + 1),
        ).to(means)
        with torch.no_grad():
            # Start grey and faint, like 3D Gaussian Splatting.
            self._last_layer.bias.zero_()
            self._last_layer.bias[-1] = torch.logit(torch.tensor(0.1))

    def pose(self, face: FaceParams, progress: Progress = TRAINED) -> Posed:
        """The Gaussians in the head frame, one batch entry per timestep. Only their colours and opacities differ."""
        store = self.store
        encoding, layers = self._encoding(), self._layers(progress)
        inputs = ((expression_inputs(face) - self.rest) @ self.directions).unbind(0)
        outputs = [
            feature_network(store["bases"], e, store["neutral_features"], encoding, layers, self._bases_gradient)
            for e in inputs
        ]
        colours, opacity_logits = (_stacked(parts) for parts in zip(*outputs, strict=True))
        sh = colours.unflatten(-1, (self._coefficients, 3))
        opacities = sigmoid(opacity_logits)
        gaussians = Gaussians(
            store["means"], store["quats"], store["log_scales"].exp(), opacities, sh, head_poses(face)
        )
        return Posed(gaussians, {})

    def regularizers(self, posed: Posed, rendering: Rendering, progress: Progress) -> dict[str, Float[Tensor, ""]]:
        """This method has no loss terms of its own."""
        return {}

    def parameter_groups(self) -> list[ParameterGroup]:
        """One group per tensor, and one for the network."""
        config = self.config
        rates = {"means": config.means_rate, "log_scales": config.log_scales_rate, "quats": config.quats_rate}
        rates |= {"neutral_features": config.features_rate}
        extent = {"means": config.means_times_extent}
        groups = [
            store_group(self.store, name, rate, times_extent=extent.get(name, False)) for name, rate in rates.items()
        ]
        groups.append(factored_group(self.store, "bases", config.features_rate, self._bases_gradient))
        return [*groups, network_group("network", self.network, config.network_rate)]

    def gaussian_store(self) -> GaussianStore:
        """Every per-Gaussian tensor."""
        return self.store

    def upgraded(self, state: dict[str, Tensor]) -> dict[str, Tensor]:
        """Older versions kept one basis per input and feature [n, f, i], without directions."""
        old = f"store.trained.{_OLD_BASES}"
        if old not in state or state[old].ndim != 3:
            return state
        bases = state[old]
        rest, directions = bases.new_zeros(bases.shape[2]), torch.eye(bases.shape[2]).to(bases)
        kept = {name: tensor for name, tensor in state.items() if name != old}
        return kept | {"store.trained.bases": bases.mT.contiguous(), "rest": rest, "directions": directions}

    def density(self) -> GradientDensity:
        """Gradient-based control. Children copy features. `judged_opacities` says which opacity counts."""
        return GradientDensity(self.config.density, opacity_logits=None, judged_opacities=self.judged_opacities)

    @torch.no_grad()
    def judged_opacities(self, store: GaussianStore, seen: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
        """The highest opacity of each Gaussian at the judged expressions and in the steps since the last round.

        The judged expressions are spread over those of training, so that Gaussians which rare expressions need, such as
        teeth, are not pruned while these are not drawn.
        """
        highest, encoding, layers = seen, self._encoding(), self._layers()
        for inputs in self.judged:
            _, opacity_logits = feature_network(
                store["bases"], inputs, store["neutral_features"], encoding, layers, self._bases_gradient
            )
            highest = torch.maximum(highest, sigmoid(opacity_logits))
        return highest

    def bake(self) -> Static:
        """Static points, with the bases of the features and the network."""
        store = {name: as_array(self.store[name]) for name in self.store.names()}
        layers = self._layers()
        # The directions expand exactly: each input of the face has its own basis.
        bases = torch.einsum("ik,nkf->inf", self.directions, self.store["bases"])
        neutral = self.store["neutral_features"] - torch.einsum("i,inf->nf", self.rest, bases)
        e = self.subject.expression.shape[1]
        network = AttributeNetwork(
            input="features",
            base=np.concatenate([as_array(neutral), as_array(self._encoding())], axis=1),
            basis=as_array(bases[:e]),
            joint_basis=as_array(bases[e:]),
            weights=(as_array(layers.weight1), as_array(layers.weight2)),
            biases=(as_array(layers.bias1), as_array(layers.bias2)),
            activation="leaky_relu",
            outputs=("sh", "opacity_logits"),
        )
        n = len(self.store)
        none, no_sh = np.zeros(n, np.float32), np.zeros((n, self._coefficients, 3), np.float32)
        attributes = Attributes(store["quats"], store["log_scales"], none, no_sh)
        names, free = self.face_model.expression_names, self.face_model.free_joint_names
        return Static(store["means"], attributes, names, free, network=network)

    @property
    def _coefficients(self) -> int:
        return (self.config.sh_degree + 1) ** 2

    @property
    def _last_layer(self) -> nn.Linear:
        last = self.network[-1]
        assert isinstance(last, nn.Linear)
        return last

    def _layers(self, progress: Progress = TRAINED) -> Layers:
        first, last = self.network[0], self._last_layer
        assert isinstance(first, nn.Linear)
        shares = self._output_shares(progress).to(last.weight)
        return Layers(first.weight, first.bias, last.weight * shares[:, None], last.bias * shares)

    def _output_shares(self, progress: Progress) -> Float[Tensor, " o"]:
        """Factors of the network's outputs: of the colours' higher degrees, a share, and 0 before they begin."""
        config = self.config
        shares = torch.ones(self._coefficients, 3)
        shares[1:] = config.sh_higher_share
        shares[(active_degree(config.sh_degree, config.sh_warmup, progress) + 1) ** 2 :] = 0
        return torch.cat([shares.flatten(), torch.ones(1)])

    def _encoding(self) -> Float[Tensor, "n c"]:
        # Detached, so that centres move only by their effect on the picture, not through the encoding of their
        # position.
        points = self.store["means"].detach() / self.config.encoding_length
        return positional_encoding(points, self.config.encoding_bands)


def input_directions(
    face: FaceParams, neutral: FaceParams, count: int
) -> tuple[Float[Tensor, " i"], Float[Tensor, "i k"]]:
    """The inputs of the person at rest, and the directions along which the bases of features are weighted.

    The inputs are the expression coefficients, followed by the axis-angle vectors of the free joints, in radians. The
    directions are those of the largest spread over the timesteps of `face`, at most `count` (0: as many as inputs),
    scaled to a deviation of about 1. So one second moment serves the bases of all of them.
    """
    rest, inputs = expression_inputs(neutral)[0].detach(), expression_inputs(face)
    directions, _ = principal_directions(inputs - rest, min(count or len(rest), len(rest)))
    return rest.clone(), directions


def _stacked(parts: Sequence[Tensor]) -> Tensor:
    # Training poses one timestep at a time, and needs no copy.
    return parts[0][None] if len(parts) == 1 else torch.stack(tuple(parts))


def spread_out(points: Float[Tensor, "t k"], count: int) -> Float[Tensor, "c k"]:
    """At most `count` of the points: each is the farthest from those before it, the first from the mean."""
    chosen: list[int] = []
    distances = (points - points.mean(0)).norm(dim=-1)
    while len(chosen) < min(count, len(points)):
        chosen.append(int(distances.argmax()))
        from_it = (points - points[chosen[-1]]).norm(dim=-1)
        distances = from_it if len(chosen) == 1 else torch.minimum(distances, from_it)
    return points[chosen]


def sample_surface(vertices: Float[Tensor, "v 3"], faces: Tensor, count: int) -> Float[Tensor, "n 3"]:
    """Random points on a mesh, uniform by area, from torch's default generator."""
    corners = vertices[faces]
    v0, v1, v2 = corners.unbind(1)
    areas = torch.linalg.cross(v1 - v0, v2 - v0).norm(dim=-1)
    chosen = torch.multinomial(areas, count, replacement=True)
    # The square root makes the points uniform over a triangle.
    along, across = torch.rand(2, count, 1).to(vertices)
    along = along.sqrt()
    weights = torch.cat([1 - along, along * (1 - across), along * across], dim=-1)
    return (weights[:, :, None] * corners[chosen]).sum(1)


def neighbour_distances(points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """Mean distance to the three nearest other points, the initial scale in 3D Gaussian Splatting."""
    nearest = [
        torch.cdist(part, points, compute_mode="donot_use_mm_for_euclid_dist").topk(4, largest=False).values[:, 1:]
        for part in points.split(_CHUNK)
    ]
    return torch.cat(nearest).mean(-1)
