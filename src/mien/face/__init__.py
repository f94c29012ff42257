"""Face models: parameters in, vertices out."""

from mien.face.model import FaceModel, Landmarks
from mien.face.params import FaceParams, concatenate

__all__ = ["FaceModel", "FaceParams", "Landmarks", "concatenate"]
