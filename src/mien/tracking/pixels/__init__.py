"""The fit to pixels: the texture and light of a head, and the steps that make all pictures agree with them."""

from mien.tracking.pixels.comparison import model_pictures, window_of
from mien.tracking.pixels.outcome import appearance_of, turn_light, with_pixels
from mien.tracking.pixels.pictures import Pictures
from mien.tracking.pixels.refine import follow_photometrically, refine_photometrically
from mien.tracking.pixels.texture import PhotometricFit, SkinTexture, even_light, texture_space

__all__ = [
    "PhotometricFit",
    "Pictures",
    "SkinTexture",
    "appearance_of",
    "even_light",
    "follow_photometrically",
    "model_pictures",
    "refine_photometrically",
    "texture_space",
    "turn_light",
    "window_of",
    "with_pixels",
]
