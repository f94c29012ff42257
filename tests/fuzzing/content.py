"""Convert what was read to values that can be compared and searched."""

from dataclasses import fields, is_dataclass
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


def expect_finite(value: Any, path: str = "") -> None:
    """Check that all numbers in a value are finite, except for those where NaN means that something is unknown."""
    if path.rpartition(".")[2] in _MAY_BE_NAN:
        return
    if isinstance(value, nn.Module):
        value = dict(value.state_dict())
    if isinstance(value, Tensor):
        value = value.detach().numpy()
    if isinstance(value, np.ndarray):
        assert value.dtype.kind != "f" or np.isfinite(value).all(), f"{path} holds numbers that are not finite"
    elif isinstance(value, float):
        assert np.isfinite(value), f"{path} is {value}"
    elif is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            expect_finite(getattr(value, field.name), f"{path}.{field.name}")
    elif isinstance(value, dict):
        for name, item in value.items():
            expect_finite(item, f"{path}.{name}")
    elif isinstance(value, (tuple, list)):
        for item in value:
            expect_finite(item, path)


_MAY_BE_NAN = frozenset(
    {
        "landmarks",
        "residuals",
        "pixel_residuals",
        "sharpness",
        "brightness",
        "clipped",
        "quality",
        "timestamps",
        "source",
        "settings",
    }
)
"""Names of values that may be NaN, because a face was not found or the value is only shown."""
