"""Density control: when and where Gaussians are added and removed. Each strategy is one file, which tells its loop.

| a method's `density()` returns | strategy |
|---|---|
| `GradientDensity` | `gradient.py`: duplicates, splits and prunes Gaussians, and resets opacities |
| `RefillDensity` | `refill.py`: prunes Gaussians that no view has shown, then refills up to a target |
| None | none: the number of Gaussians never changes |

Strategies see a `GaussianStore`, the posed Gaussians, the rendering, and the method's hooks (`mien.avatar.density`),
but never the method. They keep statistics with one entry per Gaussian, which checkpoints save.
"""

from mien.avatar.density import DensityControl, GradientDensity, RefillDensity
from mien.avatar.store import GaussianStore
from mien.training.density_control.gradient import GradientStrategy
from mien.training.density_control.refill import RefillStrategy
from mien.training.density_control.strategy import DensityStrategy

__all__ = ["DensityStrategy", "GradientStrategy", "RefillStrategy", "density_strategy"]


def density_strategy(density: DensityControl, store: GaussianStore) -> DensityStrategy | None:
    """The strategy that a method's description asks for."""
    if isinstance(density, GradientDensity):
        return GradientStrategy(density, len(store), store[store.names()[0]].device)
    if isinstance(density, RefillDensity):
        return RefillStrategy(density, len(store), store[store.names()[0]].device)
    return None
