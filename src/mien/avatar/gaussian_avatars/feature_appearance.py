"""HeadGaS' appearance on Gaussians that follow a mesh: changes of colour and opacity from blended features.

Each Gaussian has neutral features and one set of features per activation of the face (`ExpressionActivations`). One
small network turns their weighted sum, and the place of the Gaussian's triangle on the person at rest, into changes of
the first SH coefficient and of the raw opacity. Not part of either paper: HeadGaS' Gaussians do not move.
"""

from jaxtyping import Float, Int
from torch import Tensor, nn

from mien.adam import FactoredGradient
from mien.avatar.avatar import ParameterGroup, factored_group, network_group, store_group
from mien.avatar.baking import as_array
from mien.avatar.encoding import positional_encoding
from mien.avatar.gaussian_avatars.constants import GAUSSIAN_AVATARS
from mien.avatar.ops.feature_network import Layers, feature_network
from mien.avatar.schedules import Rate
from mien.avatar.store import GaussianStore
from mien.runtime.baked import FeatureChanges


class FeatureAppearance(nn.Module):
    """The network, and the places of the triangles. The features themselves are in the avatar's store."""

    places: Tensor

    def __init__(self, vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"], features: int, hidden: int):
        """Start without any change. `vertices` are those of the person at rest in the head frame, in metres."""
        super().__init__()
        middles = vertices[faces.long()].mean(1).detach()
        places = positional_encoding(middles / GAUSSIAN_AVATARS.feature_length, GAUSSIAN_AVATARS.feature_bands)
        # Not in files: it follows from the face model and the person.
        self.register_buffer("places", places, persistent=False)
        self.first = nn.Linear(features + places.shape[1], hidden).to(places)
        self.last = nn.Linear(hidden, 4).to(places)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)
        self._gradient = FactoredGradient()

    def forward(
        self, store: GaussianStore, activations: Float[Tensor, " r"]
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, " n"]]:
        """Changes of the first SH coefficients and of the raw opacities. Differentiable; native on a CPU."""
        bases, neutral = store["feature_bases"], store["neutral_features"]
        return feature_network(bases, activations, neutral, self._own(store), self._layers(), self._gradient)

    def parameter_groups(self, store: GaussianStore, rate: Rate, network_rate: Rate) -> list[ParameterGroup]:
        """The groups of the features and of the network."""
        return [
            store_group(store, "neutral_features", rate),
            factored_group(store, "feature_bases", rate, self._gradient),
            network_group("appearance", self, network_rate),
        ]

    def bake(self, store: GaussianStore) -> FeatureChanges:
        """The features and the network as arrays."""
        layers = self._layers()
        return FeatureChanges(
            neutral=as_array(store["neutral_features"]),
            basis=as_array(store["feature_bases"]),
            own=as_array(self._own(store)),
            weights=(as_array(layers.weight1), as_array(layers.weight2)),
            biases=(as_array(layers.bias1), as_array(layers.bias2)),
        )

    def _own(self, store: GaussianStore) -> Float[Tensor, "n x"]:
        return self.places[store["face_index"]]

    def _layers(self) -> Layers:
        return Layers(self.first.weight, self.first.bias, self.last.weight, self.last.bias)


def feature_tensors(like: Float[Tensor, "n _"], rank: int, features: int) -> dict[str, Tensor]:
    """The features of n Gaussians before training, by their names in the store."""
    n = len(like)
    return {"feature_bases": like.new_zeros(n, rank, features), "neutral_features": like.new_zeros(n, features)}
