"""Features for the perceptual loss: the first blocks of a VGG16 with anti-aliased pooling, trained with ST-LPIPS."""

from collections.abc import Sequence
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import conv2d

from mien.perceptual import build_from_weights

MAX_BLOCKS = 3
"""Number of the network's blocks that can be used. Deeper ones see too much of a small crop, and cost more."""
_LAYERS = ((0, 2), (6, 8), (12, 14, 16))
"""Numbers of each block's convolutions in the file of weights."""


class TrainingFeatures(nn.Module):
    """Distance between two small pictures by the first blocks of a VGG16, differentiable in the first one.

    As in LPIPS (Zhang et al. 2018, section 3), the last feature map of each block is normalised to unit length at each
    pixel. The squared differences are weighted by trained factors per channel, averaged over the picture, and summed.
    """

    shift: Tensor
    scale: Tensor

    def __init__(self, state: dict[str, Tensor], blocks: int) -> None:
        super().__init__()
        assert 1 <= blocks <= MAX_BLOCKS, blocks
        self.blocks = _LAYERS[:blocks]
        self.register_buffer("shift", state["scaling_layer.shift"].clone())
        self.register_buffer("scale", state["scaling_layer.scale"].clone())
        for number, block in enumerate(self.blocks):
            self.register_buffer(f"channel_weights{number}", state[f"lin{number}.model.1.weight"][0].clone())
            for layer in block:
                for kind in ("weight", "bias"):
                    values = state[f"net.slice{number + 1}.{layer}.{kind}"].clone()
                    self.register_buffer(f"{kind}{layer}", values)

    def features(self, image: Float[Tensor, "h w 3"]) -> list[Float[Tensor, "1 c y x"]]:
        """The feature maps of an image in 0..1: one for each block, of unit length at each pixel."""
        values = ((image.permute(2, 0, 1)[None] * 2 - 1) - self.shift) / self.scale
        maps: list[Tensor] = []
        for number, block in enumerate(self.blocks):
            if number > 0:
                values = _pool(values)
            for layer in block:
                values = conv2d(values, getattr(self, f"weight{layer}"), getattr(self, f"bias{layer}"), padding=1)
                values = values.relu()
            maps.append(values / (values.square().sum(1, keepdim=True) + 1e-10).sqrt())
        return maps

    def forward(self, image: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"]) -> Float[Tensor, ""]:
        """The distance between two images in 0..1, at least 0. There is no gradient in `target`."""
        with torch.no_grad():
            wanted = self.features(target)
        return self.distance(image, wanted)

    def distance(self, image: Float[Tensor, "h w 3"], wanted: Sequence[Float[Tensor, "1 _ _ _"]]) -> Float[Tensor, ""]:
        """The distance of an image (0..1) from another one, given the other's `features`. It is at least 0."""
        total = image.new_zeros(())
        for number, (found, goal) in enumerate(zip(self.features(image), wanted, strict=True)):
            squared = (found - goal).square() * getattr(self, f"channel_weights{number}")
            total = total + squared.sum(1).mean()
        return total


def _pool(values: Float[Tensor, "1 c h w"]) -> Float[Tensor, "1 c y x"]:
    """The maximum over 2x2 at every pixel, then a blur by (1, 2, 1) / 4 in both directions, at every second pixel."""
    rows = torch.maximum(values[:, :, :-1], values[:, :, 1:])
    largest = torch.maximum(rows[..., :-1], rows[..., 1:])
    down = (largest[:, :, :-2:2] + 2 * largest[:, :, 1:-1:2] + largest[:, :, 2::2]) / 4
    return (down[..., :-2:2] + 2 * down[..., 1:-1:2] + down[..., 2::2]) / 4


@lru_cache(maxsize=2)
def load_training_features(
    device: str = "cpu", dtype: torch.dtype = torch.float32, blocks: int = 2
) -> TrainingFeatures:
    """The features, ready for use on a device."""
    built = build_from_weights("st-lpips-vgg", lambda state: TrainingFeatures(state, blocks))
    return built.eval().requires_grad_(False).to(device, dtype)
