"""Results of a fit to pixels in Trackings: appearance and pixel residuals."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from mien.face.model import FaceModel
from mien.machine.parallel import map_in_threads
from mien.machine.progress import say
from mien.render.mesh import sh_basis
from mien.tracking.fitting.shot import Shot
from mien.tracking.pixels.comparison import model_pictures
from mien.tracking.pixels.covered import covered_parts
from mien.tracking.pixels.texture import PhotometricFit, SkinTexture
from mien.tracking.settings import TrackingSettings
from mien.tracking.tracking import Appearance, Tracking

_SOME = 8
"""Largest number of frames that a message lists."""


def with_pixels(
    trackings: Sequence[Tracking],
    shots: Sequence[Shot],
    refined: PhotometricFit,
    face_model: FaceModel,
    settings: TrackingSettings,
) -> list[Tracking]:
    """The trackings with the results of the fit to pixels: appearance, pixel residuals, and parts that are covered."""
    complete = []
    for index, (tracking, shot) in enumerate(zip(trackings, shots, strict=True)):
        tracking = replace(tracking, appearance=appearance_of(refined, index, shot, settings))
        found = refined.residuals[index] if refined.residuals else _residuals(tracking, shot, face_model)
        found = found.where(refined.improved[index][:, None], torch.nan)
        tracking = _with_pixel_residuals(tracking, shot, found)
        covered = covered_parts(shot.capture, tracking, face_model)
        complete.append(replace(tracking, covered=covered) if covered.any() else tracking)
    return complete


def _residuals(tracking: Tracking, shot: Shot, face_model: FaceModel) -> Float[Tensor, "v c"]:
    """Colour differences of the pictures with a face (`Comparison.rms`); NaN where a camera found none."""
    pictures = model_pictures(shot.capture, tracking, face_model)
    assert pictures is not None
    found = torch.full((int(shot.valid.sum()), len(tracking.cameras)), torch.nan)
    timesteps, views = shot.valid.nonzero()[:, 0].tolist(), shot.views

    def compare(row: int) -> None:
        vertices = face_model(tracking.face[timesteps[row]])[0]
        for camera in views.seen_by(row):
            found[row, camera] = pictures.compare(timesteps[row], camera, vertices).rms

    map_in_threads(compare, list(range(len(found))))
    return found


def _with_pixel_residuals(tracking: Tracking, shot: Shot, found: Float[Tensor, "v c"]) -> Tracking:
    residuals = torch.full_like(tracking.residuals, torch.nan)
    residuals[shot.valid] = found
    left = (shot.valid & residuals.isnan().all(1)).nonzero()[:, 0].tolist()
    if left:
        some = ", ".join(map(str, left[:_SOME])) + (", ..." if len(left) > _SOME else "")
        say(f"{shot.capture.name}: the fit to pixels did not improve {len(left)} of {int(shot.valid.sum())} frames "
            f"with a face. They keep their fit to landmarks: {some}")  # fmt: skip
    return replace(tracking, pixel_residuals=residuals)


def appearance_of(refined: PhotometricFit, sequence: int, shot: Shot, settings: TrackingSettings) -> Appearance:
    """The texture, and the light of one of the sequences."""
    extent = settings.photometric.light_extent if settings.schedule == "fast" else settings.paper.light_extent
    return appearance_in_world(refined.texture, refined.lights[sequence], shot.T_world_fit, extent)


def appearance_in_world(
    texture: SkinTexture, light: Float[Tensor, "9 3"], T_world_fit: Float[Tensor, "4 4"] | None, light_extent: float
) -> Appearance:
    """The appearance that a fit found, with the light turned from the frame of the fit to the world frame."""
    if T_world_fit is not None:
        light = turn_light(light, T_world_fit[:3, :3].to(light))
    return Appearance(texture.albedo, texture.trust, light, texture.sigma, light_extent)


def turn_light(light: Float[Tensor, "9 3"], rotation: Float[Tensor, "3 3"]) -> Float[Tensor, "9 3"]:
    """The spherical harmonics of the same light in a turned frame.

    The result shades a turned normal as `light` shades the normal itself.
    """
    normals = torch.nn.functional.normalize(torch.randn(64, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    turned = sh_basis(normals.double() @ rotation.double().T)
    # Rotations map the harmonics of each degree to themselves, so the fit is exact.
    return torch.linalg.lstsq(turned, sh_basis(normals.double()) @ light.double()).solution.to(light).contiguous()
