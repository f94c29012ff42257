"""LPIPS (Zhang et al. 2018), version 0.1, exactly as papers report it, from files that its user has.

The trained trunk (torchvision's AlexNet or VGG16, trained on ImageNet) is the file that --lpips-weights names; mien may
not contain it. The trained factors of the channels are in the package `lpips`, whose own code is never imported.
"""

import importlib.util
import io
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from pickle import UnpicklingError

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import conv2d, max_pool2d

from mien.disk.files import file_digest
from mien.disk.reading import read_bytes
from mien.errors import UserError

_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
_PACKAGE, _INSTALL = "lpips", "pip install --no-deps lpips==0.1.4"
_MAX_BYTES = 1 << 30
"""Limit of a file of weights, in bytes. VGG16 has 553 MB."""


@dataclass(frozen=True)
class _Trunk:
    backbone: str
    """Name, as written into metrics.json."""
    file: str
    """Torchvision's file, for messages."""
    sha256: str
    """The first digits of its hash, which its name holds."""
    heads: str
    """File of the factors in the package."""
    blocks: tuple[tuple[tuple[int, int, int], ...], ...]
    """Number, stride and padding of each convolution of each block. A block's last map is compared."""
    pool: int
    """Side of the pooling between blocks, whose stride is 2."""


TRUNKS = (
    _Trunk(
        "lpips-alex", "alexnet-owt-7be5be79.pth", "7be5be79", "weights/v0.1/alex.pth",
        (((0, 4, 2),), ((3, 1, 2),), ((6, 1, 1),), ((8, 1, 1),), ((10, 1, 1),)), 3,
    ),
    _Trunk(
        "lpips-vgg", "vgg16-397923af.pth", "397923af", "weights/v0.1/vgg.pth",
        tuple(tuple((n, 1, 1) for n in block) for block in ((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28))),
        2,
    ),
)  # fmt: skip
_POOLED = {"lpips-alex": (1, 2), "lpips-vgg": (1, 2, 3, 4)}
"""Blocks that begin with a pooling."""


class Lpips:
    """LPIPS between pictures. 0 for equal ones. It has the methods of `PerceptualDistance`."""

    def __init__(self, trunk: _Trunk, weights: dict[str, Tensor], heads: dict[str, Tensor]) -> None:
        self.backbone = trunk.backbone
        self._pool, self._pooled = trunk.pool, _POOLED[trunk.backbone]
        self._blocks = [
            [(weights[f"features.{n}.weight"].float(), weights[f"features.{n}.bias"].float(), stride, padding)
             for n, stride, padding in block]
            for block in trunk.blocks
        ]  # fmt: skip
        self._heads = [heads[f"lin{index}.model.1.weight"].float()[0, :, 0, 0] for index in range(len(self._blocks))]
        if any(len(head) != len(block[-1][1]) for head, block in zip(self._heads, self._blocks, strict=True)):
            raise ValueError("trunk and factors have different channels")

    @torch.no_grad()
    def features(self, image: Float[Tensor, "h w 3"]) -> list[Float[Tensor, "c y x"]]:
        """Five feature maps of an image in 0..1, of unit length at each pixel, to be compared by `between`."""
        shift, scale = (image.new_tensor(values)[:, None, None] for values in (_SHIFT, _SCALE))
        values = ((image.permute(2, 0, 1) * 2 - 1 - shift) / scale)[None]
        maps = []
        for index, block in enumerate(self._blocks):
            if index in self._pooled:
                values = max_pool2d(values, self._pool, 2)
            for weight, bias, stride, padding in block:
                values = conv2d(values, weight, bias, stride=stride, padding=padding).relu()
            maps.append((values / (torch.linalg.vector_norm(values, dim=1, keepdim=True) + 1e-10))[0])
        return maps

    def between(self, first: list[Float[Tensor, "_ _ _"]], second: list[Float[Tensor, "_ _ _"]]) -> float:
        """The distance between two pictures of the same size, given their `features`."""
        pairs = zip(self._heads, first, second, strict=True)
        return sum(float((head[:, None, None] * (a - b).square()).sum(0).mean()) for head, a, b in pairs)


@lru_cache(maxsize=1)
def load_lpips(path: Path) -> Lpips:
    """LPIPS by the trunk in torchvision's file."""
    known = " or ".join(trunk.file for trunk in TRUNKS)
    if not path.is_file():
        raise UserError(f"--lpips-weights {path}: no such file; give torchvision's {known}")
    digest = file_digest(path)
    trunk = next((each for each in TRUNKS if digest.startswith(each.sha256)), None)
    if trunk is None:
        raise UserError(f"--lpips-weights {path}: is not the file that torchvision published; give {known}")
    return build_lpips(trunk, path, _heads(trunk))


def build_lpips(trunk: _Trunk, path: Path, heads: Path) -> Lpips:
    """LPIPS from two files."""
    try:
        loaded = [
            torch.load(io.BytesIO(read_bytes(file, _MAX_BYTES)), map_location="cpu", weights_only=True)
            for file in (path, heads)
        ]
        return Lpips(trunk, *loaded)
    except (KeyError, EOFError, OSError, RuntimeError, TypeError, ValueError, IndexError, UnpicklingError) as error:
        reason = " ".join(str(error).split())[:200]
        raise UserError(f"{path}: damaged weights ({reason}); download it and {_INSTALL} again") from None


def _heads(trunk: _Trunk) -> Path:
    spec = importlib.util.find_spec(_PACKAGE)
    folders = spec.submodule_search_locations if spec is not None else None
    if not folders or not (Path(folders[0]) / trunk.heads).is_file():
        raise UserError(f"LPIPS needs its trained factors, 10 kB: {_INSTALL}")
    return Path(folders[0]) / trunk.heads
