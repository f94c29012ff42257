"""Face models: parameters in, vertices out."""

from mien.face.loading import FaceModelInfo, add_face_model, added_from, available_face_models, load_face_model
from mien.face.model import FaceModel, Landmarks
from mien.face.params import FaceParams, concatenate, most_frontal_camera
from mien.face.posing import head_poses

__all__ = [
    "FaceModel",
    "FaceModelInfo",
    "FaceParams",
    "Landmarks",
    "add_face_model",
    "added_from",
    "available_face_models",
    "concatenate",
    "head_poses",
    "load_face_model",
    "most_frontal_camera",
]
