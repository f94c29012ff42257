"""ST-LPIPS: a learned perceptual distance (Ghildyal and Liu, ECCV 2022), with the weights that a package ships.

Only the trained numbers of `stlpips-pytorch` are read. The network is written here, from the paper's description and
the shapes in that file. The package's own code needs torchvision and is never imported.
"""

from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mien.perceptual import Backbone, build_from_weights

_BLUR = torch.tensor([[1.0, 2.0, 1.0], [2.0, 4.0, 2.0], [1.0, 2.0, 1.0]])[None, None] / 16
_STRIP = 16
MIN_SIDE = 32
"""Smallest side of a picture in pixels. Smaller pictures have no features left in the deepest layers."""


class PerceptualDistance(nn.Module):
    """Distance between pictures by the features of a trained, anti-aliased AlexNet. 0 for equal ones, often below 1.

    Five feature maps are normalised to unit length at each pixel. Their squared differences are weighted by trained
    factors per channel, averaged over the picture, and summed, as in LPIPS. ST-LPIPS has stride 1 in the first
    convolution and replaces every stride by a blur and a subsampling, so that a shift of a few pixels costs little.
    """

    shift: Tensor
    scale: Tensor
    weight0: Tensor
    bias0: Tensor

    def __init__(self, state: dict[str, Tensor]) -> None:
        super().__init__()
        self.register_buffer("shift", state["scaling_layer.shift"])
        self.register_buffer("scale", state["scaling_layer.scale"])
        names = ("net.slice1.0", "net.slice2.5", "net.slice3.9", "net.slice4.11", "net.slice5.13")
        for index, name in enumerate(names):
            self.register_buffer(f"weight{index}", state[f"{name}.weight"])
            self.register_buffer(f"bias{index}", state[f"{name}.bias"])
            self.register_buffer(f"channel_weights{index}", state[f"lin{index}.model.1.weight"][0, :, 0, 0])

    def features(self, image: Float[Tensor, "h w 3"]) -> list[Float[Tensor, "c y x"]]:
        """Five feature maps of an image in 0..1, of unit length at each pixel, to be compared by `between`."""
        assert min(image.shape[:2]) >= MIN_SIDE, f"{tuple(image.shape)} is too small to compare"
        values = ((image.permute(2, 0, 1)[None] * 2 - 1) - self.shift) / self.scale
        # Work in place if possible, because large new buffers cost as much as the arithmetic on them.
        maps = [self.first_map(values).relu_()]
        maps.append(self.convolve(1, _pool(maps[-1]), padding=2).relu_())
        maps.append(self.convolve(2, _pool(maps[-1]), padding=1).relu_())
        maps.append(self.convolve(3, maps[-1], padding=1).relu_())
        maps.append(self.convolve(4, maps[-1], padding=1).relu_())
        return [m.div_(torch.linalg.vector_norm(m, dim=1, keepdim=True).add_(1e-10))[0] for m in maps]

    def between(self, first: list[Float[Tensor, "_ _ _"]], second: list[Float[Tensor, "_ _ _"]]) -> float:
        """The distance between two pictures of the same size, given their `features`."""
        total = 0.0
        for index, (a, b) in enumerate(zip(first, second, strict=True)):
            weights = getattr(self, f"channel_weights{index}")
            total += float(torch.einsum("c,cyx->", weights, (a - b).square_()) / a[0].numel())
        return total

    @torch.no_grad()
    def forward(self, image: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"]) -> float:
        """The distance between two images in 0..1."""
        return self.between(self.features(image), self.features(target))

    def first_map(self, values: Float[Tensor, "1 3 h w"]) -> Float[Tensor, "1 c y x"]:
        """`halve` of the first convolution at a fifth of its cost: inside the picture, both are one convolution.

        Mirroring at the border is not a convolution. At the top and left it repeats the next sample. At the bottom and
        right, the two steps are done one after the other on narrow strips.
        """

        def stepwise(strip: Tensor) -> Tensor:
            return halve(self.convolve(0, strip, padding=2))

        weight = torch.nn.functional.conv2d(self.weight0.flatten(0, 1)[:, None], _BLUR.to(values), padding=2)
        weight = weight.reshape(*self.weight0.shape[:2], *weight.shape[-2:])
        inside = torch.nn.functional.conv2d(values, weight, self.bias0, stride=2, padding=2)
        height, width = (_STRIP + size % 2 for size in values.shape[2:])
        right = stepwise(values[..., -width:])[:, :, 1:-1, -1:]
        middle = torch.cat([inside[..., :1], inside, right], dim=3)
        return torch.cat([middle[:, :, :1], middle, stepwise(values[:, :, -height:])[:, :, -1:]], dim=2)

    def convolve(self, index: int, values: Tensor, padding: int) -> Tensor:
        """Apply a convolution of the network."""
        weight, bias = getattr(self, f"weight{index}"), getattr(self, f"bias{index}")
        return torch.nn.functional.conv2d(values, weight, bias, padding=padding)


def halve(values: Float[Tensor, "1 c h w"]) -> Float[Tensor, "1 c y x"]:
    """Blur by (1, 2, 1) / 4 in both directions and keep every second sample. The border is mirrored by two samples."""
    channels = values.shape[1]
    kernel = _BLUR.to(values).expand(channels, 1, 3, 3)
    padded = torch.nn.functional.pad(values, (2, 2, 2, 2), mode="reflect")
    return torch.nn.functional.conv2d(padded, kernel, stride=2, groups=channels)


def _pool(values: Float[Tensor, "1 c h w"]) -> Float[Tensor, "1 c y x"]:
    """Anti-aliased pooling: the maximum over 3x3 at every pixel, then `halve`."""
    # This is five times as fast as max_pool2d with stride 1 on a CPU.
    rows = torch.maximum(values[:, :, :-2], values[:, :, 1:-1])
    torch.maximum(rows, values[:, :, 2:], out=rows)
    largest = torch.maximum(rows[..., :-2], rows[..., 1:-1])
    return halve(torch.maximum(largest, rows[..., 2:], out=largest))


@lru_cache(maxsize=1)
def load_perceptual(backbone: Backbone = "st-lpips-alex") -> PerceptualDistance:
    """The trained distance, ready for use on the CPU (10 MB)."""
    return build_from_weights(backbone, PerceptualDistance).eval().requires_grad_(False)
