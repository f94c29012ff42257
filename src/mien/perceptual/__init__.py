"""Trained features of pictures: ST-LPIPS, which scores pictures, and the features of another trunk, for training.

What is scored is never trained: the distance of the scores uses an AlexNet, the loss of training a VGG.
The trained weights are read from the installed package `stlpips-pytorch`, whose own code is never imported.
"""

import importlib.util
from collections.abc import Callable
from pathlib import Path
from pickle import UnpicklingError
from typing import Literal, TypeVar

import torch
from torch import Tensor

from mien.errors import UserError

Backbone = Literal["st-lpips-alex"]
"""Names of the metric's backbones, as written into metrics.json."""

_WEIGHTS = {
    "st-lpips-alex": "weights/vST0.0/alex_shift_tolerant.pth",
    "st-lpips-vgg": "weights/vST0.0/vgg_shift_tolerant.pth",
}
PACKAGE = "stlpips_pytorch"
Built = TypeVar("Built")


def build_from_weights(name: str, build: Callable[[dict[str, Tensor]], Built]) -> Built:
    """Call `build` with the trained tensors of a backbone, by name."""
    path = weights_path(name)
    try:
        return build(torch.load(path, map_location="cpu", weights_only=True))
    except FileNotFoundError:
        raise UserError(f"{path}: missing; reinstall it with: pip install stlpips-pytorch==0.0.2") from None
    except (KeyError, EOFError, OSError, RuntimeError, ValueError, UnpicklingError) as error:
        reason = str(error).splitlines()[0]
        raise UserError(f"{path}: damaged weights ({reason}); reinstall stlpips-pytorch==0.0.2") from None


def weights_path(name: str) -> Path:
    """The path of a backbone's weights in the installed package, which is found without importing it."""
    spec = importlib.util.find_spec(PACKAGE)
    folders = spec.submodule_search_locations if spec is not None else None
    if not folders:
        raise UserError("no perceptual weights: install them with: pip install stlpips-pytorch==0.0.2")
    return Path(folders[0]) / _WEIGHTS[name]
