"""Convert what was read to values that can be compared and searched."""

from dataclasses import fields, is_dataclass
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
from torch import Tensor, nn


def content_of(value: Any) -> Any:
    """Return a value in a form that can be compared."""
    if isinstance(value, nn.Module):
        return content_of(dict(value.state_dict()))
    if isinstance(value, Tensor):
        return content_of(value.detach().numpy())
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if is_dataclass(value):
        return {field.name: content_of(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, dict):
        return {name: content_of(item) for name, item in value.items()}
    return [content_of(item) for item in value] if isinstance(value, (tuple, list)) else value


_MAY_BE_NAN = frozenset({"landmarks", "residuals", "pixel_residuals", "sharpness", "brightness", "clipped", "quality",
                         "timestamps", "source", "settings"})  # fmt: skip
"""Names of values that may be NaN, because a face was not found or the value is only shown."""


def expect_finite(root: Path, found: Any, dice: Random, name: str = "") -> None:
    """Check that all numbers in a value are finite, except for those where NaN means that something is unknown."""
    if isinstance(found, nn.Module):
        found = dict(found.state_dict())
    if isinstance(found, Tensor):
        found = found.detach().numpy()
    if is_dataclass(found) and not isinstance(found, type):
        found = {field.name: getattr(found, field.name) for field in fields(found)}
    if name in _MAY_BE_NAN:
        return
    if isinstance(found, (float, np.ndarray)):
        assert not isinstance(found, np.ndarray) or found.dtype.kind in "fiub", found.dtype
        assert np.isfinite(found).all(), f"{name} holds numbers that are not finite"
    for key, item in found.items() if isinstance(found, dict) else ():
        expect_finite(root, item, dice, str(key))
    for item in found if isinstance(found, (tuple, list)) else ():
        expect_finite(root, item, dice, name)
