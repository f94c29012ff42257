"""Tracking: the face model fitted to a capture."""

from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mien.camera import Camera
from mien.face.params import FaceParams

PARTS = ("mouth", "nose", "eyes")
"""Parts of a face that something may cover (`Tracking.covered`)."""


@dataclass(frozen=True, eq=False)
class Appearance:
    """The subject's skin and the light of one sequence, from a fit to pixels."""

    texture: Float[Tensor, "th tw 3"]
    """Albedo in the face model's texture coordinates. A colour (0..1, sRGB) is albedo times light."""
    trust: Float[Tensor, "th tw"]
    """Trust in each texel: 0 if it is unknown, below 1 if pictures contradict each other."""
    light: Float[Tensor, "9 3"]
    """Spherical harmonics coefficients over world-space normals (`mien.render.mesh.shade`)."""
    sigma: float
    """Expected difference between the colours of a picture and of the model."""
    light_extent: float
    """Extent on the face, in metres, over which a smooth difference counts as light that the model does not explain."""


@dataclass(frozen=True, eq=False)
class Tracking:
    """Face parameters and cameras of one sequence of t timesteps and c cameras.

    With one uncalibrated camera the world frame is the camera's with y up and z backward (viewmat =
    diag(1, -1, -1, 1)), so a face that looks into the camera has a head rotation of about zero. Calibrated cameras stay
    in the world of their calibration.
    """

    face_model: str
    """Name of the face model, for `mien.face.load_face_model`."""
    face_model_hash: str
    """`FaceModel.content_hash` of the face model."""
    face: FaceParams
    """Face parameters of all t timesteps. Those that are not `valid` are interpolated from their neighbours."""
    valid: Bool[Tensor, " t"]
    """Whether at least one camera found a face."""
    cameras: tuple[Camera, ...]
    """The camera of each camera_id, for pictures of the capture's size."""
    neck_lines: Float[Tensor, "t c 3"]
    """Neck lines (a, b, d) with a^2 + b^2 = 1. Pixels with a x + b y + d >= 0 are above the line and are kept."""
    residuals: Float[Tensor, "t c"]
    """Median distance of landmarks from their fit, in pixels; NaN where the camera found no face."""
    pixel_residuals: Float[Tensor, "t c"] | None = None
    """Robust root mean square difference of colours (0..1) from the texture that all pictures share. NaN where
    landmarks alone determined the fit. None if there was no fit to pixels."""
    appearance: Appearance | None = None
    """Texture and light of the model. None if there was no fit to pixels or it found no texture."""
    covered: Bool[Tensor, "t c p"] | None = None
    """Which of `PARTS` something covers in each picture, such as a hand. None if nothing was found."""
    settings: dict = field(default_factory=dict)
    """Settings of the tracking, for the report."""

    @property
    def aligned(self) -> bool:
        """Whether the faces were aligned to a quick avatar (`mien align`)."""
        return bool(self.settings.get("aligned"))

    def covered_pictures(self) -> Bool[Tensor, "t c"]:
        """The pictures in which something covers a part of the face."""
        if self.covered is None:
            return torch.zeros(len(self.valid), len(self.cameras), dtype=torch.bool)
        return self.covered.any(2)
