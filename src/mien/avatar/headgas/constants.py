"""Numbers that decide what this method's avatars look like and that no setting changes, with how each was chosen."""

from dataclasses import dataclass


@dataclass(frozen=True)
class HeadGasConstants:
    """The constants of this room, by the file that uses them. `benchmarks/ablate.py` measures what one is worth."""

    # avatar.py
    color_rate: float = 2.5e-3
    """Learning rate of colours against which that of opacities in the same tensor is measured. Of 3D Gaussian
    Splatting."""

    # avatar.py, variants.py
    shift_length: float = 0.01
    """Unit of the network's shifts, in metres. The papers do not say one. Not varied."""
    start_opacity: float = 0.1
    """Opacity of all Gaussians at the start. Of 3D Gaussian Splatting."""
    opacity_rate: float = 0.05
    """Learning rate of opacities that Gaussians have themselves. Of 3D Gaussian Splatting."""


HEADGAS = HeadGasConstants()
