from .loading import load_face_model as load_face_model
from .model import FaceModel as FaceModel
from .params import FaceParams as FaceParams
from .posing import head_poses as head_poses
