"""Face models: parameters in, vertices out.

`model` and `params` are the classes; `posing` computes vertices natively. `loading` finds models by name and keeps them
in the user's `cache`, and `checks` tests what is read. Models come from two sources: `anny` (with `anny_source`,
`anny_topology` and `anny_identity`), and files in the schema of `flame` (with `npz`, `inert_pickle` and `chart`, which
makes texture coordinates for a head without any). `mirror` finds each triangle's image on the other side.
"""

from mien.face.loading import FaceModelInfo, add_face_model, available_face_models, load_face_model, read_added_source
from mien.face.mirror import mirror_triangles
from mien.face.model import FaceModel, Landmarks
from mien.face.params import FaceParams, concatenate, most_frontal_camera
from mien.face.posing import head_poses

__all__ = [
    "FaceModel",
    "FaceModelInfo",
    "FaceParams",
    "Landmarks",
    "add_face_model",
    "read_added_source",
    "available_face_models",
    "concatenate",
    "head_poses",
    "load_face_model",
    "mirror_triangles",
    "most_frontal_camera",
]
