"""The paper's schedule: gradient descent over frames in random order."""

from mien.tracking.descent.schedule import fit_by_descent, follow_by_descent

__all__ = [
    "fit_by_descent",
    "follow_by_descent",
]
