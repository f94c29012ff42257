"""Observers of the progress of a fit."""

from collections.abc import Callable
from typing import Protocol, runtime_checkable


@runtime_checkable  # Beartype needs this to check annotations during tests.
class Watch(Protocol):
    """Receives the progress of a running fit."""

    def __call__(self, stage: str, progress: float, look: Callable[[], object] | None = None) -> None:
        """Receive the stage that runs, the share of its work that is done, and, if the fit changed, a way to get it.

        `look` returns a `Fit` or a `PhotometricFit`. It may be called later, or never.
        """
        ...


def nobody(stage: str, progress: float, look: Callable[[], object] | None = None) -> None:
    """Ignore the progress. This is the `Watch` of a fit that nobody watches."""
