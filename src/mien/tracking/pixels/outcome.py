"""Results of a fit to pixels: appearance and residuals in Trackings, and the model's pictures beside the capture's."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from mien import _native
from mien.capture.capture import Capture
from mien.face.model import FaceModel
from mien.machine.parallel import map_in_threads
from mien.machine.progress import say
from mien.render.mesh import sh_basis, vertex_normals
from mien.tracking.fitting.sequence import SequenceData
from mien.tracking.fitting.views import CameraBatch, batch_of
from mien.tracking.pixels.covered import covered_parts
from mien.tracking.pixels.pictures import Picture, Pictures, Window, window_of
from mien.tracking.pixels.surface import PosedSurface
from mien.tracking.pixels.texture import LIGHT_EXTENT, PhotometricFit, SkinTexture, SurfaceView, texture_space
from mien.tracking.settings import PhotometricSettings
from mien.tracking.tracking import Appearance, Tracking

LEAST_PIXELS = 100.0  # fewest pixels of a comparison. Fewer show nothing of a face


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
        seen = SurfaceView(posed, picture, self.appearance.light.contiguous()).arrays()
        cost, weight = _native.align_mesh(self.surface, seen, radius, None, residual, None)
        rms = self.appearance.sigma * cost**0.5 if weight >= LEAST_PIXELS else float("nan")
        return Comparison(window, picture.image - residual, residual.norm(dim=-1), rms)


def model_pictures(capture: Capture, tracking: Tracking, face_model: FaceModel) -> ModelPictures | None:
    """The model's pictures of a tracked capture, or None if it was not fitted to pixels (`Tracking.appearance`)."""
    appearance = tracking.appearance
    if appearance is None:
        return None
    texture = SkinTexture(appearance.texture.contiguous(), appearance.trust.contiguous(), appearance.sigma)
    surface = texture_space(face_model, len(texture.albedo)).native(texture, PhotometricSettings.outlier)
    return ModelPictures(Pictures(capture, 1), batch_of(tracking.cameras), appearance, surface, face_model)


def with_pixels(
    trackings: Sequence[Tracking], sequences: Sequence[SequenceData], refined: PhotometricFit, face_model: FaceModel
) -> list[Tracking]:
    """The trackings with the results of the fit to pixels: appearance, pixel residuals, and parts that are covered."""
    complete = []
    for index, (tracking, data) in enumerate(zip(trackings, sequences, strict=True)):
        appearance = appearance_in_world(refined.texture, refined.lights[index], data.T_world_fit)
        tracking = replace(tracking, appearance=appearance)
        of_faces = refined.residuals[index] if refined.residuals else _residuals(tracking, data, face_model)
        residuals = torch.full_like(tracking.residuals, torch.nan)
        residuals[data.valid] = of_faces.where(refined.improved[index][:, None], torch.nan)
        left = (data.valid & residuals.isnan().all(1)).nonzero()[:, 0].tolist()
        if left:
            some = ", ".join(map(str, left[:8])) + (", ..." if len(left) > 8 else "")
            say(f"{data.capture.name}: the fit to pixels did not improve {len(left)} of {int(data.valid.sum())} frames "
                f"with a face. They keep their fit to landmarks: {some}")  # fmt: skip
        tracking = replace(tracking, pixel_residuals=residuals)
        covered = covered_parts(data.capture, tracking, face_model)
        complete.append(replace(tracking, covered=covered) if covered.any() else tracking)
    return complete


def _residuals(tracking: Tracking, data: SequenceData, face_model: FaceModel) -> Float[Tensor, "v c"]:
    """Colour differences of the pictures with a face (`Comparison.rms`); NaN where a camera found none."""
    pictures, timesteps = model_pictures(data.capture, tracking, face_model), data.timesteps.tolist()
    assert pictures is not None
    residuals = torch.full((len(timesteps), len(tracking.cameras)), torch.nan)

    def compare(row: int) -> None:
        vertices = face_model(tracking.face[timesteps[row]])[0]
        for camera in data.views.seen_by(row):
            residuals[row, camera] = pictures.compare(timesteps[row], camera, vertices).rms

    map_in_threads(compare, list(range(len(timesteps))))
    return residuals


def appearance_in_world(
    texture: SkinTexture, light: Float[Tensor, "9 3"], T_world_fit: Float[Tensor, "4 4"] | None
) -> Appearance:
    """The appearance that a fit found, with the light turned from the frame of the fit to the world frame."""
    if T_world_fit is not None:
        light = turn_light(light, T_world_fit[:3, :3].to(light))
    return Appearance(texture.albedo, texture.trust, light, texture.sigma, LIGHT_EXTENT)


def turn_light(light: Float[Tensor, "9 3"], rotation: Float[Tensor, "3 3"]) -> Float[Tensor, "9 3"]:
    """The spherical harmonics of the same light in a turned frame: they shade turned normals as `light` the normals."""
    normals = torch.nn.functional.normalize(torch.randn(64, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    turned = sh_basis(normals.double() @ rotation.double().T)
    # Rotations map the harmonics of each degree to themselves, so the fit is exact.
    return torch.linalg.lstsq(turned, sh_basis(normals.double()) @ light.double()).solution.to(light).contiguous()
