"""Density control: when and where Gaussians are added and removed. Each strategy is one file, which tells its loop.

| a method's `density()` returns | strategy |
|---|---|
| `GradientDensity` | `gradient.py`: duplicates, splits and prunes Gaussians, and resets opacities |
| `RefillDensity` | `refill.py`: prunes Gaussians that no view has shown, then refills up to a target |
| None | none: the number of Gaussians never changes |

Strategies see a `GaussianStore`, the posed Gaussians, the rendering, and the method's hooks (`mien.avatar.density`),
but never the method. They keep statistics with one entry per Gaussian, which checkpoints save.
"""
