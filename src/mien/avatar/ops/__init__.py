"""Operations on Gaussians that have a native form: each takes plain tensors and has a reference in plain PyTorch."""

from typing import Protocol, runtime_checkable

from torch import Tensor


@runtime_checkable
class Tensors(Protocol):
    """Tensors by name: those of a store, or of a dict."""

    def __getitem__(self, name: str, /) -> Tensor:
        """One of them."""
        ...
