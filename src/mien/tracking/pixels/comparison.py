"""Pictures of the tracked model with its texture and light, and the difference of their colours from the capture's."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from mien import _native
from mien.camera import Camera
from mien.capture.capture import Capture
from mien.face.model import FaceModel
from mien.render.mesh import vertex_normals
from mien.tracking.fitting.views import CameraBatch, batch_of
from mien.tracking.pixels.pictures import Picture, Pictures
from mien.tracking.pixels.surface import PosedSurface
from mien.tracking.pixels.texture import Sighting, SkinTexture, texture_space
from mien.tracking.tracking import Appearance, Tracking

_COMPARISON_OUTLIER = 10.0
"""Number of standard deviations beyond which a pixel hardly counts for `Comparison.rms`. It is the default of the fit's
own threshold, `PhotometricSettings.outlier`: with 3, the shape of a drawn head errs by 0.67 instead of 0.43 mm
(log)."""
LEAST_PIXELS = 100.0  # fewest pixels of a comparison. Fewer show nothing of a face

_MARGIN, _MIN_WINDOW = 3, 8
"""Margin around a mesh and least size of a window, in pixels."""


@dataclass(frozen=True, eq=False)
class Window:
    """The part of a picture that a mesh may cover. A head leaves most of a picture empty."""

    camera: Camera
    """The camera of that part alone."""
    rows: slice
    columns: slice


def window_of(camera: Camera, vertices: Float[Tensor, "v 3"]) -> Window:
    """The window of a mesh in a picture. It is never smaller than 8 x 8 pixels."""
    points, depth = camera.project(vertices)
    points = points[depth > 0] if (depth > 0).any() else points.new_zeros(1, 2)
    size = torch.tensor([camera.width, camera.height])
    first = torch.minimum((points.amin(0).floor().long() - _MARGIN).clamp_min(0), size - _MIN_WINDOW)
    last = torch.minimum(points.amax(0).ceil().long() + _MARGIN, size).maximum(first + _MIN_WINDOW)
    (left, top), (right, bottom) = first.tolist(), last.tolist()
    part = camera.cropped(float(left), float(top), right - left, bottom - top)
    return Window(part, slice(top, bottom), slice(left, right))


@dataclass(frozen=True, eq=False)
class Comparison:
    """Comparison of a picture with the model's picture, in the part that the mesh may cover."""

    window: Window

    image: Float[Tensor, "h w 3"]
    """The model's colours, 0..1, plus the smooth differences of light to the picture; NaN where not compared."""
    difference: Float[Tensor, "h w"]
    """Length of the difference of the three colours; NaN where not compared."""
    rms: float
    """Robust root mean square of the differences; NaN if too few pixels were compared."""


@dataclass(frozen=True, eq=False)
class ModelPictures:
    """The model's pictures of one tracked capture."""

    pictures: Pictures
    cameras: CameraBatch
    appearance: Appearance
    surface: "_native.AlignSurface"
    face_model: FaceModel

    @torch.no_grad()
    def compare(self, timestep: int, camera: int, vertices: Float[Tensor, "v 3"]) -> Comparison:
        """Compare one picture with the model's. Several threads may call this at once."""
        picture = self.pictures.picture(timestep, camera, self.cameras)
        window = window_of(picture.camera, vertices)
        part = window.rows, window.columns
        picture = Picture(window.camera, picture.image[part].contiguous(), picture.mask[part].contiguous())
        posed = PosedSurface(vertices.contiguous(), vertex_normals(vertices, self.face_model.faces), None)
        view, residual = picture.camera, torch.empty_like(picture.image)
        depth = float(view.project(vertices.mean(0, keepdim=True))[1])
        radius = max(round(self.appearance.light_extent * float(view.K[0, 0]) / max(depth, 1e-3)), 2)
        seen = Sighting(posed, picture, self.appearance.light.contiguous()).arrays()
        cost, weight = _native.align_mesh(self.surface, seen, radius, None, residual, None)
        rms = self.appearance.sigma * cost**0.5 if weight >= LEAST_PIXELS else float("nan")
        return Comparison(window, picture.image - residual, residual.norm(dim=-1), rms)


def model_pictures(capture: Capture, tracking: Tracking, face_model: FaceModel) -> ModelPictures | None:
    """The model's pictures of a tracked capture, or None if it was not fitted to pixels (`Tracking.appearance`)."""
    appearance = tracking.appearance
    if appearance is None:
        return None
    texture = SkinTexture(appearance.texture.contiguous(), appearance.trust.contiguous(), appearance.sigma)
    surface = texture_space(face_model, len(texture.albedo)).native(texture, _COMPARISON_OUTLIER)
    return ModelPictures(Pictures(capture, 1), batch_of(tracking.cameras), appearance, surface, face_model)
