"""The fit to pixels: the texture and light of a head, and the steps that make all pictures agree with them."""

from mien.tracking.pixels.comparison import model_pictures, window_of
from mien.tracking.pixels.outcome import looks_of, with_pixels
from mien.tracking.pixels.pictures import Pictures
from mien.tracking.pixels.refine import refine_photometrically
from mien.tracking.pixels.texture import Appearance, PhotometricFit, even_light, texture_space

__all__ = [
    "Appearance",
    "PhotometricFit",
    "Pictures",
    "even_light",
    "looks_of",
    "model_pictures",
    "refine_photometrically",
    "texture_space",
    "window_of",
    "with_pixels",
]
