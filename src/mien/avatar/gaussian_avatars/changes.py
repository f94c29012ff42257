"""The changes of Gaussians with the expression beside those of the mesh, and what holds them back.

HeadGaS' appearance on Gaussians that follow a mesh: each has neutral features and one set of features per activation of
the face (`ExpressionActivations`). One small network turns their weighted sum into changes of the first SH coefficient
and of the raw opacity. Not part of either paper: HeadGaS' Gaussians do not move, and its network also reads their
places. The network has no biases, so a Gaussian whose features are 0 does not change: what no picture trains stays as
it is.
"""

from jaxtyping import Float
from torch import Tensor, nn

from mien.adam import FactoredGradient
from mien.avatar.avatar import ParameterGroup, factored_group, network_group, store_group
from mien.avatar.baking import as_array
from mien.avatar.ops.feature_network import Layers
from mien.avatar.settings import Rate
from mien.avatar.store import GaussianStore
from mien.runtime.baked import FeatureChanges

APPEARANCE_WEIGHT = 0.1  # weight of the mean squared changes of colour and opacity by features
_OUTPUTS = 4  # three changes of colour, and one of opacity
_HIDDEN = 32  # width of the only hidden layer
_RATE = Rate(2.5e-3)  # learning rate of the features
_NETWORK_RATE = Rate(2e-3, 2e-4)


class FeatureAppearance(nn.Module):
    """The network. The features are in the avatar's store."""

    no_bias1: Tensor
    no_bias2: Tensor

    def __init__(self, like: Tensor, features: int):
        """Random weights of the dtype and device of `like`. Features of 0 mean that nothing changes at first."""
        super().__init__()
        self.first = nn.Linear(features, _HIDDEN, bias=False).to(like)
        self.last = nn.Linear(_HIDDEN, _OUTPUTS, bias=False).to(like)
        self.register_buffer("no_bias1", like.new_zeros(_HIDDEN), persistent=False)
        self.register_buffer("no_bias2", like.new_zeros(_OUTPUTS), persistent=False)
        self.gradient = FactoredGradient()

    def parameter_groups(self, store: GaussianStore) -> list[ParameterGroup]:
        """The groups of the features and of the network."""
        return [
            store_group(store, "neutral_features", _RATE),
            factored_group(store, "feature_bases", _RATE, self.gradient),
            network_group("appearance", self, _NETWORK_RATE),
        ]

    def bake(self, store: GaussianStore) -> FeatureChanges:
        """The features and the network as arrays."""
        layers = self.layers()
        return FeatureChanges(
            neutral=as_array(store["neutral_features"]),
            basis=as_array(store["feature_bases"]),
            own=as_array(store["neutral_features"][:, :0]),
            weights=(as_array(layers.weight1), as_array(layers.weight2)),
            biases=(as_array(layers.bias1), as_array(layers.bias2)),
        )

    def layers(self) -> Layers:
        """The weights of the network."""
        return Layers(self.first.weight, self.no_bias1, self.last.weight, self.no_bias2)


def feature_tensors(like: Float[Tensor, "n _"], rank: int, features: int) -> dict[str, Tensor]:
    """The features of n Gaussians before training, by their names in the store."""
    n = len(like)
    return {"feature_bases": like.new_zeros(n, rank, features), "neutral_features": like.new_zeros(n, features)}
