"""mien: video of a head in, an animatable avatar of 3D Gaussians out."""

__version__ = "0.1.0"
