"""The exact truth of a synthetic capture, for measuring trackers in millimetres and pixels."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int

from mien.disk.files import read_arrays, read_json, write_arrays, write_json
from mien.disk.reading import expect_whole
from mien.face.loading import load_face_model
from mien.face.torso import TorsoPose
from mien.lab.synthetic.anatomy import CHIN, EAR, FOREHEAD_TOP, Anatomy, measure_anatomy
from mien.lab.synthetic.motion import neck_pivot, shoulder_rotation
from mien.lab.synthetic.scene import SyntheticScene
from mien.machine import exact
from mien.runtime.rotation import axis_angle_from_matrix
from mien.tracking.files import read_tracking, write_tracking
from mien.tracking.tracking import Tracking

FORMAT, VERSION = "mien.synthetic_truth", 1
_JSON, _ARRAYS, _TRACKING = "truth.json", "truth.safetensors", "tracking"
_METER, _PIXEL = 1e-5, 1 / 16
"""Units of the stored 16-bit numbers: 10 micrometres, a sixteenth of a pixel."""


@dataclass(frozen=True, eq=False)
class Truth:
    """The truth of one sequence of t timesteps and c cameras."""

    tracking: Tracking
    """Head poses, cameras and identity. Vertices are exact too, unless the head leaves the face model (`off_model`)."""
    vertex_index: Int[np.ndarray, " n"]
    """Vertices of the face region: the face model's skin between chin and hairline, in front of the ears."""
    vertices: Float[np.ndarray, "t n 3"]
    """Their positions in the head frame, in metres, to 10 micrometres. They are exact for every recipe."""
    landmarks: Float[np.ndarray, "t c l 2"]
    """MediaPipe's 478 points on the true surface, projected to pixels of the drawn pictures. Hidden ones are
    included."""

    @property
    def vertices_world(self) -> Float[np.ndarray, "t n 3"]:
        """The region's vertices in world space."""
        poses = self.tracking.face.T_world_head.numpy()
        return exact.product(self.vertices, np.swapaxes(poses[:, :3, :3], 1, 2)) + poses[:, None, :3, 3]

    @property
    def torso(self) -> TorsoPose:
        """The pose of the shoulders in the world, about the neck joint."""
        face = self.tracking.face
        pivot = neck_pivot(load_face_model(self.tracking.face_model), face.identity)
        poses = face.T_world_head.numpy()
        place = exact.product(poses[:, :3, :3], pivot[:, None])[..., 0] + poses[:, :3, 3]
        rotation = axis_angle_from_matrix(shoulder_rotation(face.head_rotation.numpy()))
        return TorsoPose(torch.from_numpy(rotation).float(), torch.from_numpy(place).float())

    @property
    def stored(self) -> dict[str, np.ndarray]:
        """The arrays as they are stored."""
        return {
            "vertex_index": self.vertex_index.astype(np.int32),
            "vertices": _packed(self.vertices, _METER),
            "landmarks": _packed(self.landmarks, _PIXEL),
        }


def truth_of(scene: SyntheticScene) -> Truth:
    """Return the truth of a scene, rounded as it is stored."""
    return Truth(scene.tracking(), *surface_of(scene))


def surface_of(
    scene: SyntheticScene,
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "t n 3"], Float[np.ndarray, "t c l 2"]]:
    """Return `vertex_index`, `vertices` and `landmarks` of the truth, which are the same on every machine."""
    index = face_region(measure_anatomy(scene.model, scene.identity))
    chosen = torch.from_numpy(index)
    vertices = np.stack([scene.head_vertices(step)[chosen].numpy() for step in range(scene.timesteps)])
    landmarks = np.stack([scene.landmarks(camera) for camera in range(len(scene.cameras))], axis=1)
    return index, _unpacked(_packed(vertices, _METER), _METER), _unpacked(_packed(landmarks, _PIXEL), _PIXEL)


def face_region(anatomy: Anatomy) -> Int[np.ndarray, " n"]:
    """Return the vertices of the face's skin: no ears, no neck, nothing behind the ears or above the forehead."""
    skin = np.unique(anatomy.faces[anatomy.skin & ~anatomy.region("ears", "neck", "scalp")])
    points, marks = anatomy.vertices[skin], anatomy.landmarks
    inside = (points[:, 1] > marks[CHIN, 1] - 0.005) & (points[:, 1] < marks[FOREHEAD_TOP, 1])
    return skin[inside & (points[:, 2] > marks[EAR, 2])].astype(np.int64)


def write_truth(folder: Path, truth: Truth) -> None:
    """Write FOLDER/truth.json, truth.safetensors and tracking/. The json comes last."""
    write_tracking(folder / _TRACKING, truth.tracking)
    write_arrays(folder / _ARRAYS, truth.stored)
    write_json(folder / _JSON, FORMAT, VERSION, {"metre": _METER, "pixel": _PIXEL})


def read_truth(folder: Path) -> Truth:
    """Read what `write_truth` wrote."""
    content = read_json(folder / _JSON, FORMAT, VERSION)
    arrays = read_arrays(folder / _ARRAYS)
    with expect_whole(folder / _JSON, "delete the folder and draw the capture again"):
        return Truth(
            tracking=read_tracking(folder / _TRACKING),
            vertex_index=arrays["vertex_index"].astype(np.int64),
            vertices=_unpacked(arrays["vertices"], content["metre"]),
            landmarks=_unpacked(arrays["landmarks"], content["pixel"]),
        )


def _packed(values: np.ndarray, unit: float) -> np.ndarray:
    return np.clip(np.rint(values / unit), -32767, 32767).astype(np.int16)


def _unpacked(values: np.ndarray, unit: float) -> np.ndarray:
    return (values * np.float32(unit)).astype(np.float32)
