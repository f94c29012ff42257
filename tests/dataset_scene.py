"""A head in FLAME's schema in front of cameras, drawn for the writers of datasets.
Vertices come from `posed_as_flame`, a forward pass of its own, in float64. Nothing here calls the importers."""

import contextlib
import tempfile
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import torch

from flame_like import exact_landmarks, flame_like, posed_as_flame, write_npz
from mien.camera import Camera
from mien.face import FaceModel, load_face_model
from mien.face.models.flame import flame_face_model, read_flame
from mien.render.mesh import render_mesh
from mien.rotation import matrix_from_axis_angle

SIDE = 128


@dataclass(frozen=True, eq=False)
class Scene:
    """t timesteps of one person."""

    arrays: dict[str, np.ndarray]
    model: FaceModel
    shape: np.ndarray
    """Identity, padded to 300."""
    expr: np.ndarray
    """Expressions [t, 100]: only the first are not zero."""
    pose: np.ndarray
    """Axis-angles [t, 5, 3] of root, neck, jaw and eyes."""
    translation: np.ndarray
    colors: torch.Tensor

    def vertices(self, timestep: int, root: bool = True, neck: bool = True) -> np.ndarray:
        """Return FLAME's vertices [v, 3] in metres."""
        pose = self.pose[timestep].copy()
        pose[0] *= root
        pose[1] *= neck
        shift = self.translation[timestep] * root
        identities, expressions = counts(self.arrays)
        coefficients = np.concatenate([self.shape[:identities], self.expr[timestep, :expressions]])
        return posed_as_flame(self.arrays, pose, coefficients, shift)

    def marks(self, vertices: np.ndarray) -> np.ndarray:
        """Return MediaPipe's landmarks [478, 3] on these vertices."""
        marks = self.model.landmarks["mediapipe"]
        corners = vertices[self.model.faces.numpy()[marks.faces.numpy()]]
        return (corners * marks.barycentric.double().numpy()[..., None]).sum(1)

    def __len__(self) -> int:
        return len(self.expr)


def counts(arrays: dict[str, np.ndarray]) -> tuple[int, int]:
    """Return the numbers of identities and expressions."""
    identities = int(arrays["identities"])
    return identities, arrays["shapedirs"].shape[2] - identities


@cache
def drawn_person(timesteps: int = 6) -> Scene:
    """Return a head that turns about all axes, with a neck, a jaw and eyes that move, and a coloured cheek."""
    anny = load_face_model("anny")
    arrays = flame_like(anny)
    with tempfile.TemporaryDirectory() as folder:
        model = flame_face_model(read_flame(write_npz(Path(folder) / "flame.npz", arrays)), "flame")
    return scene_of(arrays, replace(model, landmarks=exact_landmarks(anny)), timesteps)


def scene_of(arrays: dict[str, np.ndarray], model: FaceModel, timesteps: int, seed: int = 3) -> Scene:
    """Return random poses of a random person of a face model, whose arrays are in FLAME's schema."""
    random = np.random.default_rng(seed)
    shape, expr = np.zeros(300), np.zeros((timesteps, 100))
    identities, expressions = counts(arrays)
    shape[:identities] = 0.5 * random.standard_normal(identities)
    expr[:, :expressions] = 0.5 * random.standard_normal((timesteps, expressions))
    pose = np.zeros((timesteps, 5, 3))
    pose[:, 0] = random.uniform(-0.25, 0.25, (timesteps, 3))
    pose[:, 1] = random.uniform(-0.2, 0.2, (timesteps, 3))
    pose[:, 2, 0] = random.uniform(0.02, 0.25, timesteps)
    pose[:, 3:, :2] = random.uniform(-0.2, 0.2, (timesteps, 2, 2))
    translation = random.uniform(-0.02, 0.02, (timesteps, 3))
    template = arrays["v_template"]
    colors = torch.full((len(template), 3), 0.7)
    cheek = (template[:, 0] > 0.02) & (template[:, 1] < 0) & (template[:, 2] > 0)
    colors[torch.from_numpy(cheek)] = torch.tensor([0.9, 0.3, 0.2])
    return Scene(arrays, model, shape, expr, pose, translation, colors)


def head_view(timestep: int, distance: float = 0.9) -> tuple[np.ndarray, np.ndarray]:
    """Return an OpenCV world-to-camera rotation and translation, in front of a head that faces +z, slightly turned."""
    angles = torch.tensor([0.1 * timestep - 0.2, 0.15 - 0.07 * timestep, 0.05 * timestep], dtype=torch.float64)
    turned = matrix_from_axis_angle(angles).numpy()
    return np.diag([1.0, -1.0, -1.0]) @ turned, np.array([0.01 * timestep, 0.02, distance])


def draw(
    scene: Scene, vertices: np.ndarray, K: np.ndarray, rotation: np.ndarray, translation: np.ndarray,
    size: tuple[int, int] | None = None,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return picture [h, w, 3] and matte [h, w] of vertices, by an OpenCV camera."""
    placed = torch.from_numpy(vertices @ rotation.T + translation).float()
    camera = Camera(torch.from_numpy(K).float(), torch.eye(4), *(size or (SIDE, SIDE)))
    faces = torch.from_numpy(scene.arrays["f"].astype(np.int64))
    image, alpha = render_mesh(placed, faces, camera, scene.colors, background=(1.0, 1.0, 1.0))
    return (image * 255).round().byte().numpy(), (alpha * 255).round().byte().numpy()


def projected(vertices: np.ndarray, K: np.ndarray, rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Return the pixels [v, 2] of vertices, in float64."""
    seen = (vertices @ rotation.T + translation) @ K.T
    return seen[:, :2] / seen[:, 2:]


class NoDetector(contextlib.AbstractContextManager):
    """A detector that finds nothing, since loading the real one for each case would take minutes."""

    def __init__(self, several_faces: bool) -> None:
        pass

    def __exit__(self, *_: object) -> None:
        pass

    def detect(self, image: np.ndarray) -> np.ndarray:
        return np.zeros((0, 478, 2))


def unfound(images: np.ndarray) -> np.ndarray:
    """Return landmarks of pictures in which a detector finds no face."""
    return np.full((*images.shape[:2], 478, 2), 5, np.float32)
