"""Face models: parameters in, vertices out.

`model` and `params` are the classes; `posing` computes vertices natively, and `parts` finds eyes and mouth in pictures.
`listing` says which models there are, without torch; `loading` reads them and keeps them
in the user's `cache`, and `checks` tests what is read. Models come from two sources: `anny` (with `anny_source`,
`anny_topology` and `anny_identity`), and files in the schema of `flame` (with `npz`, `inert_pickle` and `chart`, which
makes texture coordinates for a head without any). `mirror` finds each triangle's image on the other side.
"""

from typing import TYPE_CHECKING

from mien.lazy import lazy_names

if TYPE_CHECKING:
    from mien.face.listing import FaceModelInfo, available_face_models, read_added_source
    from mien.face.loading import add_face_model, load_face_model
    from mien.face.mirror import mirror_triangles
    from mien.face.model import FaceModel, Landmarks
    from mien.face.params import FaceParams, concatenate, most_frontal_camera
    from mien.face.parts import PARTS, part_boxes
    from mien.face.posing import head_poses

__getattr__, __dir__ = lazy_names(__name__, __file__)
__all__ = [
    "PARTS",
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
    "part_boxes",
]
