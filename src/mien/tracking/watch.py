"""Who wants to see how far a fit has come."""

from collections.abc import Callable
from typing import Protocol, runtime_checkable


@runtime_checkable  # for beartype, which checks annotations during tests
class Watch(Protocol):
    """Is told of a fit on its way."""

    def __call__(self, stage: str, progress: float, look: Callable[[], object] | None = None) -> None:
        """The stage that runs, which part of its work is done, and, if the fit changed, what gives it as it is now.

        `look` returns a `Fit` or a `PhotometricFit`, and may be called later, or never.
        """
        ...


def nobody(stage: str, progress: float, look: Callable[[], object] | None = None) -> None:
    """Does not want to see it."""
